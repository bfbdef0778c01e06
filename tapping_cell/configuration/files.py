"""Location of the package's own data files."""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory


def shared_folder() -> Path:
    """Return the ``config`` folder of the source tree if the package is run from a source tree,
    otherwise the installed folder."""
    source = Path(__file__).resolve().parents[2]
    if (source / "package.xml").is_file():
        return source / "config"
    return Path(get_package_share_directory("tapping_cell")) / "config"
