"""The cycle of one tap of the arm: go to the strike pose, stand still there, leave it once the
striker is no longer charged, and withdraw until the camera sees the object.

Each method takes the record of the present state, and yields jobs and the record of the next state.
The caller carries them out in this order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.motion import MotionSettings, Waypoint
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic import arm_jobs
from tapping_cell.logic.arm_jobs import MotionEnd, Reading
from tapping_cell.logic.arm_states import (
    Event,
    InPosition,
    Leaving,
    Placing,
    Serving,
    Steps,
    Tap,
    Withdrawing,
)
from tapping_cell.logic.clock import Now
from tapping_cell.logic.device import Abandon, Run
from tapping_cell.logic.standing_still import StandingStill
from tapping_cell.logic.transitions import Go
from tapping_cell.logic.withdrawal import Scene, hides_object, uncovering, withdrawal

SHORT_REST_S = 0.05
"""Time, s, before the end of the promise to stand still at which the arm begins to prepare its next
move."""
SET_UP_SPEED = 0.25
"""Fraction of the ordinary speed in set-up mode."""


class ArmCycle:
    """See the module's docstring."""

    _cell: Cell

    def __init__(self, still: StandingStill, set_up: bool) -> None:
        """``still``: until when the arm must stand still; ``set_up``: whether the arm moves
        slowly."""
        self._still = still
        self._set_up = set_up

    def configure(self, cell: Cell) -> None:
        """Use the geometry and the speeds of this cell."""
        self._cell = cell

    def motion(self) -> MotionSettings:
        """Return the settings of every motion."""
        motion = self._cell.arm.motion()
        if not self._set_up:
            return motion
        return replace(
            motion,
            travel_speed=SET_UP_SPEED * motion.travel_speed,
            near_speed=SET_UP_SPEED * motion.near_speed,
        )

    def begin(self, tap: Tap, now: Now) -> Steps:
        """Go to the strike pose of a tap."""
        yield Go(Event.TAP, Placing(tap_id=tap.tap_id, tap=tap))
        place = partial(
            arm_jobs.place,
            tip=tap.strike,
            motion=self.motion(),
            expiry=tap.expiry,
            not_before=self._still.free_at(now),
            hides=partial(hides_object, self._cell, tap.scene),
        )
        yield Run("place", place)

    def placed(self, at: Placing, end: MotionEnd, now: Now) -> Steps:
        """Handle the end of the job that moves the tip to the strike pose."""
        if end.complete:
            here = InPosition(tap_id=at.tap_id, tap=at.tap, joints=end.reading.joints)
            yield Go(Event.PLACED, here)
        else:
            yield from self.give_up(at, now)

    def checked(self, at: InPosition, reading: Reading) -> InPosition:
        """Return the record after the check that the arm stays where it was placed."""
        arm = self._cell.arm
        angle, quill = 2 * arm.tolerance_angle, 2 * arm.tolerance_quill
        limits = (angle, angle, quill, angle)
        near = all(
            abs(a - b) <= limit
            for a, b, limit in zip(reading.joints, at.joints, limits, strict=True)
        )
        stays = reading.homed and near and not reading.moving
        return replace(at, deviating=0 if stays else at.deviating + 1)

    def check_expiry(self, at: Serving | None, now: Now) -> Steps:
        """Leave the strike pose if the planner did not withdraw the tap in time; its node may have
        ended."""
        if isinstance(at, InPosition) and now.ros > at.tap.expiry:
            yield from self.give_up(at, now)

    def give_up(self, at: Placing | InPosition, now: Now) -> Steps:
        """End the tap. The arm leaves the strike pose once it no longer has to stand still."""
        left = Leaving(tap_id=at.tap_id, since=now.steady, scene=at.tap.scene)
        yield Go(Event.GIVEN_UP, left)
        yield Abandon()

    def leave_when_free(self, at: Serving | None, now: Now) -> Steps:
        """Withdraw once the arm no longer has to stand still. No other job may be under way."""
        # While the striker is charged, the arm waits, but not longer than LONGEST_WAIT_S.
        if not isinstance(at, Leaving) or self._still.waits_for_striker(at.since, now):
            return
        # The job may start shortly before the arm is free to move: it reads the joints, then waits
        # until the promise to stand still has ended.
        if now.steady >= self._still.until - SHORT_REST_S:
            yield from self._withdraw(Event.FREE, at.tap_id, at.scene, now)

    def withdraw_again(self, at: Serving | None) -> Steps:
        """Make the present withdrawal end at the park pose, because the arm hides the object."""
        if isinstance(at, Leaving):
            yield Go(None, replace(at, scene=None))
        elif isinstance(at, Withdrawing):
            yield Go(None, replace(at, then_park=at.scene is not None))

    def park(self, tap_id: int, now: Now) -> Steps:
        """Move to the park pose."""
        yield from self._withdraw(Event.PARK, tap_id, None, now)

    def clear_view(self, camera: tuple[float, float, float] | None, now: Now) -> Steps:
        """Uncover the area that the arm hides from the camera now. ``camera``: position of the lens
        in ``table``, m."""
        yield Go(Event.CLEAR_VIEW, Withdrawing(tap_id=0, scene=None))
        yield self._move_away(partial(uncovering, self._cell, camera, motion=self.motion()), now)

    def _withdraw(self, event: Event, tap_id: int, scene: Scene | None, now: Now) -> Steps:
        yield Go(event, Withdrawing(tap_id=tap_id, scene=scene))
        yield self._move_away(partial(withdrawal, self._cell, scene, motion=self.motion()), now)

    def _move_away(self, plan: Callable[[Joints], Sequence[Waypoint]], now: Now) -> Run:
        """Return a move along the path that ``plan`` computes from the joint values of the arm at
        rest."""
        return self.when_free("withdraw", partial(arm_jobs.withdraw, plan=plan), now)

    def when_free(self, name: str, motion: Callable[..., MotionEnd], now: Now) -> Run:
        """Return a job that moves the arm as soon as the arm need not stand still any longer and
        the striker is no longer charged."""
        not_before = self._still.free_at(now)
        return Run(name, partial(motion, not_before=not_before, free_at=self._still.free_at))
