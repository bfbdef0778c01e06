"""Settings of a planning method: the cone of taps, their scatter, the camera and the box.

All lengths are in metres and all angles in radians. The defaults are the numbers of the paper's
cell: a cone of 10 degrees per 30 mm (Huang and Mason, section 4: the task needs three times the
rotation of one tap), a smallest tap of 1.7 mm (section 4), and scatter of 5 % of the distance
and 15 % of the rotation (section 3.1.1 gives up to 5 % of the initial speed, which is 10 % of the
distance, and 15 % of the initial spin).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.mechanics import Tap
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.stopping import (
    LONG_OBSERVATION,
    Array,
    Arrival,
    StoppingBox,
    arrival,
    stopping_box,
)

VARIANTS = ("retreat", "overshoot")
SMALLEST_POSITION_TOLERANCE, LARGEST_POSITION_TOLERANCE = 1e-5, 0.1
"""Minimum and maximum position tolerance of a goal, m."""
LARGEST_ANGLE_TOLERANCE = 1.5
"""Maximum angle tolerance of a goal, rad."""
LARGEST_NOISE, LARGEST_ANGLE_NOISE = 0.01, 0.1
"""Maximum nominal noise of a camera, m and rad. A larger value is most likely in mm or degrees."""


def _check_range(owner: object, name: str, low: float, high: float, unit: str) -> None:
    value = getattr(owner, name)
    if not (isinstance(value, int | float) and low <= value <= high):
        raise PlanningError(
            f"{type(owner).__name__}.{name} is {value!r}; it must be {low:g} to {high:g} {unit}; "
            "correct it in the configuration"
        )


@dataclass(frozen=True, slots=True)
class Scatter:
    """Standard deviations of a tap's result.

    distance, rotation: shares of the tap's distance and rotation. direction: rad. The default
    values are assumptions; Huang and Mason (section 3.1.1) measured the scatter of the initial
    velocities (see above). position_floor (m, along and across the tap), angle_floor (rad): parts
    that do not decrease with the size of the tap.
    """

    distance: float = 0.05
    rotation: float = 0.15
    direction: float = math.radians(1.0)
    position_floor: float = 0.0
    angle_floor: float = 0.0

    def along(self, distance: ArrayLike) -> Array:
        """Return the standard deviations, m, of the end position along the tap, for taps of these
        distances in m."""
        return np.hypot(self.distance * np.asarray(distance), self.position_floor)

    def across(self, distance: ArrayLike) -> Array:
        """Return the standard deviations, m, of the end position across the tap, for taps of these
        distances in m."""
        return np.hypot(self.direction * np.asarray(distance), self.position_floor)

    def turning(self, rotation: ArrayLike) -> Array:
        """Return the standard deviations of the rotation, for taps with these rotations, rad."""
        return np.hypot(self.rotation * np.asarray(rotation), self.angle_floor)

    def at_least(self, other: Scatter) -> Scatter:
        """Return, for each standard deviation, the larger of the values of this scatter and of
        ``other``."""
        return Scatter(*(max(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)))

    def __post_init__(self) -> None:
        """Refuse values out of range (PlanningError)."""
        _check_range(self, "distance", 0.0, 1.0, "(share of the distance)")
        _check_range(self, "rotation", 0.0, 1.0, "(share of the rotation)")
        _check_range(self, "direction", 0.0, 0.5, "rad")
        _check_range(self, "position_floor", 0.0, 0.05, "m")
        _check_range(self, "angle_floor", 0.0, 0.5, "rad")


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """Standard deviations of a stationary observation: position (each axis, m) and angle (rad)."""

    position: float = 0.0
    angle: float = 0.0

    @property
    def deviations(self) -> Array:
        """Standard deviations of an observation's x, y (m) and angle (rad), (3,)."""
        return np.array([self.position, self.position, self.angle])

    @property
    def covariance(self) -> Array:
        """Covariance of an observation, (3, 3), m and rad."""
        return np.diag(self.deviations**2)

    def __post_init__(self) -> None:
        """Refuse values out of range (PlanningError)."""
        _check_range(self, "position", 0.0, 0.1, "m")
        _check_range(self, "angle", 0.0, 1.0, "rad")


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """All inputs of a planning method; equal settings give equal plans.

    cone_slope: largest rotation per distance of a tap, rad/m.
    smallest_distance, largest_distance: limits of the distance of one tap, m.
    tolerance_position, tolerance_angle: allowed final error, m and rad.
    box: size of the stopping box as a share of the tolerance, independent of the camera's noise,
        for planning and stopping. If None, the session stops according to the probability that the
        object is within the tolerance, and plans are made for the box within which a long
        observation confirms the goal.
    variant: two-tap plan of ``exact`` and ``conservative``: "retreat" first taps away from the
        goal, "overshoot" first taps past it.
    error_line: half length of a tap's error line as a share of its rotation, for ``conservative``
        and ``multi``; None uses the method's default (0.3 and 0.6).
    """

    cone_slope: float = math.radians(10.0) / 0.030
    smallest_distance: float = 0.0017
    largest_distance: float = 0.120
    scatter: Scatter = field(default_factory=Scatter)
    camera: CameraNoise = field(default_factory=CameraNoise)
    tolerance_position: float = 0.001
    tolerance_angle: float = math.radians(1.0)
    box: float | None = None
    variant: str = "overshoot"
    error_line: float | None = None

    def __post_init__(self) -> None:
        """Refuse values out of range (PlanningError names the value and the range)."""
        _check_range(self, "cone_slope", 1e-3, 1e3, "rad/m")
        _check_range(self, "smallest_distance", 1e-5, 0.1, "m")
        _check_range(self, "largest_distance", 2.0 * self.smallest_distance, 2.0, "m")
        smallest, largest = SMALLEST_POSITION_TOLERANCE, LARGEST_POSITION_TOLERANCE
        _check_range(self, "tolerance_position", smallest, largest, "m")
        _check_range(self, "tolerance_angle", 1e-5, LARGEST_ANGLE_TOLERANCE, "rad")
        camera = self.camera
        if not isinstance(camera, CameraNoise):
            raise PlanningError(
                f"the camera is {camera!r}; give CameraNoise(position, angle), m, rad"
            )
        if camera.position > LARGEST_NOISE or camera.angle > LARGEST_ANGLE_NOISE:
            angle, most = math.degrees(camera.angle), math.degrees(LARGEST_ANGLE_NOISE)
            raise PlanningError(
                f"the camera noise is {1e3 * camera.position:g} mm and {angle:g} degrees; the "
                f"limits are {1e3 * LARGEST_NOISE:g} mm and {most:.3g} degrees; check the unit (m "
                "and rad in Python, mm and degrees in options)"
            )
        if self.box is not None:
            _check_range(self, "box", 0.05, 1.0, "(share of the tolerance)")
        if self.error_line is not None:
            _check_range(self, "error_line", 0.0, 0.95, "(share of the rotation)")
        if self.variant not in VARIANTS:
            raise PlanningError(
                f"PlannerSettings.variant is {self.variant!r}; choose one of {', '.join(VARIANTS)}"
            )

    @property
    def stopping(self) -> StoppingBox:
        """Box that plans are made for: the box within which a long observation confirms the
        goal."""
        longer = math.sqrt(LONG_OBSERVATION)
        return stopping_box(
            self.tolerance_position,
            self.tolerance_angle,
            self.camera.position / longer,
            self.camera.angle / longer,
            self.box,
        )

    def arrival(self, residual: ArrayLike, covariance: ArrayLike) -> Arrival:
        """Decide whether objects are at their goals (see ``stopping.arrival``)."""
        return arrival(
            residual, covariance, self.tolerance_position, self.tolerance_angle, self.box
        )

    def within_tolerance(self, residual: ArrayLike) -> NDArray[np.bool_]:
        """Return whether residuals (..., 3), m and rad, are within the tolerance (...)."""
        left = np.asarray(residual, dtype=float)
        near = np.hypot(left[..., 0], left[..., 1]) <= self.tolerance_position
        return np.asarray(near & (np.abs(left[..., 2]) <= self.tolerance_angle))

    @classmethod
    def for_tap(cls, tap: Tap, camera: CameraNoise, **others: Any) -> PlannerSettings:
        """Return settings with the cone and the smallest distance of an object's mechanics.

        ``camera``: noise of one observation; ``CameraNoise()`` for a perfect camera.

        The cone is made slightly narrower, so that a tap on its edge is not rejected because of
        rounding errors.
        """
        return cls(
            cone_slope=tap.cone_slope * (1.0 - 1e-6),
            smallest_distance=tap.smallest_distance * (1.0 + 1e-6),
            camera=camera,
            **others,
        )

    def key(self) -> str:
        """Return a string that identifies a plan: two strings are equal if and only if the settings
        are equal."""
        return ";".join(f"{item.name}={getattr(self, item.name)!r}" for item in fields(self))
