"""Closed loop of one positioning task: measure, decide, tap, learn. Uses no clock and no ROS."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.mechanics import Polygon
from tapping_cell.planning.alternatives import alternative_taps
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.free_space import FreeSpace
from tapping_cell.planning.gains import LOWEST, NAMES, Gains, Slid, Spread
from tapping_cell.planning.goal import check_goal, edge_warning, others_text, place_text
from tapping_cell.planning.interface import Array, Planner, Taps, TapValues
from tapping_cell.planning.near_taps import NearTaps, best_first, near_taps
from tapping_cell.planning.refusal import Refusal, RefusalReason
from tapping_cell.planning.settings import CameraNoise, PlannerSettings
from tapping_cell.planning.stopping import (
    LONG_OBSERVATION,
    MARGIN,
    SMALLEST_SHARE,
    StoppingBox,
    stopping_box,
)
from tapping_cell.planning.strike import BoolArray, StrikePlan, StrikeSpace
from tapping_cell.planning.tap_times import TapTimes
from tapping_cell.planning.track import Launched, Track, launch_from, launched_of, slid_of
from tapping_cell.planning.visited import VisitedPoses
from tapping_cell.se2 import Pose, difference, displaced, wrap_angle

MAX_TAPS = 100
"""Maximum number of taps of a run. More taps indicate a fault that the planner cannot detect."""

MISSED = 0.1
"""A tap has missed if it moved the object by less than this share of the expected distance."""

ELSEWHERE = math.radians(20.0)
"""Minimum change of the tap's direction after a miss, because the same tap would miss again."""

PROBE_SIZE = 1.5
"""Length of a probe tap, as a multiple of the smallest tap's length."""

MAX_PROBES = 3

PROBE_HEADINGS = np.arange(24) * (2.0 * math.pi / 24)

UNKNOWN = 1.6
"""If the ratio of the longest possible slide to the predicted slide is above this value, the object
is probed first. For an object that matches its file, the ratio is 1.2 after one tap."""

JUDGING_ROTATION = ((3, 0.975), (6, 0.84))
"""Criteria for refusing an object that does not rotate: number of taps, and probability that its
rotation gain is below the least gain. Without them, such a run would end only at the maximum number
of taps."""

MIN_ROTATION_GAIN = float(LOWEST[NAMES.index("rotation")])

NEAR_CHUNK = 12
"""Number of taps whose clearance is checked together, best first."""

_ROUNDING = 1e-6
"""Rounding error that is accepted in the correlations of a covariance."""

BLOCKED = 1.05
"""Ratio of path length to straight distance above which the straight line counts as blocked.
Path lengths on the grid are accurate to 3 %."""


@dataclass(frozen=True, slots=True)
class Done:
    """The object is at the goal with the required confidence.

    residual: goal minus object, (dx, dy, dtheta) in `table`, m and rad. box: the stopping box;
    None for a prescribed tap, whose residual is relative to the predicted end pose.
    """

    residual: Pose
    box: StoppingBox | None


@dataclass(frozen=True, slots=True)
class ObserveAgain:
    """The object may be at the goal, and a longer observation may confirm this.

    residual: goal minus object, (dx, dy, dtheta) in `table`, m and rad. probability: probability
    that the object is within the tolerance.
    """

    residual: Pose
    probability: float


class Expected(NamedTuple):
    """Expected effort until the goal is reached, including the next tap; NaN where unknown.

    taps: number of taps. seconds: time from the command of the next tap on, s.
    """

    taps: float = math.nan
    seconds: float = math.nan


UNKNOWN_EFFORT = Expected()


@dataclass(frozen=True, slots=True)
class Strike:
    """The next tap.

    commanded: displacement (dx, dy, dtheta) requested from the mechanics model, in `table`.
    wanted: expected displacement according to the learnt gains; predicted: expected final pose.
    residual: goal minus object before the tap. plan: strike and arm waypoints.
    method: planning method that chose the tap; detour: reason why the method's first choice was
    rejected, or an empty string.
    expected: expected effort until the goal is reached.
    """

    commanded: Pose
    wanted: Pose
    predicted: Pose
    residual: Pose
    plan: StrikePlan
    method: str
    detour: str = ""
    expected: Expected = UNKNOWN_EFFORT


Decision = Done | ObserveAgain | Strike | Refusal
Observed = tuple[ArrayLike, ArrayLike]
"""Measured pose (3,) of an object, m and rad in `table`, and its covariance (3, 3)."""


class GoalSession(ABC):
    """Base class of the closed loops to a goal: decides to stop, observe again, refuse or tap.

    ``goal``: x, y (m), theta (rad) of the object in `table`; ``gains``: what was learnt about the
    object; ``taps``: number of taps fired. Subclasses add the refusals and the choice of a tap for
    one kind of cell.
    """

    arm: ArrayLike | None = None
    """Pose of the arm's tip in `table`: x, y, height (m) and yaw (rad); None if unknown."""
    track: Track | None = None
    """Poses measured during the slide of the last tap, for the next ``observe``; None if the
    slide was not seen. Only the sessions of an arm use it."""
    launched: Launched | None = None
    """Launch of the last tap in its track; None without a track."""
    _goal_refusal: Refusal | None

    def __init__(
        self, goal_pose: ArrayLike, gains: Gains | None, adapt: bool, most_taps: int
    ) -> None:
        self.goal: Array = np.asarray(goal_pose, dtype=float)
        self.gains = Gains.start() if gains is None else gains
        self.taps = 0
        self._adapt = adapt
        self._most_taps = most_taps

    @property
    @abstractmethod
    def settings(self) -> PlannerSettings:
        """Tolerance, scatter and camera."""

    @property
    def ready(self) -> bool:
        """True if a decision can be made. A session that requires a solution is ready once the
        solution is available."""
        return True

    @abstractmethod
    def observe(
        self,
        strike: Strike,
        pose_before: ArrayLike,
        pose_after: ArrayLike,
        covariance: ArrayLike | None = None,
    ) -> None:
        """Learn from a tap that was fired."""

    @abstractmethod
    def edge_warning(self, pose: ArrayLike) -> str:
        """Return a warning if few taps are possible at this pose, else an empty string."""

    @property
    @abstractmethod
    def method(self) -> str:
        """Name of the planning method, for records."""

    @abstractmethod
    def _place_refusal(self, pose: Array) -> Refusal | None:
        """Return the reason why no tap may be made from this pose, or None."""

    @property
    @abstractmethod
    def _too_many_taps(self) -> str:
        """Message if the goal is not reached after the maximum number of taps."""

    @abstractmethod
    def _next_tap(self, pose: Array, left: Array) -> Strike | Refusal:
        """Return the tap to make, or the reason why no tap is possible."""

    @abstractmethod
    def skip(self, strike: Strike) -> None:
        """Reject a tap that the operator did not want. Until the next tap is fired, a different tap
        is chosen if one is possible."""

    def predicted_covariance(self, strike: Strike, pose: Pose) -> Array:
        """Compute the covariance (3, 3), m and rad, of the pose after a tap of an object at
        ``pose``."""
        return self.gains.predicted_covariance(strike.commanded, pose.theta, self.settings.scatter)

    def residual(self, object_pose: ArrayLike) -> Array:
        """Return goal minus object: (dx, dy, dtheta) in `table`, with the rotation in the shorter
        sense."""
        return difference(object_pose, self.goal)

    def stopping(self, covariance: ArrayLike | None) -> StoppingBox:
        """Return the stopping box for an observation with this covariance, (3, 3) in m and rad."""
        settings = self.settings
        noise = settings.camera if covariance is None else noise_of(covariance)
        return stopping_box(
            settings.tolerance_position,
            settings.tolerance_angle,
            noise.position,
            noise.angle,
            settings.box,
        )

    def decide(
        self,
        object_pose: ArrayLike,
        covariance: ArrayLike | None = None,
        *,
        observe_again: bool = True,
    ) -> Decision:
        """Decide on the next step for a stationary object.

        Args:
            object_pose: measured x, y, theta in `table`, m and rad.
            covariance: covariance (3, 3) of that pose; None uses the camera's nominal noise.
            observe_again: whether a longer observation is possible. ``ObserveAgain`` is returned
                only if this is True. Without longer observations, a goal needs more taps.

        Raises:
            PlanningError: the covariance is not (3, 3).
        """
        if self._goal_refusal is not None:
            return self._goal_refusal
        pose = np.asarray(object_pose, dtype=float)
        if pose.shape != (3,) or not np.all(np.isfinite(pose)):
            return Refusal(
                RefusalReason.OBJECT_POSE_NOT_FINITE,
                f"the object's pose {pose.tolist()} is not three finite numbers; check the camera, "
                "then send the goal again",
            )
        if covariance is not None and not _possible_covariance(covariance):
            return Refusal(
                RefusalReason.OBJECT_POSE_NOT_FINITE,
                f"the covariance {np.asarray(covariance).tolist()} of the object's pose is not "
                "finite, symmetric and positive semidefinite; give that of x, y (m) and theta "
                "(rad), then send the goal again",
            )
        arrived = self.arrived(pose, covariance, observe_again=observe_again)
        if arrived is not None:
            return arrived
        left, box = self.residual(pose), self.stopping(covariance)
        return (
            self._camera_refusal(left, box)
            or self._place_refusal(pose)
            or self._count_refusal()
            or self._rotation_refusal(left, box)
            or self._next_tap(pose, left)
        )

    def decisions(self, observe: Callable[[], Observed]) -> Iterator[Decision]:
        """Run the closed loop: observe, decide, and learn from each tap; yield every decision.

        The caller makes each ``Strike`` before it asks for the next decision. After an
        ``ObserveAgain`` the loop observes again and decides on the mean of all observations, at
        most ``LONG_OBSERVATION``. The last decision is ``Done`` or a ``Refusal``. If even that many
        observations cannot confirm a goal, the first tap is refused (CAMERA_TOO_COARSE).

        Args:
            observe: observes the object at rest once. Returns its pose (3,), m and rad in `table`,
                and the covariance (3, 3) of this pose. The errors of two observations must be
                independent.

        Raises:
            PlanningError: ``observe`` returned something else.
        """
        fired: Strike | None = None
        seen: Array = np.full(3, math.nan)
        while True:
            before = seen
            seen, covariance = _checked(observe())
            total = covariance
            if fired is not None:
                self.observe(fired, before, seen, total)
            for count in range(1, LONG_OBSERVATION + 1):
                if count > 1:
                    fresh, covariance = _checked(observe())
                    seen = displaced(seen, difference(seen, fresh) / count)
                    total = total + covariance
                decision = self.decide(
                    seen, total / count**2, observe_again=count < LONG_OBSERVATION
                )
                if fired is None and isinstance(decision, Strike):
                    decision = self._noise_refusal(covariance / LONG_OBSERVATION) or decision
                yield decision
                if not isinstance(decision, ObserveAgain):
                    break
            if not isinstance(decision, Strike):
                return
            fired = decision

    def arrived(
        self, object_pose: ArrayLike, covariance: ArrayLike | None, *, observe_again: bool
    ) -> Done | ObserveAgain | None:
        """Return Done if the object is at the goal, ObserveAgain if it may be there, else None.
        The arguments are those of ``decide``."""
        left = self.residual(object_pose)
        box = self.stopping(covariance)
        residual = Pose(*left.tolist())
        noise = self.settings.camera.covariance if covariance is None else covariance
        found = self.settings.arrival(left, noise)
        if found.done and box.camera_suffices:
            return Done(residual, box)
        if observe_again and found.doubtful:
            return ObserveAgain(residual, float(found.probability))
        return None

    def _noise_refusal(self, covariance: Array) -> Refusal | None:
        """Return a refusal if an observation with this covariance cannot confirm a goal."""
        if self.stopping(covariance).camera_suffices:
            return None
        noise, settings = noise_of(covariance), self.settings
        most = (1.0 - SMALLEST_SHARE) / MARGIN
        return Refusal(
            RefusalReason.CAMERA_TOO_COARSE,
            f"the camera is too coarse for the tolerance: after {LONG_OBSERVATION} observations "
            f"the standard deviations are still {1e3 * noise.position:.3f} mm and "
            f"{math.degrees(noise.angle):.3f} degrees, but a goal can be confirmed only up to "
            f"{1e3 * most * settings.tolerance_position:.3f} mm and "
            f"{math.degrees(most * settings.tolerance_angle):.3f} degrees; calibrate the camera or "
            "widen the tolerance",
        )

    def _camera_refusal(self, left: Array, box: StoppingBox) -> Refusal | None:
        settings = self.settings
        if settings.within_tolerance(left) and not box.camera_suffices:
            return Refusal(
                RefusalReason.CAMERA_TOO_COARSE,
                "the object may be at the goal, but the measured pose is too uncertain to "
                f"confirm it within {1e3 * settings.tolerance_position:.2f} mm and "
                f"{math.degrees(settings.tolerance_angle):.2f} degrees; observe the object at "
                "rest for longer, calibrate the camera or widen the tolerance",
            )
        return None

    def _count_refusal(self) -> Refusal | None:
        if self.taps < self._most_taps:
            return None
        return Refusal(RefusalReason.TOO_MANY_TAPS, self._too_many_taps)

    def _rotation_refusal(self, left: Array, box: StoppingBox) -> Refusal | None:
        """Return a refusal if the angle must be corrected but taps cannot turn the object, else
        None.

        If the rotation gain is below the least gain of the model, the plan predicts rotations that
        no tap causes, and the goal would end only at the maximum number of taps.
        """
        required = [sure for taps, sure in JUDGING_ROTATION if self.gains.taken >= taps]
        if abs(left[2]) <= box.rotation or not required:
            return None
        gain = float(self.gains.largest_rotation_gain(min(required)))
        if gain > MIN_ROTATION_GAIN:
            return None
        return Refusal(
            RefusalReason.TAP_WITHOUT_ROTATION,
            f"taps turn the object by at most {100.0 * gain:.0f} % of what its file predicts "
            f"({100.0 * MIN_ROTATION_GAIN:.0f} % is needed), so that its angle, "
            f"{abs(math.degrees(left[2])):.1f} degrees from the goal, cannot be corrected; clean "
            "the side of the object, check contact_friction in its file, or send a goal with the "
            "object's present angle",
        )

    def _make_strike(
        self,
        pose: Array,
        left: Array,
        commanded: Array,
        plan: StrikePlan,
        detour: str = "",
        expected: Expected = UNKNOWN_EFFORT,
    ) -> Strike:
        wanted = self.gains.predict(commanded, pose[2])
        return Strike(
            commanded=Pose(*commanded.tolist()),
            wanted=Pose(*wanted.tolist()),
            predicted=Pose(*displaced(pose, wanted).tolist()),
            residual=Pose(*left.tolist()),
            plan=plan,
            method=self.method,
            detour=detour,
            expected=expected,
        )


class PositioningSession(GoalSession):
    """Closed loop of one task of the arm: goal, method, learnt gains and possible strikes.

    Args:
        goal_pose: x, y (m), theta (rad) of the object in `table`.
        planner: planning method; its settings hold the tolerance and the box.
        space: the set of possible strikes.
        free: map of tappable places in ``space``. If None, the map is computed here. This takes
            about 0.1 s, so reuse one map for several goals.
        gains: gains learnt about the object in earlier runs.
        times: durations of the arm's motions; None if unknown.
        objective: "taps" chooses the fewest taps, "time" the taps that reach the goal in the least
            time. "time" requires ``times`` and a method that implements ``interface.TapValues``,
            and ``arm`` must be set before a decision.
        adapt: whether ``observe`` learns.
        probe: begin with a few taps of the smallest size, to measure the friction and the rotation
            of an unknown object.
        most_taps: maximum number of taps of the run.
    """

    def __init__(
        self,
        goal_pose: ArrayLike,
        planner: Planner,
        space: StrikeSpace,
        free: FreeSpace | None = None,
        gains: Gains | None = None,
        *,
        times: TapTimes | None = None,
        objective: str = "taps",
        adapt: bool = True,
        probe: bool = False,
        most_taps: int = MAX_TAPS,
    ) -> None:
        super().__init__(goal_pose, gains, adapt, most_taps)
        self.planner = planner
        self._missed: tuple[float, ...] = ()  # headings of consecutive missed taps
        self._skipped: tuple[float, ...] = ()  # headings that the operator rejected
        self._times = times
        self._objective = objective
        self._probes_left = MAX_PROBES if probe else 0
        self._visited = VisitedPoses(self.goal)
        self.use_free_space(space, FreeSpace(space) if free is None else free)

    def use_free_space(self, space: StrikeSpace, free: FreeSpace) -> None:
        """Replace the strike space and its map, because the obstacles on the table may have
        changed."""
        self._space = space
        self._free = free
        self._goal_refusal = check_goal(self.goal, space, free)
        if self._goal_refusal is None:
            self._paths = free.to_goal(self.goal)

    @property
    def settings(self) -> PlannerSettings:
        """Settings of the planning method."""
        return self.planner.settings

    @property
    def method(self) -> str:
        """Name of the planning method, for records."""
        return self.planner.name

    def _next_tap(self, pose: Array, left: Array) -> Strike | Refusal:
        return self._strike(pose, left, self._missed + self._skipped)

    def skip(self, strike: Strike) -> None:
        """Reject a tap that the operator did not want (see ``GoalSession.skip``)."""
        heading = math.atan2(strike.commanded.y, strike.commanded.x)
        self._skipped = (*self._skipped, heading)

    def observe(
        self,
        strike: Strike,
        pose_before: ArrayLike,
        pose_after: ArrayLike,
        covariance: ArrayLike | None = None,
    ) -> None:
        """Learn from a fired tap; the poses are those of the object at rest before and after the
        tap.

        Call this method once per fired tap. If the result is unknown, pass NaN poses.
        """
        self.taps += 1
        self._probes_left = max(0, self._probes_left - 1)
        settings = self.planner.settings
        moved = difference(pose_before, pose_after)
        asked = math.hypot(strike.wanted.x, strike.wanted.y)
        missed = math.hypot(moved[0], moved[1]) < MISSED * asked
        heading = math.atan2(strike.commanded.y, strike.commanded.x)
        self._missed = (*self._missed, heading) if missed else ()
        self._skipped = ()
        orientation = float(np.asarray(pose_before, dtype=float)[2])
        slid = self._slid(strike.commanded, pose_before, pose_after)
        if not self._adapt:
            return
        noise = settings.camera if covariance is None else noise_of(covariance)
        self.gains = self.gains.observe(
            strike.commanded, moved, orientation, settings.scatter, noise, slid
        )

    def _slid(self, commanded: Pose, before: ArrayLike, after: ArrayLike) -> Slid | None:
        """Evaluate the track of a tap and discard it. Return what the model predicts for the
        launch; None if the launch is unknown."""
        track, self.track, self.launched = self.track, None, None
        sliding = self._space.tap.sliding
        launch = None if track is None else launch_from(track, before, after, sliding)
        if track is None or launch is None:
            return None
        orientation = float(np.asarray(before, dtype=float)[2])
        self.launched = launched_of(launch, len(track.time), commanded, orientation, sliding)
        return slid_of(launch, before, after, sliding)

    def edge_warning(self, pose: ArrayLike) -> str:
        """Return a warning if the object is close to an edge or over it, else an empty string."""
        return edge_warning(pose, self._space)

    def _place_refusal(self, pose: Array) -> Refusal | None:
        edge = float(self._space.workspace.edge_distance(pose[:2]))
        if edge < 0.0:
            return Refusal(
                RefusalReason.OBJECT_OFF_TABLE,
                f"the object's centre at {place_text(pose)} is {-1e3 * edge:.1f} mm beyond the "
                "table's edge; put it back by hand",
            )
        if not self._paths.reachable(pose):
            return Refusal(
                RefusalReason.NO_PATH_TO_GOAL,
                f"there is no path from {place_text(pose)} to the goal "
                f"{place_text(self.goal)} along which the object can be tapped; remove a "
                "keep-out or choose another goal" + others_text(self._space),
            )
        return None

    @property
    def _too_many_taps(self) -> str:
        return (
            f"the object is not at the goal after {self.taps} taps (limit {self._most_taps});"
            " raise the limit, or check the striker, the camera and the object's file"
        )

    def _strike(self, pose: Array, left: Array, missed: tuple[float, ...]) -> Strike | Refusal:
        probe = self._probe(pose, left, missed)
        if probe is not None:
            return probe
        box, slope = self.planner.settings.stopping.rotation, self.planner.settings.cone_slope
        distance, turn, heading = self.gains.to_plan(left, box)
        tap = self.planner.choose(distance, turn)
        share = min(1.0, self._longest_tap() / max(abs(float(tap.distance)), 1e-9))
        rotation = self.gains.from_plan(left, share * tap.rotation, box)
        first = self.gains.command(share * tap.distance, rotation, heading, pose[2], slope)
        detour = self._obstacle(pose, first, missed)
        best = self._best_near(pose, left, tap, missed)
        if best is not None:
            return self._chosen(pose, left, *best, detour)
        if not detour:
            found = self._space.first_strike(Pose(*pose.tolist()), first[None, :])
            if found is not None:
                return self._chosen(pose, left, first, found[1], "")
            detour = (
                "the arm or the tool lacks space for the tap along the line to the goal"
                if bool(self._space.tap.reachable(first, pose))
                else "no contact of the object allows the tap along the line to the goal"
            )
        if missed and self._skipped and "skipped" not in detour:
            detour += "; another tap was skipped"
        return self._alternative(pose, left, first, detour, missed)

    def _alternative(
        self, pose: Array, left: Array, first: Array, detour: str, missed: tuple[float, ...]
    ) -> Strike | Refusal:
        """Return the best tap other than ``first``, which was rejected because of ``detour``."""
        # Whether some slide is safe, some contact allows a safe slide, and some slide would be safe
        # if the object's file were exact.
        allowed = struck = trusted = False

        def safe(candidates: Array) -> BoolArray:
            nonlocal allowed, trusted
            short = np.hypot(candidates[:, 0], candidates[:, 1]) * self.gains.value[0]
            fits = short <= self._longest_tap() * (1.0 + 1e-9)
            fits &= _elsewhere(candidates, missed) & self._ends_well(pose, candidates)
            if not trusted and not np.any(fits):
                trusted = bool(np.any(self._ends_well(pose, candidates, trusting=True)))
            allowed = allowed or bool(np.any(fits))
            return np.asarray(fits)

        def possible(candidates: Array) -> BoolArray:
            nonlocal struck
            here = np.broadcast_to(pose, candidates.shape)
            reached, fits = self._space.contacts(here, candidates)
            struck = struck or bool(np.any(reached))
            return fits

        for candidates, cost in alternative_taps(
            pose,
            self.goal,
            first,
            self.gains,
            self.planner,
            self._paths,
            self._space.tap,
            self._space.strikeable,
            self._visited,
            safe,
            possible,
        ):
            found = self._space.first_strike(Pose(*pose.tolist()), candidates[:1])
            if found is not None:
                self._visited.add(pose, 1.0 + float(cost[0]))
                return self._chosen(pose, left, candidates[0], found[1], detour)
        if missed:
            return self._strike(pose, left, missed=())
        return self._no_strike(pose, detour, allowed, struck, trusted)

    def _chosen(
        self, pose: Array, left: Array, commanded: Array, plan: StrikePlan, detour: str
    ) -> Strike:
        expected = self._expected(pose, left, commanded, plan)
        return self._make_strike(pose, left, commanded, plan, detour, expected)

    def _expected(self, pose: Array, left: Array, commanded: Array, plan: StrikePlan) -> Expected:
        """Return the expected effort of a displacement (3,) and of the taps after it. The effort is
        unknown if the method cannot compute it or if an obstacle blocks the straight line to the
        goal."""
        if not isinstance(self.planner, TapValues) or self._blocked(pose):
            return UNKNOWN_EFFORT
        box = self.planner.settings.stopping.rotation
        moved = self.gains.predict(commanded, pose[2])
        distance, rotation, heading = self.gains.to_plan(left, box)
        turn = rotation - self.gains.to_plan(left - moved, box)[1]
        size, direction = np.hypot(moved[0], moved[1]), np.arctan2(moved[1], moved[0])
        most = self.planner.settings.cone_slope * float(size)
        follow = self.planner.taps_after(
            float(distance),
            float(rotation),
            np.array([float(direction - heading)]),
            np.array([float(size)]),
            np.clip([float(turn)], -most, most),
        )
        if follow is None:
            return UNKNOWN_EFFORT
        taps = 1.0 + follow.item()
        return Expected(taps, self._expected_seconds(taps, plan))

    def _expected_seconds(self, taps: float, plan: StrikePlan) -> float:
        """Return the expected time, s, of this number of taps, the first of which is ``plan``; NaN
        if the durations of the arm's motions are unknown."""
        if self._times is None:
            return math.nan
        way = self._times.mean_way
        if self.arm is not None:
            own = self._times.to_strikes(self.arm, np.array([plan.strike_pose])).item()
            way = own if math.isfinite(own) else way
        return taps * self._times.mean_tap + way - self._times.mean_way

    def _best_near(
        self, pose: Array, left: Array, own: Taps, missed: tuple[float, ...]
    ) -> tuple[Array, StrikePlan] | None:
        """Return the tap, among taps in all directions, with which the goal is reached in the least
        expected time: its displacement (3,) and strike. Return None if this time is unknown.
        ``own``: the tap chosen by the method."""
        if self._objective != "time" or self._times is None or self.arm is None:
            return None
        # The expected times ignore that a polygon can be tapped in only a few directions.
        polygon = isinstance(self._space.tap.body, Polygon)
        if polygon or self._blocked(pose) or not isinstance(self.planner, TapValues):
            return None
        taps = near_taps(pose, left, own, self.gains, self.planner, self.settings)
        if taps is None:
            return None
        longest = self._longest_tap() * (1.0 + 1e-9) / float(self.gains.value[0])
        fits = np.hypot(taps.commanded[:, 0], taps.commanded[:, 1]) <= longest
        fits &= _elsewhere(taps.commanded, missed) & self._ends_well(pose, taps.commanded)
        safe = NearTaps(taps.commanded[fits], taps.follow[fits])
        tip = np.asarray(self.arm, dtype=float)
        best = best_first(pose, left, safe, self.gains, self._space, self._times, tip)
        for start in range(0, len(best), NEAR_CHUNK):
            some = best[start : start + NEAR_CHUNK]
            found = self._space.first_strike(Pose(*pose.tolist()), some)
            if found is not None:
                return some[found[0]], found[1]
        return None

    def _no_strike(
        self, pose: Array, first: str, allowed: bool, struck: bool, trusted: bool
    ) -> Refusal:
        """Return the refusal that explains why no tap is possible.

        ``allowed``: some slide would be safe; ``struck``: some contact allows a safe slide;
        ``trusted``: some slide would be safe if the object's file were exact; ``first``: why the
        method's first choice was rejected.
        """
        place = place_text(pose)
        if allowed and not struck:
            return Refusal(
                RefusalReason.NO_CONTACT,
                f"the object at {place} cannot be tapped safely in any direction: its edges "
                "transmit only impulses within the friction cone, and no contact point allows any "
                f"of the safe slides. The preferred tap was rejected because {first}. Turn the "
                "object by hand, or move it towards the middle",
            )
        longest = self._longest_factor()
        if trusted and not allowed and longest > UNKNOWN:
            return Refusal(
                RefusalReason.PROBE_NEEDED,
                f"no tap is certain to be safe with the object at {place}: until its friction "
                f"is measured it may slide {longest:.1f} times as far as its file says; "
                "request a probe (goal --probe: a few of the smallest taps), or move it "
                "towards the middle" + others_text(self._space),
            )
        return Refusal(
            RefusalReason.NO_STRIKE,
            f"no tap is possible with the object at {place}: every tap is out of the "
            "arm's reach, or would move the object off the table, into a keep-out or to a place "
            f"from which it cannot be tapped back (the preferred tap was rejected because "
            f"{first}); move the object by hand towards the middle" + others_text(self._space),
        )

    def _longest_factor(self) -> float:
        """Return the ratio of the longest possible slide, within the bounds of the uncertainty, to
        the predicted slide."""
        spread = self._spread([1.0, 0.0, 0.0])
        return 1.0 if spread is None else float(spread.longest)

    def _longest_tap(self) -> float:
        """Return the length of the longest tap allowed now, m. After an outlier the length is
        reduced, so that a changed object slides no farther than the largest tap."""
        settings = self.planner.settings
        if not bool(self.gains.surprised):
            return settings.largest_distance
        return max(
            settings.largest_distance / self._longest_factor(), 2.0 * settings.smallest_distance
        )

    def _probe(self, pose: Array, left: Array, missed: tuple[float, ...]) -> Strike | None:
        """Return a probe tap if a probe was requested and is still needed, else None. The tap
        differs from those with the headings ``missed`` (rad)."""
        if self._probes_left == 0 or self._longest_factor() <= UNKNOWN:
            return None
        settings = self.planner.settings
        size = PROBE_SIZE * settings.smallest_distance
        heading = math.atan2(left[1], left[0]) + PROBE_HEADINGS
        turn = math.copysign(0.5 * settings.cone_slope * size, left[2])
        candidates = self.gains.command(
            np.full(heading.shape, size), turn, heading, pose[2], settings.cone_slope
        )
        safe = candidates[self._ends_well(pose, candidates) & _elsewhere(candidates, missed)]
        if safe.shape[0] == 0:
            return None
        found = self._space.first_strike(Pose(*pose.tolist()), safe)
        if found is None:
            return None
        return self._make_strike(
            pose,
            left,
            safe[found[0]],
            found[1],
            "it is a probe tap, which measures how far the object slides and how much it turns",
        )

    def _ends_well(self, pose: Array, commanded: Array, *, trusting: bool = False) -> BoolArray:
        """Return which displacements (n, 3) are acceptable, (n,). The slide must be safe for all
        deviations within the bounds of the whole uncertainty, and it must end at a tappable place
        for all deviations within the bounds of the scatter. ``trusting``: ignore the uncertainty of
        the gains."""
        expected = self.gains.predict(commanded, pose[2])
        end = self._space.footprint(pose, expected)[..., -1, :]
        tappable = np.all(self._free.contains(end), axis=-1)
        nominal = self._free.contains(pose[:2] + expected[..., :2])
        if not self._free.contains(pose[:2]):
            # The object is not at a tappable place, so only the expected end must be at one.
            tappable = nominal
        spread = None if trusting else self._spread(commanded)
        safe = self._space.slide_is_safe(pose, expected, spread)
        return np.asarray(tappable & nominal & safe)

    def _spread(self, commanded: ArrayLike) -> Spread | None:
        """Return bounds of the true displacements for commands (..., 3).

        Return None if the session does not learn and therefore trusts the object's file; then only
        the scatter makes displacements uncertain.
        """
        if not self._adapt:
            return None
        scatter, deviations = self.planner.settings.scatter, self._space.settings.footprint
        return self.gains.spread(commanded, scatter, deviations)

    def _obstacle(self, pose: Array, commanded: Array, missed: tuple[float, ...]) -> str:
        """Return why the slide of a displacement (3,) is not acceptable, or an empty string."""
        if missed and not bool(_elsewhere(commanded, self._skipped)):
            return "a tap in this direction was skipped"
        if not bool(_elsewhere(commanded, missed)):
            return "the last tap in this direction did not move the object"
        if self._blocked(pose):
            return "the straight line to the goal is blocked"
        if self._leads_back(pose, commanded):
            return (
                "the tap along the line to the goal leads back to a place from which more taps "
                "than estimated were needed before"
            )
        if bool(self._ends_well(pose, commanded[None, :])[0]):
            return ""
        return (
            "the tap along the line to the goal might make the object leave the table, enter a "
            "keep-out or end out of reach"
        )

    def _leads_back(self, pose: Array, commanded: Array) -> bool:
        """Return whether a displacement (3,) ends near a visited pose from which at least one tap
        more is needed than the method estimates."""
        after = (pose + self.gains.predict(commanded, pose[2]))[None, :]
        left = self.residual(after[0])
        distance, turn, _ = self.gains.to_plan(left, self.planner.settings.stopping.rotation)
        cost = np.atleast_1d(self.planner.taps_to_go(distance, turn))
        return bool(self._visited.extra(after, cost)[0] >= 1.0)

    def _blocked(self, pose: Array) -> bool:
        """Return whether an obstacle blocks the straight line from the object to the goal."""
        straight = math.hypot(self.goal[0] - pose[0], self.goal[1] - pose[1])
        return float(self._paths.length(pose[:2])) > BLOCKED * straight + 1e-9


def _elsewhere(commanded: Array, missed: tuple[float, ...]) -> BoolArray:
    """Return which displacements (..., 3) differ enough from all ``missed`` headings (rad)."""
    heading = np.arctan2(commanded[..., 1], commanded[..., 0])
    between = np.abs(wrap_angle(heading[..., None] - np.array(missed)))
    return np.asarray(np.all(between >= ELSEWHERE, axis=-1))


def _checked(observed: Any) -> tuple[Array, Array]:
    """Return pose and covariance of an observation as arrays. Raises PlanningError."""
    try:
        seen, covariance = observed
        pose: Array = np.asarray(seen, dtype=float)
        matrix: Array = np.asarray(covariance, dtype=float)
    except (TypeError, ValueError):
        pose = matrix = np.zeros(0)
    if pose.shape != (3,) or matrix.shape != (3, 3):
        raise PlanningError(
            f"observe() returned {observed!r}; return a pose (x, y, theta) and its covariance "
            "(3, 3), in m and rad, such as pose, CameraNoise(1e-4, 1e-3).covariance"
        )
    return pose, matrix


def _possible_covariance(covariance: ArrayLike) -> bool:
    """Return whether a covariance is finite, symmetric and positive semidefinite, apart from
    rounding. Raises PlanningError if it is not (3, 3)."""
    matrix = np.asarray(covariance, dtype=float)
    if matrix.shape != (3, 3):
        raise PlanningError(
            f"the covariance {covariance!r} is not a matrix (3, 3) of x, y (m) and theta (rad); "
            "CameraNoise(1e-4, 1e-3).covariance is that of a camera"
        )
    variance = np.diag(matrix)
    if not np.all(np.isfinite(matrix)) or np.any(variance < 0.0):
        return False
    # As correlations, because the units of the elements differ.
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    unit = matrix / np.outer(scale, scale)
    symmetric = bool(np.all(np.abs(unit - unit.T) <= _ROUNDING))
    return symmetric and float(np.min(np.linalg.eigvalsh(unit))) >= -_ROUNDING


def noise_of(covariance: ArrayLike) -> CameraNoise:
    """Convert a pose covariance (3, 3) to camera noise; the position noise is that of the worst
    direction."""
    matrix = np.asarray(covariance, dtype=float)
    largest = float(np.max(np.linalg.eigvalsh(matrix[:2, :2])))
    return CameraNoise(math.sqrt(max(largest, 0.0)), math.sqrt(max(float(matrix[2, 2]), 0.0)))
