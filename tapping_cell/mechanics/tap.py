"""A whole tap (impact and slide): its outcome (``Tap.outcome``) and its inverse (``Tap.plan``).

The body is launched along the impulse, so the desired launch determines the impulse's line of
action. This line has the direction of the velocity, and its distance from the centre of mass is (I
omega) / (m v). The contact point is where the line enters the body, and the angle of the line from
the contact normal must be within the friction cone. The striker's axis is chosen such that Routh's
method gives this impulse angle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell import se2
from tapping_cell.mechanics.bodies import Body, Polygon
from tapping_cell.mechanics.contact import Contact, first_contact
from tapping_cell.mechanics.errors import (
    InvalidParameterError,
    UnreachableDisplacementError,
    finite,
    not_negative,
)
from tapping_cell.mechanics.impact import Impact
from tapping_cell.mechanics.planar import Array, cross, rotate, to_left, to_right, turn, unit
from tapping_cell.mechanics.sliding import Sliding

# Relative tolerance for rounding errors of a displacement at a limit (of rotation or distance).
_EDGE = 1e-9
# Steps of the finite differences for the Jacobian, in m and rad.
_LENGTH_STEP = 1e-6
_ANGLE_STEP = 1e-5
_ORIGIN = (0.0, 0.0, 0.0)


class TapPlan(NamedTuple):
    """Plan of a tap for a displacement; every field has the shape of the displacements.

    ``contact_angle`` is the direction from the centre of mass to the contact point in the object's
    frame, in rad. ``strike_pose`` (..., 3) is the pose of the ball's centre in the table frame at
    the moment of contact, with x along the ball's travel. ``striker_speed`` is in m/s,
    ``incidence`` is the angle from the contact normal to the striker's axis in rad, and ``twist``
    (..., 3) is the launch (vx, vy, omega) in table axes.
    """

    contact_angle: Array
    strike_pose: Array
    striker_speed: Array
    incidence: Array
    twist: Array


def tips_at_rest(
    strike_pose: ArrayLike, standoff: float, round_position: float = 0.0, round_angle: float = 0.0
) -> Array:
    """Return poses (..., 3) of the tip ``standoff`` m behind strike poses. The returned poses are
    rounded to multiples of ``round_position`` m and ``round_angle`` rad, the resolution of an arm;
    0 means no rounding."""
    tips = np.array(strike_pose, dtype=float)
    tips[..., 0] -= standoff * np.cos(tips[..., 2])
    tips[..., 1] -= standoff * np.sin(tips[..., 2])
    if round_position > 0.0:
        tips[..., :2] = round_position * np.round(tips[..., :2] / round_position)
    if round_angle > 0.0:
        tips[..., 2] = round_angle * np.round(tips[..., 2] / round_angle)
    return tips


class TapResult(NamedTuple):
    """Result of a tap; every field has the shape of the poses.

    ``missed`` is True if the striker does not touch the object (then nothing moves). ``travel`` is
    the ball's travel, in m, until the contact; it is negative if the strike pose overlaps the
    object. The contact point ``point`` (..., 2) and the normal ``normal`` (..., 2) into the object
    are in table axes. ``incidence`` is in rad, ``normal_impulse`` and ``tangential_impulse`` in N
    s. ``twist`` (..., 3) is (vx, vy, omega) just after the impact and ``displacement`` (..., 3) is
    (dx, dy, dtheta), both in table axes.
    """

    missed: NDArray[np.bool_]
    travel: Array
    point: Array
    normal: Array
    incidence: Array
    normal_impulse: Array
    tangential_impulse: Array
    twist: Array
    displacement: Array


@dataclass(frozen=True, slots=True)
class Tap:
    """Taps on one body by one striker on one table.

    ``smallest_distance`` (m) is the shortest displacement that the tapper produces reliably, 1.7 mm
    in the paper (section 4). Raises :class:`InvalidParameterError` if ``sliding`` and ``impact``
    have different bodies.
    """

    sliding: Sliding
    impact: Impact
    smallest_distance: float = 0.0017
    _cone_slope: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.sliding.body != self.impact.body:
            raise InvalidParameterError(
                f"sliding has the body {self.sliding.body} and impact has the body "
                f"{self.impact.body}; both must have the same body."
            )
        smallest = not_negative("smallest distance", self.smallest_distance, "m")
        object.__setattr__(self, "smallest_distance", smallest)
        body = self.body
        lever = self._largest_lever()
        ratio = body.support_radius * lever / body.radius_of_gyration**2
        slope = self.sliding.axisymmetric.table.travel_ratio(ratio) / body.support_radius
        object.__setattr__(self, "_cone_slope", slope)

    @property
    def body(self) -> Body:
        """The body that is tapped."""
        return self.sliding.body

    @property
    def cone_slope(self) -> float:
        """Maximum rotation per distance of one tap, in rad/m.

        The displacements that one tap can cause form a cone. Sliding is scale-invariant, so a
        launch with the largest R omega / v = gamma sin(phi_max) has the same ratio of rotation to
        distance at any speed. For a round body the edge of the cone is therefore a straight line
        with this slope. For a polygon, the value is the largest over all contacts, computed with
        the slide of the equivalent disk; :meth:`reachable` also considers the direction of a
        displacement.
        """
        return self._cone_slope

    def outcome(
        self, object_pose: ArrayLike, strike_pose: ArrayLike, striker_speed: ArrayLike
    ) -> Array:
        """Compute the displacements (..., 3) in table axes, m and rad; 0 if the striker misses.

        Arguments as for :meth:`strike`.
        """
        return self.strike(object_pose, strike_pose, striker_speed).displacement

    def strike(
        self, object_pose: ArrayLike, strike_pose: ArrayLike, striker_speed: ArrayLike
    ) -> TapResult:
        """Compute approach, impact and slide for poses (..., 3) in the table frame.

        ``strike_pose`` is any pose of the ball's centre on its line of travel before the contact,
        with x along the travel; ``striker_speed`` is in m/s. If the pose overlaps the object, the
        contact is where its line enters the object. Raises :class:`InvalidParameterError` for
        values that are not finite or a negative speed.
        """
        held = _poses("object pose", object_pose)
        aimed = _poses("strike pose", strike_pose)
        speed = finite("striker speed", striker_speed, "m/s")
        shape = np.broadcast_shapes(held.shape[:-1], aimed.shape[:-1], speed.shape)
        held = np.broadcast_to(held, (*shape, 3))
        angle = held[..., 2]
        in_body = se2.compose(se2.inverse(held), np.broadcast_to(aimed, (*shape, 3)))
        axis = unit(in_body[..., 2])
        contact = first_contact(self.body, self.impact.striker.tip_radius, in_body[..., :2], axis)
        closing = (contact.normal * axis).sum(axis=-1)
        missed = contact.missed | (closing <= 0)
        incidence = np.where(missed, 0.0, np.arctan2(cross(contact.normal, axis), closing))
        impact = self.impact.strike(speed, incidence, _in_frame(contact.normal, contact.point))
        velocity = _from_frame(contact.normal, impact.velocity)
        hit = np.where(missed, 0.0, 1.0)
        launch = np.concatenate([velocity, impact.spin[..., None]], axis=-1) * hit[..., None]
        twist = turn(launch, angle)
        return TapResult(
            missed=missed,
            travel=contact.travel,
            point=se2.transform_points(held, contact.point),
            normal=rotate(contact.normal, angle),
            incidence=incidence,
            normal_impulse=impact.normal_impulse * hit,
            tangential_impulse=impact.tangential_impulse * hit,
            twist=twist,
            displacement=turn(self.sliding.displace(turn(twist, -angle)), angle),
        )

    def plan(self, displacement: ArrayLike, object_pose: ArrayLike = _ORIGIN) -> TapPlan:
        """Plan the tap for ``displacement`` (..., 3), (dx, dy, dtheta) in table axes, m and rad.

        ``object_pose`` (..., 3) is the object's pose in the table frame; it broadcasts with the
        displacement. :meth:`outcome` of the plan equals the displacement up to rounding errors.
        Raises :class:`UnreachableDisplacementError` for a displacement outside the cone or shorter
        than the smallest distance, and :class:`InvalidParameterError` for values that are not
        finite.
        """
        wanted = _poses("displacement", displacement)
        self._refuse(wanted)
        held = _poses("object pose", object_pose)
        shape = np.broadcast_shapes(wanted.shape[:-1], held.shape[:-1])
        wanted, held = np.broadcast_to(wanted, (*shape, 3)), np.broadcast_to(held, (*shape, 3))
        plan = self._plan_in_body(turn(wanted, -held[..., 2]))
        if np.isnan(plan.incidence).any():
            self._refuse_contact(wanted, np.isnan(plan.incidence))
        return plan._replace(
            strike_pose=se2.compose(held, plan.strike_pose), twist=turn(plan.twist, held[..., 2])
        )

    def reachable(
        self, displacement: ArrayLike, object_pose: ArrayLike = _ORIGIN
    ) -> NDArray[np.bool_]:
        """Return whether one tap can produce ``displacement`` (..., 3), in table axes (m, rad)."""
        wanted = _poses("displacement", displacement)
        inside = np.asarray(self._inside(wanted))
        if not isinstance(self.body, Polygon):
            return inside
        held = _poses("object pose", object_pose)
        shape = np.broadcast_shapes(inside.shape, held.shape[:-1])
        turned = np.broadcast_to(turn(wanted, -held[..., 2]), (*shape, 3))
        found = np.array(np.broadcast_to(inside, shape))
        line, slope = line_of_action(self.body, self.sliding.twist_for(turned[found]))
        local = _in_frame(line.normal, line.point)
        found[found] = ~line.missed & self.impact.has_incidence(slope, local)
        return found

    def plan_reachable(
        self, displacements: Array, object_pose: ArrayLike = _ORIGIN
    ) -> tuple[NDArray[np.bool_], TapPlan]:
        """Return a mask (n,) of the displacements (n, 3) that one tap can produce, and the plans of
        these displacements only.

        Faster than ``reachable`` followed by ``plan``. ``object_pose``: (3,) or (n, 3).
        """
        wanted = _poses("displacement", displacements)
        held = np.broadcast_to(_poses("object pose", object_pose), wanted.shape)
        found = np.array(self._inside(wanted))
        plan = self._plan_in_body(turn(wanted[found], -held[found, 2]))
        known = ~np.isnan(plan.incidence)
        found[found] = known
        made = TapPlan(*(each[known] for each in plan))
        return found, made._replace(
            strike_pose=se2.compose(held[found], made.strike_pose),
            twist=turn(made.twist, held[found, 2]),
        )

    def jacobian(self, displacement: ArrayLike) -> Array:
        """Compute the derivative (..., 3, 3) of the tap's result with respect to the striker's
        pose, in m and rad.

        The rows are the displacement x along the planned travel, y to its left, and the rotation.
        The columns are those of section 5.1 of the paper: a displacement i of the ball's centre at
        the contact along the contact normal, a displacement j along the tangent, and a rotation
        beta of the striker's axis about the ball's centre. The derivatives are central differences
        of :meth:`outcome`. Raises the same exceptions as :meth:`plan`.
        """
        wanted = _poses("displacement", displacement)
        plan = self.plan(wanted)
        pose = plan.strike_pose
        normal = pose[..., 2] - plan.incidence
        travel = np.arctan2(wanted[..., 1], wanted[..., 0])
        still = np.zeros_like(normal)[..., None]
        shifts = (
            np.concatenate([_LENGTH_STEP * unit(normal), still], axis=-1),
            np.concatenate([_LENGTH_STEP * unit(normal + math.pi / 2), still], axis=-1),
            np.array([0.0, 0.0, _ANGLE_STEP]),
        )
        columns = [
            turn(
                self.outcome(_ORIGIN, pose + shift, plan.striker_speed)
                - self.outcome(_ORIGIN, pose - shift, plan.striker_speed),
                -travel,
            )
            for shift in shifts
        ]
        scale = 2 * np.array([_LENGTH_STEP, _LENGTH_STEP, _ANGLE_STEP])
        return np.asarray(np.stack(columns, axis=-1) / scale)

    def _largest_lever(self) -> float:
        """Compute the maximum distance of an impulse's line of action from the centre of mass, in
        m."""
        body = self.body
        if not isinstance(body, Polygon):
            angle = self.impact.largest_impulse_angle((-body.bounding_radius, 0.0))
            return body.bounding_radius * math.sin(float(angle))
        inward = -body.edge_normals
        ends = np.stack([body.points, np.roll(body.points, -1, axis=0)])
        local = _in_frame(np.broadcast_to(inward, ends.shape), ends)
        angle = self.impact.largest_impulse_angle(local)
        lines = np.stack([unit(angle), unit(-angle)])
        return float(np.abs(cross(local, lines)).max())

    def _plan_in_body(self, wanted: Array) -> TapPlan:
        """Compute plans in the object's frame; the incidence is NaN if no contact is feasible."""
        twist = self.sliding.twist_for(wanted)
        line, slope = line_of_action(self.body, twist)
        body, normal = self.body, line.normal
        speed = np.hypot(twist[..., 0], twist[..., 1])
        local = _in_frame(normal, line.point)
        incidence = self.impact.incidence_for(slope, local)
        incidence = np.where(line.missed, np.nan, incidence)
        known = np.where(np.isnan(incidence), 0.0, incidence)
        slow = self.impact.strike(1.0, known, local)
        impulse = np.hypot(slow.normal_impulse, slow.tangential_impulse)
        axis = rotate(normal, known)
        ball = line.point - self.impact.striker.tip_radius * normal
        pose = np.concatenate([ball, np.arctan2(axis[..., 1], axis[..., 0])[..., None]], axis=-1)
        return TapPlan(
            contact_angle=np.arctan2(line.point[..., 1], line.point[..., 0]),
            strike_pose=pose,
            striker_speed=body.mass * speed / impulse,
            incidence=incidence,
            twist=twist,
        )

    def _inside(self, wanted: Array) -> NDArray[np.bool_]:
        distance = np.hypot(wanted[..., 0], wanted[..., 1])
        limit = self.cone_slope * distance
        return np.asarray(
            (distance >= self.smallest_distance * (1 - _EDGE))
            & (distance > 0)
            & (np.abs(wanted[..., 2]) <= limit * (1 + _EDGE))
        )

    def _refuse(self, wanted: Array) -> None:
        outside = ~self._inside(wanted)
        if not outside.any():
            return
        dx, dy, rotation = wanted[outside][0].tolist()
        distance = math.hypot(dx, dy)
        if distance < self.smallest_distance * (1 - _EDGE) or distance == 0.0:
            raise UnreachableDisplacementError(
                f"the displacement is {1e3 * distance:.4g} mm long; the shortest tap is "
                f"{1e3 * self.smallest_distance:.4g} mm; move the object farther, or check the unit"
            )
        limit = math.degrees(self.cone_slope * distance)
        raise UnreachableDisplacementError(
            f"the displacement has a rotation of {math.degrees(rotation):.4g} degrees over "
            f"{1e3 * distance:.4g} mm; one tap rotates by at most {limit:.4g} degrees over this "
            f"distance ({math.degrees(self.cone_slope) / 1e3:.4g} degrees/mm). Use two taps."
        )

    def _refuse_contact(self, wanted: Array, where: NDArray[np.bool_]) -> None:
        dx, dy, rotation = wanted[where][0].tolist()
        limit = math.degrees(math.atan(self.impact.friction))
        raise UnreachableDisplacementError(
            f"no contact of the body gives ({1e3 * dx:.4g} mm, {1e3 * dy:.4g} mm, "
            f"{math.degrees(rotation):.4g} degrees): the impulse would deviate by more than "
            f"{limit:.4g} degrees from the normal of the edge. Choose another direction."
        )


def line_of_action(body: Body, twist: Array) -> tuple[Contact, Array]:
    """Return the contact of launches (..., 3) in the object's frame, which is where the impulse's
    line of action enters the body, and the slope (...,) of the impulse relative to the contact
    normal."""
    velocity, spin = twist[..., :2], twist[..., 2]
    speed = np.hypot(velocity[..., 0], velocity[..., 1])
    along = velocity / np.where(speed > 0, speed, 1.0)[..., None]
    lever = body.radius_of_gyration**2 * spin / np.where(speed > 0, speed, 1.0)
    # The line of action is treated as the path of a point. The first contact of this point with the
    # body is the contact point.
    far = 2 * body.bounding_radius
    start = lever[..., None] * to_right(along) - far * along
    line = first_contact(body, 0.0, start, along)
    return line, cross(line.normal, along) / (line.normal * along).sum(axis=-1)


def _poses(name: str, values: ArrayLike) -> Array:
    array = finite(name, values)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise InvalidParameterError(
            f"{name} has shape {array.shape}; the last axis must have length 3."
        )
    return array


def _in_frame(normal: Array, vector: Array) -> Array:
    """Return the components along n and along t, where t is n rotated by +90 degrees."""
    return np.stack([(normal * vector).sum(axis=-1), cross(normal, vector)], axis=-1)


def _from_frame(normal: Array, vector: Array) -> Array:
    n, t = vector[..., :1], vector[..., 1:]
    return n * normal + t * to_left(normal)
