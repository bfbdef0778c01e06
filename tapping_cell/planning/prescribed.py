"""A single tap with a prescribed striker speed and incidence; the contact point is free.

Such taps are for experiments that measure the object. In these experiments the planner must not
choose the tap. The contact is chosen among those whose normal passes through the centre of mass
(every contact of a round body, one contact per edge of a polygon), so that the rotation depends on
the incidence alone. Before the experiment the object's mechanics are known only roughly. A model is
sufficient if it is accurate enough to keep the object on the table and in the camera's view. The
required clearance allows for large errors of the model (``MODEL_DEVIATION``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike

from tapping_cell.mechanics import Polygon, TapResult
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.free_space import FreeSpace
from tapping_cell.planning.gains import Gains
from tapping_cell.planning.goal import edge_warning, others_text, place_text
from tapping_cell.planning.interface import Array
from tapping_cell.planning.refusal import Refusal, RefusalReason
from tapping_cell.planning.session import Decision, Done, Strike, noise_of
from tapping_cell.planning.settings import CameraNoise, Scatter
from tapping_cell.planning.strike import BoolArray, StrikeSpace
from tapping_cell.se2 import Pose, difference, displaced, unit_vectors, wrap_angle

METHOD = "prescribed"

MODEL_DEVIATION = Scatter(distance=0.10, rotation=0.20, direction=math.radians(2.0))
"""Standard deviations of the model's error: a third of the change that errors of 20 % in friction,
restitution and torque factor cause."""

LARGEST_INCIDENCE = math.radians(60.0)
"""Largest allowed incidence. With a larger incidence, a striker slightly off its line may graze or
miss the object."""

CONTACTS = 72
"""Number of contacts tried around a round body."""

SHORT = 0.003
"""Largest distance, m, along the striker's travel, between the actual and the intended contact."""


@dataclass(frozen=True, slots=True)
class Prescription:
    """Parameters of a prescribed tap.

    striker_speed: m/s. incidence: rad, from the contact normal (into the object) to the striker's
    axis, positive counter-clockwise. direction: desired direction of the object's travel in
    `table`, rad; None means towards the middle of the table. slack: largest deviation of the travel
    from this direction, rad; the possible contact with the smallest deviation is used.

    Raises:
        PlanningError: a number is not finite or out of range.
    """

    striker_speed: float
    incidence: float
    direction: float | None = None
    slack: float = math.pi

    def __post_init__(self) -> None:
        if not (math.isfinite(self.striker_speed) and self.striker_speed > 0):
            raise PlanningError(
                f"the striker speed is {self.striker_speed!r} m/s; it must be above 0"
            )
        if not abs(self.incidence) <= LARGEST_INCIDENCE:
            raise PlanningError(
                f"the incidence is {math.degrees(self.incidence):.1f} deg; it must be within "
                f"+-{math.degrees(LARGEST_INCIDENCE):.0f} deg, or the striker may graze the object"
            )
        if self.direction is not None and not math.isfinite(self.direction):
            raise PlanningError("the direction is not a finite number; give it in rad, or omit it")
        if not self.slack >= 0:
            raise PlanningError(
                f"the slack of the direction is {self.slack!r} rad; it must be 0 or more"
            )


class PrescribedSession:
    """Session of one prescribed tap, with the interface of a positioning session."""

    def __init__(
        self,
        prescription: Prescription,
        space: StrikeSpace,
        free: FreeSpace,
        gains: Gains,
        *,
        adapt: bool = True,
    ) -> None:
        """``space``: strike space whose scatter covers the model's error (see ``cautious``);
        ``gains``: gains learnt from earlier taps; ``adapt``: also learn from this tap."""
        self.prescription = prescription
        self.gains = gains
        self._space = space
        self._free = free
        self._adapt = adapt
        self._tapped: Strike | None = None

    @property
    def method(self) -> str:
        """Name of the method, for records."""
        return METHOD

    def skip(self, strike: Strike) -> None:
        """Do nothing, because a prescribed tap has no alternative."""

    def predicted_covariance(self, strike: Strike, pose: Pose) -> Array:
        """Compute the covariance (3, 3), m and rad, of the pose after the tap of an object at
        ``pose``."""
        return self.gains.predicted_covariance(strike.commanded, pose.theta, MODEL_DEVIATION)

    def decide(
        self,
        object_pose: ArrayLike,
        covariance: ArrayLike | None = None,
        in_view: ArrayLike | None = None,
    ) -> Decision:
        """Return the tap, Done after the tap, or the reason why the tap is not possible.

        Args:
            object_pose: x, y, theta in `table`, m and rad.
            covariance: unused; accepted because other sessions require it.
            in_view: points (n, 2) of the table in the camera's view, m; the object's centre must
                stay in their convex hull, all of which is in view. None means no limit.
        """
        pose = np.asarray(object_pose, dtype=float)
        if self._tapped is not None:
            left = difference(pose, self._tapped.predicted)
            return Done(Pose(*left.tolist()), None)
        wanted = self.prescription.direction
        if wanted is None:
            wanted = math.atan2(-pose[1], -pose[0])
        contacts = self._contacts(pose, wanted)
        made = self._space.tap.strike(
            pose, self._space.rest_pose(contacts), self.prescription.striker_speed
        )
        moved = self.gains.predict(made.displacement, pose[2])
        off = np.abs(wrap_angle(np.arctan2(moved[:, 1], moved[:, 0]) - wanted))
        order = np.argsort(off, kind="stable")
        order = order[(off <= self.prescription.slack + 1e-9)[order]]
        # Before the first measured tap, the slide checks use the scatter of the strike space; the
        # caller must pass a space whose scatter includes ``MODEL_DEVIATION``. Afterwards, they use
        # the spread of the learnt gains.
        spread = None
        if float(self.gains.taken + self.gains.outliers) > 0:
            spread = self.gains.spread(
                made.displacement, self._space.scatter, self._space.settings.footprint
            )
        slide = self._space.footprint(pose, moved, spread)
        safe = self._space.slide_is_safe(pose, moved, spread)
        problems = self._problems(pose, contacts, made, slide, safe, in_view)
        for index in order.tolist():
            if not any(bool(problem[index]) for problem in problems.values()):
                return self._make_strike(
                    pose, contacts[index], made.displacement[index], moved[index]
                )
        return self._refusal(pose, wanted, order.tolist(), problems, moved, slide)

    def observe(
        self,
        strike: Strike,
        pose_before: ArrayLike,
        pose_after: ArrayLike,
        covariance: ArrayLike | None = None,
    ) -> None:
        """Learn from the tap, which was fired or may have been fired, and end the session."""
        self._tapped = strike
        if not self._adapt:
            return
        moved = difference(pose_before, pose_after)
        noise = CameraNoise() if covariance is None else noise_of(covariance)
        orientation = float(np.asarray(pose_before, dtype=float)[2])
        self.gains = self.gains.observe(
            strike.commanded, moved, orientation, self._space.scatter, noise
        )

    def edge_warning(self, pose: ArrayLike) -> str:
        """Return a warning if the object is close to an edge or over it, else an empty string."""
        return edge_warning(pose, self._space)

    def use_free_space(self, space: StrikeSpace, free: FreeSpace) -> None:
        """Replace the strike space and its map, because the obstacles on the table may have
        changed."""
        self._space = space
        self._free = free

    def _contacts(self, pose: Array, wanted: float) -> Array:
        """Return the poses (n, 3) of the tip at contacts with the prescribed incidence, in
        `table`."""
        body = self._space.tap.body
        if isinstance(body, Polygon):
            points = (
                body.edge_normals * np.einsum("ij,ij->i", body.points, body.edge_normals)[:, None]
            )
            inward = np.arctan2(-body.edge_normals[:, 1], -body.edge_normals[:, 0]) + pose[2]
            depth = np.hypot(points[:, 0], points[:, 1])
        else:
            start = np.arange(CONTACTS) * (2.0 * math.pi / CONTACTS)
            inward = wanted - self._deflection() + start
            depth = np.full(CONTACTS, body.bounding_radius)
        back = depth + self._space.tip_radius
        place = pose[:2] - back[:, None] * unit_vectors(inward)
        return np.column_stack([place, inward + self.prescription.incidence])

    def _deflection(self) -> float:
        """Compute the angle from the contact normal to the travel of a round body."""
        body = self._space.tap.body
        back = body.bounding_radius + self._space.tip_radius
        tip = (-back, 0.0, self.prescription.incidence)
        moved = self.gains.predict(
            self._space.tap.outcome((0.0, 0.0, 0.0), tip, self.prescription.striker_speed), 0.0
        )
        return math.atan2(float(moved[1]), float(moved[0]))

    def _problems(
        self,
        pose: Array,
        contacts: Array,
        made: TapResult,
        slide: Array,
        safe: BoolArray,
        in_view: ArrayLike | None,
    ) -> dict[str, BoolArray]:
        """Return, for each kind of problem, which contacts have this problem, (n,)."""
        space = self._space
        off_contact = (
            made.missed
            | (np.abs(made.travel - space.settings.standoff) > SHORT)
            | (np.abs(made.incidence - self.prescription.incidence) > 1e-3)
        )
        unseen = np.zeros(len(contacts), dtype=bool)
        if in_view is not None:
            unseen = ~np.all(between(slide, in_view), axis=(-2, -1))
        return {
            "contact": off_contact,
            "table": ~(safe & np.all(self._free.contains(slide[..., -1, :]), axis=-1)),
            "view": unseen,
            "tool": ~space.tool_fits(pose, contacts),
        }

    def _make_strike(
        self, pose: Array, contact: Array, displacement: Array, moved: Array
    ) -> Strike:
        towards = unit_vectors(contact[2] - self.prescription.incidence)
        touch = contact[:2] + self._space.tip_radius * towards
        angle = math.atan2(touch[1] - pose[1], touch[0] - pose[0]) - pose[2]
        return Strike(
            commanded=Pose(*displacement.tolist()),
            wanted=Pose(*moved.tolist()),
            predicted=Pose(*displaced(pose, moved).tolist()),
            residual=Pose(*moved.tolist()),
            plan=self._space.plan_at(
                float(wrap_angle(angle)), contact, self.prescription.striker_speed
            ),
            method=METHOD,
        )

    def _refusal(
        self,
        pose: Array,
        wanted: float,
        order: list[int],
        problems: dict[str, BoolArray],
        moved: Array,
        slide: Array,
    ) -> Refusal:
        """Return why the contact that best fits the desired direction cannot be tapped."""
        heading = math.degrees(float(wrap_angle(wanted)))
        place = place_text(pose)
        hit = [index for index in order if not problems["contact"][index]]
        if not hit:
            return Refusal(
                RefusalReason.NO_STRIKE,
                f"no contact of the object at {place} with an incidence of "
                f"{math.degrees(self.prescription.incidence):.1f} deg makes it travel within "
                f"{math.degrees(min(self.prescription.slack, math.pi)):.0f} deg of the direction "
                f"{heading:.0f} deg; allow more slack or another incidence",
            )
        index = hit[0]
        distance = 1e3 * math.hypot(moved[index, 0], moved[index, 1])
        farthest = 1e3 * float(np.max(np.linalg.norm(slide[index] - pose[:2], axis=-1)))
        text = (
            f"the tap would move the object from {place} by {distance:.0f} mm (with all "
            f"uncertainty at most {farthest:.0f} mm)"
        )
        if problems["table"][index]:
            return Refusal(
                RefusalReason.TAP_LEAVES_TABLE,
                f"{text}, so that it might leave the table, enter a keep-out or be out of the "
                "arm's reach; choose a lower striker speed or another direction, or move the "
                "object towards the middle" + others_text(self._space),
            )
        if problems["view"][index]:
            return Refusal(
                RefusalReason.TAP_LEAVES_VIEW,
                f"{text}, so that it might leave the part of the table that the camera certainly "
                "sees (between the reference markers); choose a lower striker speed or another "
                "direction, or move the object towards the middle",
            )
        return Refusal(
            RefusalReason.NO_STRIKE,
            f"the arm or the tool lacks space to tap the object at {place} so that it travels "
            f"within {math.degrees(min(self.prescription.slack, math.pi)):.0f} deg of the "
            f"direction {heading:.0f} deg; allow more slack, or move the object towards the middle"
            + others_text(self._space),
        )


def cautious(space: StrikeSpace) -> Scatter:
    """Combine the scatter of a strike space's taps with the error of the model."""
    known, model = space.scatter, MODEL_DEVIATION
    return replace(
        known,
        distance=math.hypot(known.distance, model.distance),
        rotation=math.hypot(known.rotation, model.rotation),
        direction=math.hypot(known.direction, model.direction),
    )


def between(points: ArrayLike, others: ArrayLike) -> BoolArray:
    """Return whether points (..., 2) lie in the convex hull of ``others`` (n, 2); False if the hull
    has no area.

    The visible part of a plane is convex, so the convex hull of visible points is visible.
    """
    p, given = np.asarray(points, dtype=float), np.asarray(others, dtype=float).reshape(-1, 2)
    try:
        sides = scipy.spatial.ConvexHull(given).equations if len(given) > 2 else None
    except scipy.spatial.QhullError:
        sides = None
    if sides is None:
        return np.zeros(p.shape[:-1], dtype=bool)
    return np.asarray(np.all(p @ sides[:, :2].T + sides[:, 2] <= 1e-9, axis=-1))
