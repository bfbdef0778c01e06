"""Location of the package's own data files."""

from __future__ import annotations

from pathlib import Path


def own_folder(name: str) -> Path | None:
    """Return a top folder of the source tree, such as ``config``. It is that of the source tree, or
    the copy that ``pip install`` makes inside the package; None in a ROS workspace."""
    package = Path(__file__).resolve().parents[1]
    root = package.parent if (package.parent / "package.xml").is_file() else package
    return root / name if (root / name).is_dir() else None


def shared_folder() -> Path:
    """Return the folder ``config`` of the source tree or of the installation."""
    own = own_folder("config")
    if own is not None:
        return own
    from ament_index_python.packages import get_package_share_directory

    return Path(get_package_share_directory("tapping_cell")) / "config"
