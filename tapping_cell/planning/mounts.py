"""Online estimation of the mount errors of fixed tappers.

A mount error is an ``offset`` of the striker's line of travel (m, to the left of its direction) and
an ``angle`` (rad). A mount error changes the contact, and therefore the direction of the tap (by
about 0.7 degrees per mm for the paper's disk) and its rotation per distance. Every tap measures
this direction and this rotation. A Kalman filter estimates the offset and the angle of the tapper
that fired, with derivatives from finite differences of the mechanics.
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
"""Steps of the finite differences, m and rad."""

UNLIKELY = 16.0
"""Squared Mahalanobis distance (two degrees of freedom) above which a measurement is rejected."""


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
        """Return the belief before the first tap: the mounts of the cell file."""
        spread = np.diag([offset_deviation**2, angle_deviation**2])
        return cls(np.zeros((tappers, 2)), np.tile(spread, (tappers, 1, 1)))

    def mount(self, index: int, nominal: Pose) -> Pose:
        """Return the estimated mount of a tapper."""
        return moved_mount(nominal, *self.mean[index].tolist())

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
        """Update the belief with a tap of tapper ``index``, whose nominal mount is
        ``tapper.mount``.

        before: measured pose (3,) of the object; moved: its measured displacement (3,), m and rad.
        rotation_gain: learnt ratio of the true rotation per distance to that of the mechanics.
        """
        pose, seen = np.asarray(before, dtype=float), np.asarray(moved, dtype=float)
        distance = float(np.hypot(seen[0], seen[1]))
        camera_noise = math.sqrt(2.0) * camera.position
        if (
            not np.all(np.isfinite(seen))
            or distance <= 3.0 * math.hypot(camera_noise, scatter.position_floor)
            or distance < 1e-6
        ):
            return self
        mean, spread = self.mean[index], self.covariance[index]
        shifts = np.array([[0.0, 0.0], [STEPS[0], 0.0], [0.0, STEPS[1]]])
        lines = np.array(
            [moved_mount(tapper.mount, *shifted) for shifted in (mean + shifts).tolist()]
        )
        hit = tapper.tap.strike(pose, lines, 1.0)
        if bool(np.any(hit.missed)):
            return self
        heading = np.arctan2(hit.displacement[:, 1], hit.displacement[:, 0])
        slope = rotation_gain * hit.displacement[:, 2] / np.hypot(*hit.displacement[:, :2].T)
        predicted = np.stack([heading, slope], axis=-1)
        change = np.stack(
            [wrap_angle(predicted[1:, 0] - predicted[0, 0]), predicted[1:, 1] - predicted[0, 1]]
        )
        derivative = change / STEPS
        measured_heading = math.atan2(seen[1], seen[0])
        error = np.array(
            [wrap_angle(measured_heading - predicted[0, 0]), seen[2] / distance - predicted[0, 1]]
        )
        noise = np.diag(
            [
                (float(scatter.across(distance)) ** 2 + camera_noise**2) / distance**2,
                (scatter.rotation**2 + scatter.distance**2) * predicted[0, 1] ** 2
                + (2.0 * camera.angle**2 + scatter.angle_floor**2) / distance**2
                + (camera_noise / distance * predicted[0, 1]) ** 2,
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


def corrected_space(space: FixedStrikeSpace, belief: MountBelief) -> FixedStrikeSpace:
    """Return the space with the estimated mounts."""
    return space.with_mounts(
        [belief.mount(index, tapper.mount) for index, tapper in enumerate(space.tappers)]
    )


def moved_mount(mount: Pose, offset: float, angle: float) -> Pose:
    """Return a mount with an error: the line's offset (m, to the left of its direction) and its
    angle (rad)."""
    return Pose(
        mount.x - offset * math.sin(mount.theta),
        mount.y + offset * math.cos(mount.theta),
        mount.theta + angle,
    )
