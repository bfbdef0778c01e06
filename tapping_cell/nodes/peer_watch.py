"""Who must be heard for a tapper to be drawn: the planner and the camera."""

from __future__ import annotations

import time

from tapping_cell_msgs.msg import ErrorCode, ObjectState, PlanState

TAPPING = (PlanState.PLACING, PlanState.FIRING)
"""Phases of a planner that waits for its tap."""

IDLE_LIMIT_S = 1.5
"""A planner whose tap it is not speaks twice a second: it is missed only after so long."""

Trouble = tuple[int, str]
"""An error code and a sentence."""


class PeerWatch:
    """When planner and camera were last heard, and whether the planner still wants its tap.

    One that has never been heard is not missed: a person or a program may command single taps
    without it. One that was heard and falls silent is lost, hung processes included. Written by the
    executor, read by the worker too: each field is assigned at once.
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

    def on_object(self, message: ObjectState) -> None:
        """Hear ``object_state``; that no picture comes is no word of the camera."""
        if message.error_code != ErrorCode.CAMERA_SILENT:
            self._object_heard = time.monotonic()

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
        for who, heard, code, limit in (
            ("planner", self._plan_heard, ErrorCode.NOT_READY, of_planner),
            ("camera", self._object_heard, ErrorCode.CAMERA_SILENT, self._limit),
        ):
            if heard is not None and now - heard > limit:
                return (
                    code,
                    f"the {who} has been silent for {now - heard:.2f} s, more than"
                    f" {limit:.2f} s: look after its node",
                )
        return None
