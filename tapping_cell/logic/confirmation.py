"""Confirmation of planned taps by a person, and how long it remains valid.

If a confirmed tap is not fired because a message or image came too late, the tap is planned again.
The confirmation remains valid if the new tap is nearly the same as the confirmed tap. Otherwise, a
new confirmation is requested, and the request states the difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from tapping_cell.logic.task import Shot, Task
from tapping_cell.se2 import Pose

HOLDS_S = 20.0
"""Time for which a confirmation remains valid, s. A tap long after the confirmation could surprise
the operator."""
OBJECT_M, OBJECT_RAD = 0.0005, math.radians(0.5)
"""Maximum displacement of the object from its pose in the confirmed plan."""
STRIKE_M, STRIKE_RAD = 0.001, math.radians(1.0)
"""Maximum difference between the strike poses of the confirmed tap and the new tap, and between the
predicted poses of the object."""
SPEED_SHARE = 0.05
"""Maximum relative difference of the striker's speeds."""


@dataclass(frozen=True, slots=True)
class Confirmation:
    """A tap that a person confirmed at the steady time ``at``, s.

    ``withdrawn``: why the confirmation is no longer valid for any plan; empty if it may still
    be valid.
    """

    shot: Shot
    at: float
    withdrawn: str = ""

    def difference(self, planned: Shot, now: float) -> str:
        """Return why the confirmation is not valid for a newly planned tap at the steady time
        ``now``; an empty text if it is valid."""
        confirmed = self.shot
        old, new = confirmed.strike.plan, planned.strike.plan
        if self.withdrawn:
            return self.withdrawn
        if now - self.at > HOLDS_S:
            return f"the confirmation is more than {HOLDS_S:.0f} s old"
        if (confirmed.object_id, old.tapper) != (planned.object_id, new.tapper):
            return "another object or tapper was chosen"
        poses = (
            ("the object has moved", confirmed.before, planned.before, OBJECT_M, OBJECT_RAD),
            ("the strike differs", old.strike_pose, new.strike_pose, STRIKE_M, STRIKE_RAD),
            (
                "the predicted pose differs",
                confirmed.strike.predicted,
                planned.strike.predicted,
                STRIKE_M,
                STRIKE_RAD,
            ),
        )
        for words, one, other, distance, angle in poses:
            if _apart(one, other, distance, angle):
                return (
                    f"{words} by {1e3 * one.distance_to(other):.2f} mm and "
                    f"{abs(math.degrees(one.rotation_to(other))):.2f} deg (limits "
                    f"{1e3 * distance:.1f} mm and {math.degrees(angle):.1f} deg)"
                )
        if abs(new.striker_speed - old.striker_speed) > SPEED_SHARE * old.striker_speed:
            return (
                f"the striker's speed changed from {1e3 * old.striker_speed:.0f} to "
                f"{1e3 * new.striker_speed:.0f} mm/s"
            )
        return ""


def _apart(one: Pose, other: Pose, distance: float, angle: float) -> bool:
    return one.distance_to(other) > distance or abs(one.rotation_to(other)) > angle


class Confirmations:
    """Whether a person confirms the taps, and the last tap that a person confirmed."""

    def __init__(self, ask: bool) -> None:
        self._ask = ask
        self._ask_resumed = False
        self._confirmed: Confirmation | None = None

    @property
    def always(self) -> bool:
        """Whether a person confirms the taps of every goal."""
        return self._ask or self._ask_resumed

    def asks(self, task: Task | None) -> bool:
        """Return whether a person confirms the taps of ``task`` (None: of the next goal)."""
        return self._ask or (task is not None and (task.ask or self._ask_resumed))

    def change(self, ask: bool) -> None:
        """Set whether a person confirms the taps that are planned from now on."""
        self._ask, self._ask_resumed = ask, False

    def resume(self, always: bool) -> None:
        """Set whether the planner that crashed was to ask before every tap. This applies to the
        resumed goal until somebody changes ``ask``."""
        self._ask_resumed = always

    def begin(self, resumed: bool) -> None:
        """Begin a goal. ``resumed``: whether it is the goal of a planner that crashed."""
        self._ask_resumed = self._ask_resumed and resumed

    def confirm(self, shot: Shot, steady: float) -> None:
        """Store that a person has confirmed this tap; ``steady``: time, s."""
        self._confirmed = Confirmation(shot, steady)

    def forget(self) -> None:
        """End the validity of the last confirmation."""
        self._confirmed = None

    def withdraw(self, sentence: str) -> None:
        """Ask a person again before the next tap, because the confirmed tap was not fired for the
        reason ``sentence``. An earlier reason remains."""
        if self._confirmed is not None and not self._confirmed.withdrawn:
            why = f"the confirmed tap was not fired ({sentence})"
            self._confirmed = replace(self._confirmed, withdrawn=why)

    def holds(self, shot: Shot, steady: float) -> tuple[bool, str]:
        """Return whether a person has confirmed this tap in an earlier plan that was not fired, and
        what to write to the log."""
        confirmed = self._confirmed
        if confirmed is None:
            return False, ""
        difference = confirmed.difference(shot, steady)
        if difference:
            self._confirmed = None
            shot.asked_again = f"asked again because {difference}"
            return False, f"tap {shot.number} must be confirmed again: {difference}"
        return True, (
            f"tap {shot.number} differs from the confirmed tap by less than the limits; its "
            "confirmation remains valid"
        )
