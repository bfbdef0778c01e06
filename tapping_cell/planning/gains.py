"""Learning, tap by tap, by how much the object's answers differ from the model's.

Three numbers per object: the gain of the distance, the gain of the rotation and a steady error of
direction. Each is the state of a scalar Kalman filter. A tap commanded as (d, turn, direction) and
measured as (d', turn', direction') says

    d'         = gain_d d + N(0, (scatter d)^2 + camera)
    turn'      = gain_t turn + N(0, (scatter turn)^2 + camera)
    direction' = direction + error + N(0, scatter^2 + camera / d^2)

so a tap weighs as much as its own scatter and the camera allow, and a tap without rotation says
nothing about the rotation's gain. A measurement that is improbable under all of this (a bumped
object, a striker that missed) is not taken; each such refusal widens the filter, so that a true
sudden change is believed after a few taps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import CameraNoise, Scatter
from tapping_cell.se2 import wrap_angle

NAMES = ("distance", "rotation", "direction")
START = np.array([1.0, 1.0, 0.0])
START_DEVIATION = np.array([0.06, 0.10, 0.01])
"""What is believed of an object never tapped before: 6 %, 10 %, 0.6 degrees (0.01 rad)."""

LOWEST = np.array([0.5, 0.4, -0.35])
HIGHEST = np.array([2.0, 2.5, 0.35])

GATE = 4.0
"""Deviations beyond which a measurement is an outlier."""

WIDENING = 2.0
"""Factor of the variances after an outlier, up to 25 times those of the start."""


@dataclass(frozen=True, slots=True)
class Gains:
    """What has been learnt about one object, or about many at once (leading axes).

    value, variance: shape (..., 3), in the order distance (measured over commanded), rotation
        (measured over commanded), direction (measured less commanded, rad).
    taken, outliers: shape (...), how many taps were believed and how many not.
    """

    value: Array
    variance: Array
    taken: Array
    outliers: Array

    @classmethod
    def start(cls, shape: tuple[int, ...] = ()) -> Gains:
        """Gains of objects never tapped before."""
        return cls(
            np.broadcast_to(START, (*shape, 3)).copy(),
            np.broadcast_to(START_DEVIATION**2, (*shape, 3)).copy(),
            np.zeros(shape),
            np.zeros(shape),
        )

    def of(self, rows: NDArray[np.intp]) -> Gains:
        """The gains of some of many objects."""
        return Gains(self.value[rows], self.variance[rows], self.taken[rows], self.outliers[rows])

    def put(self, rows: NDArray[np.intp], gains: Gains) -> None:
        """Replace the gains of some of many objects."""
        for name in ("value", "variance", "taken", "outliers"):
            getattr(self, name)[rows] = getattr(gains, name)

    def to_plan(self, remaining: ArrayLike) -> tuple[Array, Array, Array]:
        """What remains, (..., 3) as dx, dy (m) and rotation (rad), as planning methods see it.

        Returns the distance (m), the rotation (rad) in the units in which the cone has its nominal
        slope, and the heading to command (rad). The distance stays true, so that the box and the
        smallest tap keep their size.
        """
        left = np.asarray(remaining, dtype=float)
        turn = left[..., 2] * self.value[..., 0] / self.value[..., 1]
        heading = np.arctan2(left[..., 1], left[..., 0]) - self.value[..., 2]
        return np.hypot(left[..., 0], left[..., 1]), turn, heading

    def command(self, distance: ArrayLike, rotation: ArrayLike, heading: ArrayLike) -> Array:
        """Displacements (..., 3) to ask of the mechanics, for taps in the units of ``to_plan``."""
        length = np.asarray(distance, dtype=float) / self.value[..., 0]
        turn = np.asarray(rotation, dtype=float) / self.value[..., 0]
        return np.stack([length * np.cos(heading), length * np.sin(heading), turn], axis=-1)

    def predict(self, commanded: ArrayLike) -> Array:
        """The displacement, (..., 3), that a commanded one is expected to make."""
        command = np.asarray(commanded, dtype=float)
        cos, sin = np.cos(self.value[..., 2]), np.sin(self.value[..., 2])
        dx, dy = command[..., 0] * self.value[..., 0], command[..., 1] * self.value[..., 0]
        return np.stack(
            [cos * dx - sin * dy, sin * dx + cos * dy, command[..., 2] * self.value[..., 1]],
            axis=-1,
        )

    def observe(
        self, commanded: ArrayLike, measured: ArrayLike, scatter: Scatter, camera: CameraNoise
    ) -> Gains:
        """The gains after one tap.

        Args:
            commanded: dx, dy (m) and rotation (rad) asked of the striker, table frame, (..., 3).
            measured: what the camera saw of it, (..., 3). A row that is not finite is an outlier.
            scatter: of a tap, one standard deviation.
            camera: one look's deviation; two looks make one measured displacement.
        """
        command, seen = np.asarray(commanded, dtype=float), np.asarray(measured, dtype=float)
        usable = np.all(np.isfinite(seen), axis=-1) & np.all(np.isfinite(command), axis=-1)
        seen = np.where(usable[..., None], seen, 0.0)
        command = np.where(usable[..., None], command, 0.0)
        distance = np.hypot(command[..., 0], command[..., 1])
        heading = np.arctan2(command[..., 1], command[..., 0])
        ones = np.ones_like(distance)
        slope = np.stack([distance, command[..., 2], ones], axis=-1)
        answer = np.stack(
            [
                np.hypot(seen[..., 0], seen[..., 1]),
                seen[..., 2],
                wrap_angle(np.arctan2(seen[..., 1], seen[..., 0]) - heading),
            ],
            axis=-1,
        )
        look = np.array([camera.position, camera.angle, camera.position])
        arm = np.stack([ones, ones, 1.0 / np.maximum(distance, 1e-6)], axis=-1)
        share = np.array([scatter.distance, scatter.rotation, scatter.direction])
        noise = (share * slope) ** 2 + 2.0 * (look * arm) ** 2 + 1e-18

        surprise = answer - slope * self.value
        total = slope**2 * self.variance + noise
        believed = usable & (distance > 0.0) & np.all(surprise**2 <= GATE**2 * total, axis=-1)
        weight = slope * self.variance / total
        learnt = np.clip(self.value + weight * surprise, LOWEST, HIGHEST)
        narrowed = (1.0 - weight * slope) * self.variance
        widened = np.maximum(
            np.minimum(WIDENING * self.variance, 25.0 * START_DEVIATION**2), self.variance
        )
        take = believed[..., None]
        return Gains(
            np.where(take, learnt, self.value),
            np.where(take, narrowed, widened),
            self.taken + believed,
            self.outliers + ~believed,
        )

    def as_numbers(self) -> dict[str, float]:
        """Plain numbers for a file (one object): value and deviation of each gain, SI."""
        deviation = np.sqrt(self.variance)
        return {
            key: float(number)
            for index, name in enumerate(NAMES)
            for key, number in (
                (name, self.value[index]),
                (f"{name}_deviation", deviation[index]),
            )
        }

    @classmethod
    def from_numbers(cls, numbers: dict[str, float]) -> Gains:
        """Gains kept by ``as_numbers``, for the same object in a later run.

        Raises:
            PlanningError: a number is missing, not finite or outside its bounds.
        """
        value, deviation = np.empty(3), np.empty(3)
        for index, name in enumerate(NAMES):
            kept, spread = numbers.get(name), numbers.get(f"{name}_deviation")
            widest = 5.0 * START_DEVIATION[index]
            if (
                not isinstance(kept, int | float)
                or not isinstance(spread, int | float)
                or not LOWEST[index] <= kept <= HIGHEST[index]
                or not 0.0 <= spread <= widest * (1.0 + 1e-9)
            ):
                raise PlanningError(
                    f"the kept gain of {name} is {kept!r} with deviation {spread!r}; allowed is "
                    f"{LOWEST[index]:g} to {HIGHEST[index]:g} with 0 to {widest:g}; delete the "
                    "file to start afresh"
                )
            value[index], deviation[index] = kept, spread
        return cls(value, deviation**2, np.zeros(()), np.zeros(()))
