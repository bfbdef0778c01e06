"""Names of the cell's frames on the wire: with a prefix if several cells share ``/tf``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tapping_cell.hardware.link_frames import LINKS
from tapping_cell.logic.frames import TABLE

FRAMES = frozenset((TABLE, "object", "camera_optical", *LINKS))
"""The cell's frames, without a prefix."""
FRAME_FIELDS = ("frame_id", "child_frame_id")


def add_prefix(message: Any, prefix: str) -> None:
    """Add the prefix to every frame of the cell in a ROS message."""
    if prefix:
        _rename(message, lambda name: prefix + name if name in FRAMES else name)


def remove_table_prefix(message: Any, prefix: str) -> None:
    """Replace the prefixed name of ``table`` in a ROS message by the name within the cell. Other
    frames keep their names, by which they are looked up on ``/tf``."""
    if prefix:
        _rename(message, lambda name: TABLE if name == prefix + TABLE else name)


def _rename(message: Any, rename: Callable[[str], str]) -> None:
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if name in FRAME_FIELDS:
            if value:
                setattr(message, name, rename(value))
        elif "/" in kind:
            for part in value if isinstance(value, (list, tuple)) else (value,):
                _rename(part, rename)
