"""The files that define ROS messages."""

from __future__ import annotations

from pathlib import Path

from tapping_cell.configuration.files import own_folder

_OWN_PACKAGE = "tapping_cell_msgs"


class UnknownMessageType(ValueError):
    """Raised for an unknown message type; the message lists the searched locations."""


def definition_file(kind: str) -> Path:
    """Return the file that defines a message type, such as ``geometry_msgs/msg/Pose``.

    Raises:
        UnknownMessageType: neither an installed package nor the source tree defines it.
    """
    parts = kind.split("/")
    if len(parts) != 3 or not all(parts):
        raise UnknownMessageType(f"'{kind}' is not a message type; give it as package/msg/Name")
    package, folder, name = parts
    share = _installed(package)
    if share is None and package == _OWN_PACKAGE:
        # Before a build and without ROS, the ament index lacks the cell's messages.
        share = own_folder("msg_defs")
    if share is None:
        raise UnknownMessageType(
            f"the definition of {kind} was not found: the package {package} is not installed"
        )
    file = share / folder / f"{name}.msg"
    if not file.is_file():
        raise UnknownMessageType(f"the definition of {kind} was not found: there is no {file}")
    return file


def _installed(package: str) -> Path | None:
    """Return the folder of a ROS package; None if it or ROS is not installed."""
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(package))
    except (ImportError, LookupError, OSError, ValueError):
        return None
