"""Durations of the arm's motions before and after a tap, computed from the commanded moves."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.hardware.motion import (
    MotionSettings,
    path_duration,
    raise_step,
    strike_durations,
)
from tapping_cell.hardware.scara import Branch, Joints
from tapping_cell.logic.withdrawal import Scene, withdrawal
from tapping_cell.planning import Strike
from tapping_cell.se2 import Array, Pose, compose

REST_S = 0.30
"""Duration of a tap without the arm's moves: settling, firing, observation and messages."""
SIDEWAYS_S = 0.25
"""Mean duration of the move from above a strike pose to a pose at which the camera sees the object,
s."""
HEADINGS = np.arange(12) * (2.0 * math.pi / 12)
"""Headings, rad, of strikes around the table's centre; times are averaged over these strikes."""


class ArmTimes:
    """Implementation of ``planning.tap_times.TapTimes`` for a cell's arm. ``camera``: position of
    the lens in ``table``, m; only ``tap`` uses it."""

    def __init__(self, cell: Cell, camera: tuple[float, float, float] | None = None) -> None:
        self._cell = cell
        self._geometry = cell.arm.geometry()
        self._motion: MotionSettings = cell.arm.motion()
        self._into_base = cell.arm_base.inverse()
        self._camera = camera
        far = cell.file.tapper.standoff + cell.object.body().bounding_radius
        middle = np.stack([-far * np.cos(HEADINGS), -far * np.sin(HEADINGS), HEADINGS], axis=-1)
        ways = self._ways(middle[:, None], middle[None, :])
        known = ways[np.isfinite(ways)]
        self.mean_way = float(known.mean()) if known.size else 0.0
        """See ``TapTimes``."""
        low = self._joints(middle, cell.arm.strike_height)
        low = low[np.all(np.isfinite(low), axis=-1)]
        rising = [
            path_duration(
                self._geometry, joints, (raise_step(self._geometry, joints, self._motion),)
            )
            for joints in (Joints(*row) for row in low.tolist())
        ]
        self.mean_tap = self.mean_way + float(np.mean(rising or [0.0])) + SIDEWAYS_S + REST_S
        """See ``TapTimes``."""

    def to_strikes(self, tip: ArrayLike, strikes: ArrayLike) -> Array:
        """See ``TapTimes``."""
        place = np.asarray(tip, dtype=float)
        here = self._joints(place[[0, 1, 3]], float(place[2]))
        return strike_durations(self._geometry, here, self._tips(strikes), self._motion)

    def between(self, strikes: ArrayLike, following: ArrayLike) -> Array:
        """See ``TapTimes``. The arm is assumed to withdraw straight up."""
        ways = self._ways(strikes, following)
        return np.where(np.isfinite(ways), ways, self.mean_way)

    @property
    def parked(self) -> Array:
        """Tip of the parked arm: x, y, height and yaw in ``table``."""
        return self._tip(self._motion.park)

    def tap(self, tip: Array, before: Pose, strike: Strike) -> tuple[float, Array]:
        """Return the duration of a tap in s and the tip's pose (4,) after it. ``tip``: the tip's
        pose (4,) before the tap.

        ``before``: pose of the object for which the tap was planned.
        """
        at = np.asarray(strike.plan.strike_pose)
        seconds = float(self.to_strikes(tip, at))
        low = Joints(*self._joints(at, self._cell.arm.strike_height).tolist())
        scene = None
        if self._camera is not None:
            scene = Scene(self._camera, before, strike.predicted, strike.plan.strike_pose)
        path = withdrawal(self._cell, scene, low, self._motion)
        seconds += path_duration(self._geometry, low, path) + REST_S
        return seconds, self._tip(path[-1].joints if path else low)

    def _ways(self, strikes: ArrayLike, following: ArrayLike) -> Array:
        raised = self._joints(np.asarray(strikes, dtype=float), self._motion.travel_height)
        return strike_durations(self._geometry, raised, self._tips(following), self._motion)

    def _tips(self, strikes: ArrayLike, height: float | None = None) -> Array:
        planar = compose(self._into_base, np.asarray(strikes, dtype=float))
        z = np.full(planar.shape[:-1], self._cell.arm.strike_height if height is None else height)
        return np.stack([planar[..., 0], planar[..., 1], z, planar[..., 2]], axis=-1)

    def _joints(self, poses: Array, height: float) -> Array:
        """Return the joints (..., 4) that bring the tip to poses (..., 3) in ``table``; NaN if out
        of reach. The elbow is on the same side as in the park pose if possible."""
        tips, park = self._tips(poses, height), self._motion.park
        own = self._geometry.branch_of(park)
        other = next(side for side in Branch if side is not own)
        first, second = (
            self._geometry.inverse_many(tips, side, park).joints for side in (own, other)
        )
        return np.where(np.isfinite(first), first, second)

    def _tip(self, joints: ArrayLike) -> Array:
        x, y, z, yaw = self._geometry.forward_many(joints)
        planar = self._cell.arm_base @ Pose(float(x), float(y), float(yaw))
        return np.array([planar.x, planar.y, z, planar.theta])


def arm_times(cell: Cell) -> ArmTimes | None:
    """Return the times of a cell's arm; None if the cell has no arm, or if the configured arm
    cannot reach the strike poses. In the second case, the arm's driver reports the cause, and no
    tap is commanded."""
    if cell.file.arm is None:
        return None
    try:
        return ArmTimes(cell)
    except HardwareFault:
        return None
