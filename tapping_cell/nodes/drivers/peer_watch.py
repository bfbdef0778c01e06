"""Who must be heard for a tapper to be drawn: the planner and the camera."""

from __future__ import annotations

import time

from rclpy.time import Time
from tapping_cell_msgs.msg import ErrorCode, ObjectState, PlanState

TAPPING = (PlanState.PLACING, PlanState.FIRING)
"""Phases of a planner that waits for its tap."""

BLIND = frozenset(
    {
        ErrorCode.CAMERA_SILENT,
        ErrorCode.CAMERA_NOT_CALIBRATED,
        ErrorCode.IMAGE_INVALID,
        ErrorCode.STAMP_INVALID,
    }
)
"""What is said when no picture comes, or none that can be used: that is no word of the camera."""

IDLE_LIMIT_S = 1.5
"""A planner whose tap it is not speaks twice a second: it is missed only after so long."""

Trouble = tuple[int, str]
"""An error code and a sentence."""


class PeerWatch:
    """When planner and camera were last heard, and whether the planner still wants its tap.

    One that has never been heard is not missed: a person or a program may command single taps
    without it. One that was heard and falls silent is lost, hung processes included; the camera's
    word is as old as its picture. Written by the executor, read by the worker too: each field is
    assigned at once.
    """

    def __init__(self, silence_limit: float) -> None:
        self._limit = silence_limit
        self._plan_heard: float | None = None
        self._object_heard: float | None = None
        self._phase = PlanState.IDLE
        self._planners_tap = False

    def begin_tap(self) -> None:
        """A tap was commanded: whose it is shows in what the planner says from now on."""
        self._planners_tap = False

    def on_plan(self, message: PlanState) -> None:
        """Hear ``plan_state``."""
        self._phase = message.state
        self._plan_heard = time.monotonic()
        if message.state in TAPPING:
            self._planners_tap = True

    def on_object(self, message: ObjectState, now: Time) -> None:
        """Hear ``object_state`` at ``now`` of the clock that stamps pictures."""
        if message.error_code in BLIND:
            return
        taken = Time.from_msg(message.header.stamp)
        # A stamp of zero means that none was given.
        age = 1e-9 * (now - taken).nanoseconds if taken.nanoseconds else 0.0
        self._object_heard = time.monotonic() - max(age, 0.0)

    def given_up(self) -> Trouble | None:
        """Why the tap under way is nobody's any more: its planner does something else."""
        if self._planners_tap and self._phase not in TAPPING:
            return (
                ErrorCode.NOT_READY,
                "the planner that commanded the tap no longer waits for it; it was restarted or"
                " gave the tap up",
            )
        return None

    def missing(self) -> Trouble | None:
        """Who has fallen silent; None where nobody has."""
        now = time.monotonic()
        of_planner = self._limit if self._planners_tap else max(self._limit, IDLE_LIMIT_S)
        for heard, limit, code, sentence in (
            (
                self._plan_heard,
                of_planner,
                ErrorCode.NOT_READY,
                "the planner has been silent for {:.2f} s, more than {:.2f} s: look after its node",
            ),
            (
                self._object_heard,
                self._limit,
                ErrorCode.CAMERA_SILENT,
                "the camera's last usable picture is {:.2f} s old, more than {:.2f} s: look after"
                " the camera, its node and, where they run on two machines, their clocks",
            ),
        ):
            if heard is not None and now - heard > limit:
                return code, sentence.format(now - heard, limit)
        return None
