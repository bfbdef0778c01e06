"""Interface that returns the poses of other frames in ``table``, so that goals can be given in
these frames."""

from __future__ import annotations

from typing import Protocol

from tapping_cell.messages import Pose, Time

TABLE = "table"
"""Name of the cell's frame, which is defined by the reference markers."""


class FrameError(LookupError):
    """A frame is not connected to ``table``; the message names the connected frames."""


class Frames(Protocol):
    """Source of the poses of other frames."""

    def in_table(self, frame: str, stamp: Time) -> Pose:
        """Return the pose of a frame in ``table`` at the time ``stamp``; a stamp of zero selects
        the latest pose.

        Raises:
            FrameError: the pose is not known.
        """


class TableOnly:
    """Implementation of ``Frames`` without any frame besides ``table``; used if tf2_ros is not
    installed."""

    def in_table(self, frame: str, stamp: Time) -> Pose:
        """Raise FrameError."""
        raise FrameError(
            f"the goal's frame_id is '{frame}', but goals are poses in '{TABLE}'; set "
            f"header.frame_id to {TABLE}, or install tf2_ros to send goals in other frames"
        )
