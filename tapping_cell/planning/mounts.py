"""What is learnt of the mounts of fixed tappers: how far each line of travel is off.

A line that lies beside its place by ``offset`` (m, to the left of its direction) and is turned by
``angle`` (rad) meets an object elsewhere: direction and rotation per distance of the tap change, by
some 0.7 degrees a mm for the disk of the paper. Both are measured with every tap; a linear Gaussian
update (Kalman's) of the two numbers of the tapper that struck, with derivatives by differences of
the mechanics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.fixed_tappers import FixedStrikeSpace, FixedTapper
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import CameraNoise, Scatter
from tapping_cell.se2 import Pose, wrap_angle

OFFSET_DEVIATION, ANGLE_DEVIATION = 0.0005, math.radians(0.5)
"""Standard deviations of a mount before its first tap, m and rad."""

STEPS = np.array([1e-5, 1e-4])
"""Of the differences, m and rad."""

UNLIKELY = 16.0
"""Squared deviations (two degrees of freedom) of a measurement that is not believed."""


@dataclass(frozen=True, slots=True)
class MountBelief:
    """Offset (m) and angle (rad) of each line: mean (tappers, 2), covariance (tappers, 2, 2)."""

    mean: Array
    covariance: Array

    @classmethod
    def start(
        cls,
        tappers: int,
        offset_deviation: float = OFFSET_DEVIATION,
        angle_deviation: float = ANGLE_DEVIATION,
    ) -> MountBelief:
        """Mounts as the cell file gives them."""
        spread = np.diag([offset_deviation**2, angle_deviation**2])
        return cls(np.zeros((tappers, 2)), np.tile(spread, (tappers, 1, 1)))

    def mount(self, index: int, nominal: Pose) -> Pose:
        """Where the line of a tapper is believed to be."""
        return _moved(nominal, self.mean[index])

    def observe(
        self,
        index: int,
        tapper: FixedTapper,
        before: ArrayLike,
        moved: ArrayLike,
        rotation_gain: float,
        scatter: Scatter,
        camera: CameraNoise,
    ) -> MountBelief:
        """The belief after a tap of tapper ``index``, whose nominal mount is ``tapper.mount``.

        before: pose (3,) of the object; moved: its displacement (3,), both as seen, m and rad.
        rotation_gain: true rotation per distance over that of the mechanics, as learnt.
        """
        pose, seen = np.asarray(before, dtype=float), np.asarray(moved, dtype=float)
        distance = float(np.hypot(seen[0], seen[1]))
        look = math.sqrt(2.0) * camera.position
        if not np.all(np.isfinite(seen)) or distance <= 3.0 * look or distance < 1e-6:
            return self
        mean, spread = self.mean[index], self.covariance[index]
        shifts = np.array([[0.0, 0.0], [STEPS[0], 0.0], [0.0, STEPS[1]]])
        mounts = [_moved(tapper.mount, mean + shift) for shift in shifts]
        lines = np.array([[mount.x, mount.y, mount.theta] for mount in mounts])
        hit = tapper.tap.strike(pose, lines, 1.0)
        if bool(np.any(hit.missed)):
            return self
        heading = np.arctan2(hit.displacement[:, 1], hit.displacement[:, 0])
        slope = rotation_gain * hit.displacement[:, 2] / np.hypot(*hit.displacement[:, :2].T)
        told = np.stack([heading, slope], axis=-1)
        change = np.stack([wrap_angle(told[1:, 0] - told[0, 0]), told[1:, 1] - told[0, 1]])
        derivative = change / STEPS
        went = math.atan2(seen[1], seen[0])
        error = np.array([wrap_angle(went - told[0, 0]), seen[2] / distance - told[0, 1]])
        noise = np.diag(
            [
                scatter.direction**2 + (look / distance) ** 2,
                (scatter.rotation**2 + scatter.distance**2) * told[0, 1] ** 2
                + 2.0 * (camera.angle / distance) ** 2
                + (look / distance * told[0, 1]) ** 2,
            ]
        )
        total = derivative @ spread @ derivative.T + noise
        if float(error @ np.linalg.solve(total, error)) > UNLIKELY:
            return self
        gain = np.linalg.solve(total, derivative @ spread).T
        means, spreads = self.mean.copy(), self.covariance.copy()
        means[index] = mean + gain @ error
        spreads[index] = (np.eye(2) - gain @ derivative) @ spread
        return replace(self, mean=means, covariance=spreads)


def believed(space: FixedStrikeSpace, belief: MountBelief) -> FixedStrikeSpace:
    """A space with its mounts where they are believed to be."""
    return space.with_mounts(
        [belief.mount(index, tapper.mount) for index, tapper in enumerate(space.tappers)]
    )


def _moved(mount: Pose, off: Array) -> Pose:
    return Pose(
        mount.x - float(off[0]) * math.sin(mount.theta),
        mount.y + float(off[0]) * math.cos(mount.theta),
        mount.theta + float(off[1]),
    )
