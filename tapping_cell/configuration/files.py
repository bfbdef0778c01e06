"""Where the package's own data files are."""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory


def shared_folder() -> Path:
    """The ``config`` folder: of the source tree when run from one, else of the installation."""
    source = Path(__file__).resolve().parents[2]
    if (source / "package.xml").is_file():
        return source / "config"
    return Path(get_package_share_directory("tapping_cell")) / "config"
