"""Compute how far a launched body slides and rotates, and the launch for a given displacement.

The equations are, with R the radius of the support, gamma = m R^2 / I, mu the friction with the
table and kappa the torque factor of Huang and Mason (section 3.1.2):

    dv/dt = -mu g F,   d omega/dt = -kappa gamma (mu g / R) T.

``support_friction`` computes F and T, ``slide_solution`` and ``slide_table`` solve the equations
for a round support, and ``polygon_sliding`` solves them for a polygon. Everything is in SI units.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.mechanics.bodies import Body, Polygon
from tapping_cell.mechanics.errors import InvalidParameterError, finite, positive
from tapping_cell.mechanics.planar import Array
from tapping_cell.mechanics.polygon_sliding import PolygonSlide
from tapping_cell.mechanics.polygon_table import TabulatedPolygonSlide
from tapping_cell.mechanics.round_sliding import RoundSlide
from tapping_cell.mechanics.slide_results import Launch, Profile, Rest
from tapping_cell.mechanics.slide_table import slide_table

STANDARD_GRAVITY = 9.81


@dataclass(frozen=True)
class Sliding:
    """Sliding of one body on one table.

    ``friction`` is the friction coefficient between body and table, ``torque_factor`` is kappa (1
    for uncorrected theory), and ``gravity`` is in m/s^2. Raises :class:`InvalidParameterError` for
    a value that is not finite and positive.

    For a disk or a ring, the relative error of :meth:`rest` in distance, rotation and duration is
    1e-9 at torque factors of 0.2 to 5 (the tests require 1e-8). At torque factors of 0.05 to 20 it
    is 2e-8. Both figures hold for every combination of speed and spin. The reference is an
    integration with tight tolerance. For a polygon the error is 1e-4, relative to a brute-force
    integration (the tests require 1e-3). :meth:`launch` is the inverse of :meth:`rest`: exact up to
    rounding errors for round bodies, accurate to 1e-11 for polygons.
    """

    body: Body
    friction: float
    torque_factor: float = 1.0
    gravity: float = STANDARD_GRAVITY
    _model: RoundSlide | PolygonSlide = field(init=False, repr=False, compare=False)
    _axisymmetric: RoundSlide = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the parameters and create the model."""
        for name, unit in (("friction", ""), ("torque_factor", ""), ("gravity", "m/s^2")):
            value = positive(name.replace("_", " "), getattr(self, name), unit)
            object.__setattr__(self, name, value)
        deceleration = self.friction * self.gravity
        axisymmetric = RoundSlide(
            slide_table(self.body.support, self.torque_factor * self.body.gamma),
            deceleration,
            self.body.support_radius,
        )
        model: RoundSlide | PolygonSlide = axisymmetric
        if isinstance(self.body, Polygon):
            model = PolygonSlide(self.body, deceleration, self.torque_factor, axisymmetric)
        object.__setattr__(self, "_axisymmetric", axisymmetric)
        object.__setattr__(self, "_model", model)

    @property
    def axisymmetric(self) -> RoundSlide:
        """Sliding model of the body or, for a polygon, of its equivalent disk."""
        return self._axisymmetric

    def approximated(self) -> Sliding:
        """Return a copy in which a polygon slides like its equivalent disk.

        The copy is much faster, with the errors given in :meth:`Polygon.equivalent_disk`. The copy
        is intended for planners, because they evaluate hundreds of taps per decision. A round body
        is unaffected.
        """
        return self._with(self._axisymmetric)

    def tabulated(self) -> Sliding:
        """Return a copy that computes a polygon's slides from a table.

        The copy is hundreds of times faster, with errors of 1e-3 of the displacement and 1e-2 of
        the duration. The table of a new shape or torque factor takes a second or two to create, and
        is cached. A round body's slides always come from a table.
        """
        if not isinstance(self.body, Polygon):
            return self
        deceleration = self.friction * self.gravity
        return self._with(
            TabulatedPolygonSlide(self.body, deceleration, self.torque_factor, self._axisymmetric)
        )

    def _with(self, model: RoundSlide | PolygonSlide) -> Sliding:
        """Return a copy that uses another model."""
        changed = copy.copy(self)
        object.__setattr__(changed, "_model", model)
        return changed

    def rest(self, speed: ArrayLike, spin: ArrayLike, direction: ArrayLike = 0.0) -> Rest:
        """Compute where and when a slide ends, given its launch velocities: ``speed`` in m/s and
        ``spin`` in rad/s, both of either sign.

        Arguments broadcast; scalars give floats. ``direction`` (rad) is that of the launch in the
        body's frame. The direction matters only for polygons. A polygon also drifts sideways
        (``lateral``). Distance and rotation have the signs of speed and spin. For a polygon, a
        small distance or rotation may have the opposite sign. Raises :class:`InvalidParameterError`
        for values that are not finite.
        """
        return self._model.rest(speed, spin, direction)

    def launch(
        self, distance: ArrayLike, rotation: ArrayLike, direction: ArrayLike = 0.0
    ) -> Launch:
        """Compute the launch that ends after ``distance`` (m) and ``rotation`` (rad), of any sign.

        This is the inverse of :meth:`rest` with the same ``direction``; every pair of distance and
        rotation is reachable by sliding. Raises :class:`InvalidParameterError` for values that are
        not finite.
        """
        return self._model.launch(distance, rotation, direction)

    def displace(self, twist: ArrayLike) -> Array:
        """Compute the displacement (dx, dy, dtheta) of a launch, (..., 3), m and rad.

        ``twist`` (..., 3) is the launch's (vx, vy, omega) in m/s and rad/s. Twist and displacement
        are in the axes of the body's frame at the launch.
        """
        t = finite("twist", twist)
        return self._model.displace(t.reshape(-1, 3)).reshape(t.shape)

    def twist_for(self, displacement: ArrayLike) -> Array:
        """Return the twist (..., 3) whose :meth:`displace` is ``displacement`` (..., 3)."""
        d = finite("displacement", displacement)
        return self._model.twist_for(d.reshape(-1, 3)).reshape(d.shape)

    def profile(
        self, speed: ArrayLike, spin: ArrayLike, times: ArrayLike, direction: ArrayLike = 0.0
    ) -> Profile:
        """Compute velocities and displacement at ``times`` (s, from the launch, not negative).

        Results have the shape of the broadcast launches followed by the shape of the times. The
        accuracy is 1e-7 of the initial values, or 1e-4 for polygons. The speed and the distance of
        a polygon are those along ``direction``. Raises :class:`InvalidParameterError` for values
        that are not finite and for a negative time.
        """
        v, w, a = np.broadcast_arrays(
            finite("speed", speed, "m/s"),
            finite("spin", spin, "rad/s"),
            finite("direction", direction, "rad"),
        )
        t = finite("times", times, "s")
        if t.size and t.min() < 0:
            raise InvalidParameterError(f"times begin at {t.min():g} s; they must be 0 or more.")
        flat = self._model.profile(v.ravel(), w.ravel(), a.ravel(), t.ravel())
        shape = v.shape + t.shape
        return Profile(t, *(values.reshape(shape) for values in flat[1:]))
