"""Versions of the software on which a run's results depend."""

from __future__ import annotations

import platform
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
