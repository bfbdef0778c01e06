"""Versions of the software on which a run's results depend."""

from __future__ import annotations

import platform
import re
from importlib import metadata

from tapping_cell import __version__

_PACKAGES = ("numpy", "scipy", "opencv-python-headless", "rclpy")


def versions() -> dict[str, str]:
    """Return the versions of the cell and of the packages on which its results depend."""
    found = {"tapping_cell": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "unknown"
    return found


def version_key(version: str) -> tuple[int, ...]:
    """Return a version such as 0.12.1 as numbers, for comparison."""
    return tuple(int(part) for part in re.findall(r"\d+", version))
