"""Goals in other frames than ``table``: what the machines ask of whoever knows the frames."""

from __future__ import annotations

from typing import Protocol

from tapping_cell.messages import Pose, Time

TABLE = "table"
"""The frame in which the cell works, defined by the reference markers."""


class FrameError(LookupError):
    """A frame is not connected to ``table``; the sentence says which are."""


class Frames(Protocol):
    """Where other frames are."""

    def in_table(self, frame: str, stamp: Time) -> Pose:
        """The pose of a frame in ``table`` at a time; a stamp of zero asks for the latest.

        Raises:
            FrameError: it is not known.
        """


class TableOnly:
    """No other frame is known, as tf2_ros is not installed."""

    def in_table(self, frame: str, stamp: Time) -> Pose:
        """Refuse."""
        raise FrameError(
            f"the goal's frame_id is '{frame}', but goals are poses in '{TABLE}'; set "
            f"header.frame_id to {TABLE}, or install tf2_ros to send goals in other frames"
        )
