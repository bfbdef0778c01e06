"""Online estimation of how an object's true displacements differ from those of the model.

A tap commanded as (d, turn, direction) and measured as (d', turn', direction') gives

    ln(d' / d)             = a                      a: logarithm of the gain of the distance
    turn' / d'             = G turn / d + o x u     G: gain of the rotation per distance
    direction' - direction = e + f turn / d         e, f: constant direction error, and its growth

a, G and o are sums of a part of the impact and a part of the slide. Only a track of the slide tells
them apart: the model's slide for the measured launch, ``Slid``, differs from the real one only by
the part of the slide, without the scatter of the impact. Without a track, only the sums matter.

The unknowns of each equation are estimated separately. u is the direction of travel in the object's
frame. o is an offset with two components, for an object whose centre of mass or of friction is not
at its middle: the rotation per distance (rad/m) that a tap through the middle causes. An error of
the friction coefficient changes distance and rotation by the same factor. The rotation is therefore
divided by the measured distance, so that G describes only the torque of the friction. Each estimate
is a ``Belief``. The prior of each belief is a mixture of a narrow distribution, for an accurate
object file, and wide distributions, for an inaccurate one. Measurements are weighted by the tap's
scatter and the camera's noise, and outliers are distinguished from lasting changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.mechanics.slide_track import SLIDE_MODEL
from tapping_cell.planning.belief import Belief, Prior
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import CameraNoise, Scatter
from tapping_cell.se2 import wrap_angle

NAMES = ("distance", "rotation", "direction", "direction_growth", "offset_x", "offset_y")
"""Names of the learnt parameters: distance gain; gain of the rotation per distance; direction error
in rad; growth of this error in rad per rad/m; rotation per distance (rad/m) of taps through the
middle along -y and +x of the object."""

LOWEST = np.array([0.1, 0.1, -0.5, -0.05, -20.0, -20.0])
HIGHEST = np.array([10.0, 10.0, 0.5, 0.05, 20.0, 20.0])

PARTS = ("distance", "rotation", "offset_x", "offset_y")
"""Those of the parameters that have a part of the impact and a part of the slide. The two parts of
the distance gain are multiplied, those of the other parameters are added."""

PART_BOUNDS = np.array([[0.1, 10.0], [-10.0, 10.0], [-20.0, 20.0], [-20.0, 20.0]])
_OF_PARTS = np.array([[0, 1], [2, 3], [4, 6], [5, 7]])
"""Indices of the parts among the numbers of the beliefs about distance and rotation."""
_IMPACT = np.array([0.0, 0.0, 0.5, 0.5])
"""Share of the impact in saved parameters without parts."""

DISTANCE = Prior(
    weight=np.array([0.75, 0.25]),
    mean=np.zeros((2, 2)),
    deviation=np.array([[0.0283, 0.0283], [0.10, 0.693]]),
    change=1,
    span=4.0,
)
"""Prior of ln(distance gain) of impact and slide. A mixture of a narrow distribution (standard
deviation of the sum 4 %), for an object that matches its file, and a wide one, for a friction that
differs from the file by a factor of up to 5. With three standard deviations, the footprint of a
first tap contains 999 of 1000 slides on a table with a fifth of the friction."""

ROTATION = Prior(
    weight=np.array([0.60, 0.20, 0.12, 0.08]),
    mean=np.tile([0.0, 1.0, 0.0, 0.0, 0.0, 0.0], (4, 1)),
    deviation=np.array(
        [
            [0.0424, 0.0424, 0.021, 0.021, 0.021, 0.021],
            [0.10, 0.693, 0.035, 0.035, 0.035, 0.035],
            [0.106, 0.106, 1.2, 1.2, 0.9, 0.9],
            [0.10, 0.693, 1.2, 1.2, 0.9, 0.9],
        ]
    ),
    change=3,
    span=20.0,
)
"""Prior of (G of the impact, G of the slide, o of the impact, o of the slide): a mixture of four
distributions, for an object that matches its file, for one whose G differs by a factor of up to 3,
for one with an offset, and for one with both deviations. The part of the impact has the mean 0, so
that the sum is G."""

DIRECTION = Prior(
    weight=np.array([0.85, 0.10, 0.05]),
    mean=np.zeros((3, 2)),
    deviation=np.array([[0.010, 0.001], [0.10, 0.005], [0.01, 0.02]]),
    change=1,
    span=2.0 * math.pi,
)
"""Prior of (e, f): usually a standard deviation of 0.6 degrees, rarely a constant error of up to 20
degrees, or a contact with almost no friction. Such a contact moves the object along its normal, so
that f is 0.034 for the paper's disk: the direction of a tap with the largest rotation is then wrong
by 11 degrees, in the sense of the rotation."""

DISTANCE_SUM = np.ones((1, 2))
ROTATION_SUM = np.array(
    [
        [1.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0, 0.0, 1.0],
    ]
)
"""Matrices from the numbers of the beliefs to a, and to (G, o_x, o_y)."""

OFFSET_IN_TRACK = 1.17
"""Effect of an offset of the friction on the measurement of a track, relative to its effect on the
rotation. The spin of such an object rises while it slides, and the track attributes a part of the
rotation to the launch. An offset of the mass turns the object at the impact and has no effect."""

MIN_SLOPE = 0.1
"""Standard deviation, rad/m, of the rotation per distance of a tap without commanded rotation. For
the paper's disk, this value corresponds to a position error of the arm of 0.2 mm."""

KEPT = 0.95
"""Probability that the gains of an earlier run are still valid."""

MIN_MOVE = 1e-6
"""Length, m, below which a displacement counts as zero."""

UNEXPLAINED = 0.5
"""A tap counts as an outlier if the probability that it is a valid measurement is below this
value."""


class Slid(NamedTuple):
    """What the model predicts for the launch that was measured in a track, (...,); NaN if unknown.

    distance: m. slope: rotation per distance, rad/m. distance_std, slope_std: standard deviations
    relative to the value.
    """

    distance: Array
    slope: Array
    distance_std: Array
    slope_std: Array


_ONE_DEVIATION = (NormalDist().cdf(-1.0), NormalDist().cdf(1.0))


class Spread(NamedTuple):
    """Bounds of the true displacements, relative to the predicted displacements.

    longest: (...,), ratio of the longest to the predicted slide. aside: (..., 2), the largest
    deviations of the direction to the right (negative) and to the left, rad.
    """

    longest: Array
    aside: Array


@dataclass(frozen=True, slots=True)
class Gains:
    """Learnt parameters of one object, or of several objects (leading axes).

    distance: belief about a of impact and slide. rotation: belief about G of impact and slide and
    about o of impact and slide. direction: belief about (e, f). taken, outliers: shape (...),
    number of taps that the model explains and number of outliers. surprised: shape (...), whether
    the last tap was an outlier.
    """

    distance: Belief
    rotation: Belief
    direction: Belief
    taken: Array
    outliers: Array
    surprised: NDArray[np.bool_]

    @classmethod
    def start(cls, shape: tuple[int, ...] = ()) -> Gains:
        """Return the gains of objects that were never tapped."""
        return cls(
            Belief.start(DISTANCE, shape),
            Belief.start(ROTATION, shape),
            Belief.start(DIRECTION, shape),
            np.zeros(shape),
            np.zeros(shape),
            np.zeros(shape, dtype=bool),
        )

    def of(self, rows: NDArray[np.intp]) -> Gains:
        """Return the gains of the objects in ``rows``."""
        return Gains(
            self.distance.of(rows),
            self.rotation.of(rows),
            self.direction.of(rows),
            self.taken[rows],
            self.outliers[rows],
            self.surprised[rows],
        )

    def put(self, rows: NDArray[np.intp], gains: Gains) -> None:
        """Replace the gains of the objects in ``rows``."""
        self.distance.put(rows, gains.distance)
        self.rotation.put(rows, gains.rotation)
        self.direction.put(rows, gains.direction)
        for name in ("taken", "outliers", "surprised"):
            getattr(self, name)[rows] = getattr(gains, name)

    @property
    def value(self) -> Array:
        """Expected values of the parameters in ``NAMES``, (..., 6)."""
        distance = np.exp(self.distance.expected(DISTANCE_SUM))
        rotation, direction = self.rotation.expected(ROTATION_SUM), self.direction.expected()
        numbers = np.concatenate([distance, rotation[..., :1], direction, rotation[..., 1:]], -1)
        return np.asarray(np.clip(numbers, LOWEST, HIGHEST))

    @property
    def deviation(self) -> Array:
        """Standard deviations of ``value``, (..., 6)."""
        distance = np.exp(self.distance.expected(DISTANCE_SUM))
        distance = distance * self.distance.deviation(DISTANCE_SUM)
        rotation, direction = self.rotation.deviation(ROTATION_SUM), self.direction.deviation()
        return np.concatenate([distance, rotation[..., :1], direction, rotation[..., 1:]], axis=-1)

    def to_plan(self, remaining: ArrayLike, box: float) -> tuple[Array, Array, Array]:
        """Convert residuals (..., 3), dx, dy (m) and rotation (rad), to the input of a planning
        method, whose stopping box has the half width ``box`` (rad).

        Returns the distance (m), the rotation (rad, see ``plan_rotation``) and the heading (rad).
        The distance is not scaled, so that the stopping box and the smallest tap keep their size.
        """
        left = np.asarray(remaining, dtype=float)
        turn = plan_rotation(left[..., 2], self.value[..., 1], box)
        heading = np.arctan2(left[..., 1], left[..., 0])
        return np.hypot(left[..., 0], left[..., 1]), turn, heading

    def from_plan(self, remaining: ArrayLike, turn: ArrayLike, box: float) -> Array:
        """Convert the rotation ``turn`` (...,) of the taps that a planning method chose for the
        residuals (..., 3) to the rotation that ``command`` takes, rad."""
        left, gain = np.asarray(remaining, dtype=float)[..., 2], self.value[..., 1]
        after = plan_rotation(left, gain, box) - np.asarray(turn, dtype=float)
        # The inverse gain inverts the conversion.
        return np.asarray((left - plan_rotation(after, 1.0 / gain, box)) / gain)

    def command(
        self,
        distance: ArrayLike,
        rotation: ArrayLike,
        heading: ArrayLike,
        orientation: ArrayLike,
        cone_slope: float = math.inf,
    ) -> Array:
        """Compute the displacements (..., 3) to request from the mechanics for the taps of a
        planning method.

        distance: m, negative for a tap opposite to ``heading`` (rad). rotation: rad, as returned by
        ``from_plan``. orientation: orientation of the object before the tap, rad. cone_slope: limit
        of the commanded rotation per distance, rad/m; it also limits the compensation of the
        offset.
        """
        return command_of(self.value, distance, rotation, heading, orientation, cone_slope)

    def predict(self, commanded: ArrayLike, orientation: ArrayLike) -> Array:
        """Predict the true displacement, (..., 3), for a commanded displacement.

        orientation: orientation of the object before the tap, rad.
        """
        return prediction_of(self.value, commanded, orientation)

    def observe(
        self,
        commanded: ArrayLike,
        measured: ArrayLike,
        orientation: ArrayLike,
        scatter: Scatter,
        camera: CameraNoise,
        slid: Slid | None = None,
    ) -> Gains:
        """Return the gains updated with one tap.

        Args:
            commanded: commanded dx, dy (m) and rotation (rad) in `table`, (..., 3).
            measured: measured displacement, (..., 3). A row that is not finite leaves the
                beliefs unchanged and counts as an outlier.
            orientation: orientation of the object before the tap, rad, (...,).
            scatter: scatter of a tap, one standard deviation.
            camera: standard deviation of one observation; a measured displacement is the
                difference of two observations.
            slid: prediction for the launch in the track of the slide; None without a track.
        """
        command, seen = np.asarray(commanded, dtype=float), np.asarray(measured, dtype=float)
        asked = np.hypot(command[..., 0], command[..., 1])
        moved = np.hypot(seen[..., 0], seen[..., 1])
        usable = np.isfinite(moved) & np.isfinite(seen[..., 2]) & np.isfinite(asked)
        usable = usable & (asked > MIN_MOVE)
        # Standard deviations of the parts of a measured displacement's error that do not depend on
        # the size of the tap.
        position_std = math.hypot(math.sqrt(2.0) * camera.position, scatter.position_floor)
        angle_std = math.hypot(math.sqrt(2.0) * camera.angle, scatter.angle_floor)
        travel = np.where(usable, np.maximum(moved, max(position_std, MIN_MOVE)), 1.0)
        size = np.where(usable, asked, 1.0)
        slope = np.where(usable, command[..., 2], 0.0) / size
        commanded_heading = np.where(usable, np.arctan2(command[..., 1], command[..., 0]), 0.0)
        measured_heading = np.where(usable, np.arctan2(seen[..., 1], seen[..., 0]), 0.0)
        # NaN, added to a measurement, makes the belief ignore it; otherwise 0.
        unusable = np.where(usable, 0.0, math.nan)
        relative_std = position_std / travel
        zero = np.zeros_like(relative_std)

        distance, p_distance = self.distance.observe(
            DISTANCE,
            np.ones((*asked.shape, 2)),
            np.log(travel / size) + unusable,
            zero,
            np.hypot(scatter.distance, relative_std),
        )
        # The direction and the rotation per distance of a very short slide cannot be measured.
        too_short = np.where(moved > 3.0 * position_std, unusable, math.nan)
        offsets = np.stack(_directions(measured_heading - np.asarray(orientation, dtype=float)))
        rotation, p_rotation = self.rotation.observe(
            ROTATION,
            np.stack([slope, slope, *offsets, *offsets], axis=-1),
            seen[..., 2] / travel + too_short,
            zero + math.hypot(scatter.rotation, scatter.distance),
            np.hypot(MIN_SLOPE, angle_std / travel),
        )
        direction, p_direction = self.direction.observe(
            DIRECTION,
            np.stack([np.ones_like(slope), slope], axis=-1),
            wrap_angle(measured_heading - commanded_heading) + too_short,
            zero,
            np.hypot(scatter.direction, relative_std),
        )
        if slid is not None:
            # The scatter of the impact is independent of the errors of the track, so that the two
            # measurements of a tap are independent.
            slid = slid._replace(slope=slid.slope + too_short, distance=slid.distance + too_short)
            launch = Slid(*(np.nan_to_num(part, nan=1.0) for part in slid))
            distance, _ = distance.observe(
                DISTANCE,
                np.broadcast_to([0.0, 1.0], (*asked.shape, 2)),
                np.log(travel / slid.distance),
                zero,
                np.sqrt(launch.distance_std**2 + SLIDE_MODEL[0] ** 2 + relative_std**2),
            )
            measured_slope = seen[..., 2] / travel
            slope_std = np.hypot(launch.slope_std, SLIDE_MODEL[1]) * measured_slope
            rotation, _ = rotation.observe(
                ROTATION,
                np.stack([zero, launch.slope, zero, zero, *OFFSET_IN_TRACK * offsets], axis=-1),
                np.where(np.isfinite(slid.slope), measured_slope, math.nan),
                zero,
                np.hypot(slope_std, angle_std / travel),
            )
        explained = usable & (p_distance >= UNEXPLAINED)
        explained &= np.isnan(too_short) | (np.minimum(p_rotation, p_direction) >= UNEXPLAINED)
        return Gains(
            distance,
            rotation,
            direction,
            self.taken + explained,
            self.outliers + ~explained,
            ~explained,
        )

    def spread(self, commanded: ArrayLike, scatter: Scatter, deviations: float) -> Spread:
        """Return, for each command (..., 3), bounds of the true displacement relative to the
        displacement that ``predict`` returns.

        The bounds include the scatter, the uncertainty of the gains and a possible change of the
        object at the last tap. ``deviations``: size of the bounds, as the number of standard
        deviations of a normal distribution with the same tail probability.
        """
        command = np.asarray(commanded, dtype=float)
        length = np.hypot(command[..., 0], command[..., 1])
        size = np.maximum(length, MIN_MOVE)
        slope = command[..., 2] / size
        high, low = NormalDist().cdf(deviations), NormalDist().cdf(-deviations)
        one = np.ones_like(slope)
        # Without a position floor, the scatter is proportional to the size. The quantile is then
        # the same for all taps of an object and is computed only once.
        sizes = size if scatter.position_floor > 0.0 else np.ones(self.taken.shape)
        distance_std = scatter.along(sizes) / sizes
        longest = self.distance.quantile(np.ones((*sizes.shape, 2)), high, distance_std)
        terms = np.stack([one, slope], axis=-1)
        direction_std = scatter.across(size) / size
        ends = [self.direction.quantile(terms, end, direction_std) for end in (low, high)]
        aside = np.stack(ends, axis=-1)
        expected = self.value[..., 2] + self.value[..., 3] * slope
        factor = np.exp(longest) / self.value[..., 0]
        return Spread(np.broadcast_to(factor, slope.shape), aside - expected[..., None])

    def largest_rotation_gain(self, probability: float) -> Array:
        """Return the upper bound (...,) of the true rotation gain that holds with
        ``probability``."""
        return self.rotation.quantile(ROTATION_SUM[0], probability)

    def predicted_covariance(
        self, commanded: ArrayLike, orientation: float, scatter: Scatter
    ) -> Array:
        """Compute the covariance (3, 3), m and rad, of the displacement caused by one command (3,).

        Half the width of the interval with a probability of 68 % is used as the standard deviation,
        because the belief has heavier tails than a normal distribution.
        """
        command = np.asarray(commanded, dtype=float)
        x, y, turn = self.predict(command, orientation).tolist()
        length = math.hypot(x, y)
        size = max(math.hypot(command[0], command[1]), MIN_MOVE)
        slope = command[2] / size

        def std(belief: Belief, coefficients: list[float], noise: float) -> float:
            low, high = (belief.quantile(coefficients, share, noise) for share in _ONE_DEVIATION)
            return float(high - low) / 2

        travel = math.atan2(y, x) - orientation
        distance_std = std(self.distance, [1.0, 1.0], float(scatter.along(size)) / size)
        direction_std = std(self.direction, [1.0, slope], float(scatter.across(size)) / size)
        terms = [slope, slope, *2 * [float(part) for part in _directions(np.asarray(travel))]]
        slope_std = std(self.rotation, terms, float(scatter.turning(command[2])) / size)
        effects = np.array(
            [
                [distance_std * x, distance_std * y, distance_std * turn],
                [-direction_std * y, direction_std * x, 0.0],
                [0.0, 0.0, slope_std * length],
            ]
        )
        return np.asarray(effects.T @ effects)

    @property
    def parts(self) -> tuple[Array, Array]:
        """Expected values and standard deviations, each (..., 4, 2), of the part of the impact and
        the part of the slide of the parameters in ``PARTS``."""
        mean = np.concatenate([self.distance.expected(), self.rotation.expected()], axis=-1)
        spread = np.concatenate([self.distance.deviation(), self.rotation.deviation()], axis=-1)
        mean, spread = mean[..., _OF_PARTS], spread[..., _OF_PARTS]
        mean[..., 0, :] = np.exp(mean[..., 0, :])
        spread[..., 0, :] *= mean[..., 0, :]
        return np.clip(mean, PART_BOUNDS[:, :1], PART_BOUNDS[:, 1:]), spread

    def as_numbers(self) -> dict[str, float]:
        """Convert the gains of one object to numbers for a file: value and standard deviation of
        each parameter and of its parts, in SI units."""
        names = [*NAMES, *(f"{part}_{name}" for name in PARTS for part in ("impact", "slide"))]
        value, deviation = self.parts
        values = np.append(self.value, value)
        deviations = np.append(self.deviation, deviation)
        return {
            key: float(number)
            for index, name in enumerate(names)
            for key, number in ((name, values[index]), (f"{name}_deviation", deviations[index]))
        }

    @classmethod
    def from_numbers(cls, numbers: dict[str, float]) -> Gains:
        """Restore gains saved by ``as_numbers``, for the same object in a later run.

        The saved numbers replace the narrow priors. The wide priors are kept, because friction may
        have changed, for example with the table or the humidity. Numbers of an earlier version lack
        the parts of impact and slide; half of the variance is then attributed to each part.

        Raises:
            PlanningError: a number is missing, not finite or outside its bounds.
        """
        whole = np.array(
            [_saved(numbers, *each) for each in zip(NAMES, LOWEST, HIGHEST, strict=True)]
        )
        total = whole[[NAMES.index(name) for name in PARTS]]
        total[0] = _logarithm(total[0])
        if f"slide_{PARTS[0]}" in numbers:
            pairs = [
                [_saved(numbers, f"{part}_{name}", low, high) for part in ("impact", "slide")]
                for name, (low, high) in zip(PARTS, PART_BOUNDS, strict=True)
            ]
            parts = np.array(pairs)
            parts[0] = [_logarithm(part) for part in parts[0]]
        else:
            shares = np.stack([_IMPACT, 1.0 - _IMPACT], axis=-1)
            half = np.broadcast_to(math.sqrt(0.5), shares.shape)
            parts = total[:, None] * np.stack([shares, half], axis=-1)
        mean, covariance = np.empty(8), np.zeros((8, 8))
        mean[_OF_PARTS] = parts[..., 0]
        covariance[_OF_PARTS, _OF_PARTS] = parts[..., 1] ** 2
        # The deviation of the sum tells how far the errors of the two parts cancel.
        between = (total[:, 1] ** 2 - np.sum(parts[..., 1] ** 2, axis=1)) / 2.0
        limit = np.prod(parts[..., 1], axis=1)
        one, other = _OF_PARTS.T
        covariance[one, other] = covariance[other, one] = np.clip(between, -limit, limit)
        made = cls.start()
        _replace_main(made.distance, mean[:2], covariance[:2, :2])
        _replace_main(made.rotation, mean[2:], covariance[2:, 2:])
        _replace_main(made.direction, whole[2:4, 0], np.diag(whole[2:4, 1] ** 2))
        return made


def plan_rotation(rotation: ArrayLike, gain: ArrayLike, box: float) -> Array:
    """Convert residual rotations (rad) of objects with these rotation gains to the rotations of a
    plan whose stopping box has the half width ``box`` (rad).

    A plan is made for a gain of 1. Outside the box, the rotation is divided by the gain, so that
    the cone of possible taps has its nominal slope. Inside the box, it is not scaled: otherwise the
    plan would regard an object as turned enough that is not, and would never turn it.
    """
    size = np.abs(np.asarray(rotation, dtype=float))
    inside = np.minimum(size, box)
    return np.asarray(np.copysign(inside + (size - inside) / gain, rotation))


def command_of(
    learnt: Array,
    distance: ArrayLike,
    rotation: ArrayLike,
    heading: ArrayLike,
    orientation: ArrayLike,
    cone_slope: float = math.inf,
) -> Array:
    """Compute what ``Gains.command`` returns. ``learnt`` is ``Gains.value``, (..., 6); its leading
    axes must broadcast with those of the taps."""
    travel = np.asarray(distance, dtype=float)
    size = np.maximum(np.abs(travel), 1e-12)
    along = np.asarray(heading, dtype=float) + np.where(travel < 0.0, math.pi, 0.0)
    drift = _across(learnt, along - np.asarray(orientation, dtype=float))
    slope = np.asarray(rotation, dtype=float) / size - drift / learnt[..., 1]
    slope = np.clip(slope, -cone_slope, cone_slope)
    along = along - learnt[..., 2] - learnt[..., 3] * slope
    length = size / learnt[..., 0]
    return np.stack([length * np.cos(along), length * np.sin(along), slope * length], axis=-1)


def prediction_of(learnt: Array, commanded: ArrayLike, orientation: ArrayLike) -> Array:
    """Compute what ``Gains.predict`` returns. ``learnt`` is ``Gains.value``, (..., 6); its leading
    axes must broadcast with those of the taps."""
    command = np.asarray(commanded, dtype=float)
    length = np.hypot(command[..., 0], command[..., 1])
    slope = command[..., 2] / np.maximum(length, 1e-12)
    along = np.arctan2(command[..., 1], command[..., 0])
    along = along + learnt[..., 2] + learnt[..., 3] * slope
    length = length * learnt[..., 0]
    drift = _across(learnt, along - np.asarray(orientation, dtype=float))
    turn = length * (learnt[..., 1] * slope + drift)
    return np.stack([length * np.cos(along), length * np.sin(along), turn], axis=-1)


def _saved(numbers: dict[str, float], name: str, low: float, high: float) -> tuple[float, float]:
    """Return a saved parameter and its standard deviation. Raises PlanningError, see
    ``Gains.from_numbers``."""
    kept, spread = numbers.get(name), numbers.get(f"{name}_deviation")
    if (
        not isinstance(kept, int | float)
        or not isinstance(spread, int | float)
        or not low <= kept <= high
        or not 0.0 <= spread <= high - low
    ):
        raise PlanningError(
            f"the saved gain of {name} is {kept!r} with deviation {spread!r}; the gain "
            f"must be {low:g} to {high:g} and the deviation 0 to {high - low:g}; delete the file "
            "to start without saved gains"
        )
    return kept, spread


def _logarithm(factor: Array) -> Array:
    """Convert a factor and its standard deviation, (2,), to those of its logarithm."""
    value, deviation = factor
    return np.array([math.log(value), deviation / value])


def _replace_main(belief: Belief, mean: Array, covariance: Array) -> None:
    """Replace the narrowest prior by saved numbers, with the weight ``KEPT``."""
    belief.weight[1:] *= (1.0 - KEPT) / belief.weight[1:].sum()
    belief.weight[0] = KEPT
    belief.mean[0] = mean
    belief.covariance[0] = covariance


def _directions(travel: Array) -> tuple[Array, Array]:
    """Return the coefficients of o_x and o_y for directions of travel (rad) in the object's
    frame."""
    return -np.sin(travel), np.cos(travel)


def _across(learnt: Array, travel: Array) -> Array:
    """Return the rotation per distance (rad/m) due to the offset, for directions in the object's
    frame."""
    first, second = _directions(travel)
    return np.asarray(learnt[..., 4] * first + learnt[..., 5] * second)
