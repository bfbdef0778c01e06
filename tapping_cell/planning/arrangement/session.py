"""Closed loop for several objects: chooses the next object and its tap. Uses no clock and no ROS.

With a single object, the only move is the move of this object to its goal. A ``PositioningSession``
carries out each move and avoids the other objects at their last measured poses. The session plans
again if an object was touched, was pushed by hand or cannot be moved any further.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.arrangement.among import AmongOthers, areas_of, bodies_among
from tapping_cell.planning.arrangement.interface import (
    ArrangementPlanner,
    Body,
    Move,
    Purpose,
    Scene,
)
from tapping_cell.planning.arrangement.layout import check_layout
from tapping_cell.planning.arrangement.sequence import BUFFER_SLACK, SequencePlanner, taps
from tapping_cell.planning.free_space import FreeSpace
from tapping_cell.planning.gains import Gains
from tapping_cell.planning.interface import Planner
from tapping_cell.planning.refusal import Refusal, RefusalReason
from tapping_cell.planning.session import (
    Done,
    ObserveAgain,
    PositioningSession,
    Strike,
    noise_of,
)
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.two_tap import ExactPlanner
from tapping_cell.planning.workspace import KeepOut
from tapping_cell.se2 import Pose

COARSE_ANGLE = 1.5
"""Tolerance of the rotation of an object that is moved out of the way, rad."""

TOUCHED = 0.002
"""Displacement, m, beyond the camera's noise, above which an object counts as touched."""

SETTLED = 0.0005
"""If another object was displaced by at most this value, m, it counts as stationary, and the map is
reused."""

STILL = 4.0
"""Number of standard deviations up to which two observations show an object at rest."""

MAX_TAPS_EACH = 60

TIMEOUT = 6
"""After this number of consecutive taps of a move without progress, other moves are preferred."""

PROGRESS = 0.25
"""Decrease of the estimated number of remaining taps that counts as progress."""


@dataclass(frozen=True, slots=True)
class Observation:
    """Observation of a stationary object: pose in `table` and its covariance (3, 3), m and rad.
    With the covariance None, the camera's nominal noise is used."""

    pose: Pose
    covariance: ArrayLike | None = None


@dataclass(frozen=True, slots=True)
class TapOf:
    """The next tap and the name of its object."""

    name: str
    strike: Strike
    move: Move


@dataclass(frozen=True, slots=True)
class ObserveLonger:
    """Request for a longer observation, which may confirm that the object is at its goal."""

    name: str
    request: ObserveAgain


@dataclass(frozen=True, slots=True)
class AllDone:
    """Every object with a goal is at its goal with the required confidence."""

    residuals: Mapping[str, Pose]


ArrangementDecision = AllDone | ObserveLonger | TapOf | Refusal


class ArrangementSession:
    """Closed loop of one arrangement: goals, plan, learnt gains and taps.

    Args:
        bodies: all objects on the table, including unmovable ones.
        planner: chooses the next object; by default the built-in sequence planner.
        gains: gains of each object that were learnt in earlier runs.
        adapt: whether to learn from taps.
        order: names of objects to be finished in this order before the other objects.
        most_taps: maximum number of taps of all objects together.
        obstacles: areas that every object and the striker avoid; see :meth:`avoid`.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        planner: ArrangementPlanner | None = None,
        gains: Mapping[str, Gains] | None = None,
        *,
        adapt: bool = True,
        order: Iterable[str] = (),
        most_taps: int | None = None,
        maps: AmongOthers | None = None,
        obstacles: Sequence[KeepOut] = (),
    ) -> None:
        self._given, self._obstacles = tuple(bodies), tuple(obstacles)
        self.bodies = bodies_among(bodies, obstacles)
        self._by_name = {body.name: body for body in self.bodies}
        self._maps = AmongOthers() if maps is None else maps
        self._planner = SequencePlanner(self._maps) if planner is None else planner
        self._known: Mapping[str, Gains] = {} if gains is None else gains
        self.gains = {body.name: self._known.get(body.name, Gains.start()) for body in bodies}
        self._adapt = adapt
        self._order = tuple(order)
        goals = sum(body.goal is not None for body in bodies)
        self._most_taps = MAX_TAPS_EACH * max(1, goals) if most_taps is None else most_taps
        self._checked = False
        self._excluded: frozenset[tuple[str, Purpose]] = frozenset()
        self._stalled: frozenset[tuple[str, Purpose]] = frozenset()
        self._buffers: dict[str, tuple[Pose, ...]] = {}
        self._confirmed: dict[str, Pose] = {}
        # maps each object that made way to the object for which it waits
        self._waits_for: dict[str, str] = {}
        self._best = math.inf  # smallest estimate of the remaining taps of the current move
        self._taps_without_progress = 0  # consecutive taps of the current move without progress
        self._session: PositioningSession | None = None
        self._session_move: Move | None = None
        self._session_map: FreeSpace | None = None
        self._last: dict[str, Pose] = {}
        self._settled: dict[str, Pose] = {}
        self._tapped = ""
        self._skipped: dict[str, tuple[Strike, ...]] = {}  # rejected taps of each object
        self.move: Move | None = None
        """Current move; None before the first move and after the last one."""
        self.finished: frozenset[str] = frozenset()
        """Names of the objects at their goals."""
        self.taps = dict.fromkeys(self._by_name, 0)
        """Number of taps fired at each object."""
        self.touched: tuple[str, ...] = ()
        """Names of the objects that moved during the last tap of another object."""

    @property
    def current(self) -> PositioningSession | None:
        """Session of the current or the last move."""
        return self._session

    def avoid(self, obstacles: Sequence[KeepOut]) -> None:
        """Avoid these obstacles from now on, instead of the previous ones. The layout is checked
        again, and the next move is planned again."""
        self._obstacles = tuple(obstacles)
        self._plan_again()

    def set_bodies(self, bodies: Sequence[Body]) -> None:
        """Arrange these objects from now on, instead of the previous ones. The layout is checked
        again, and the next move is planned again.

        Learnt gains and numbers of taps also remain for objects that are taken out.
        """
        self._given = tuple(bodies)
        names = {body.name for body in bodies}
        for name in names:
            self.gains.setdefault(name, self._known.get(name, Gains.start()))
            self.taps.setdefault(name, 0)
        self.finished &= names
        for poses in (self._settled, self._last, self._confirmed):
            for name in poses.keys() - names:
                del poses[name]
        self._waits_for = {
            name: other for name, other in self._waits_for.items() if {name, other} <= names
        }
        self._plan_again()

    def _plan_again(self) -> None:
        self.bodies = bodies_among(self._given, self._obstacles)
        self._by_name = {body.name: body for body in self.bodies}
        self._checked, self.move, self._session = False, None, None
        self._excluded = self._stalled = frozenset()

    def decide(
        self, seen: Mapping[str, Observation], *, observe_again: bool = True
    ) -> ArrangementDecision:
        """Decide on the next step; ``seen`` must contain an observation of every object."""
        missing = [body.name for body in self.bodies if body.name not in seen]
        if missing:
            return Refusal(
                RefusalReason.OBJECT_POSE_NOT_FINITE,
                f"the camera has not observed {', '.join(map(repr, missing))}; uncover these "
                "objects",
            )
        poses = {name: seen[name].pose for name in self._by_name}
        for name, pose in poses.items():
            before = self._settled.get(name)
            if before is None or before.distance_to(pose) > SETTLED:
                self._settled[name] = pose
        if not self._checked:
            refusal = check_layout(Scene(self.bodies, self._settled), self._maps)
            if refusal is not None:
                return refusal
            self._checked = True
        if self._notice_contacts(poses):
            self.move, self._excluded, self._stalled = None, frozenset(), frozenset()
            for name in self.touched:
                self._confirmed.pop(name, None)
        # A hand may have turned or moved an object away from its goal while the move of another
        # object goes on.
        self.finished = frozenset(
            name for name in self.finished if self._by_name[name].is_at_goal(poses[name])
        )
        for _ in range(4 * len(self.bodies) + 4):
            if self.move is None:
                chosen = self._choose(seen, poses, observe_again)
                if not isinstance(chosen, Move):
                    return chosen
                self._begin(chosen)
                assert self.move is not None
            decision = self._step(self.move, seen[self.move.name], observe_again)
            if decision is not None:
                return decision
        return Refusal(
            RefusalReason.NO_ARRANGEMENT,
            "no tap is possible for any of the planned moves; take an object away or move the "
            "goals apart",
        )

    def observe(self, tap: TapOf, before: Observation, after: Observation) -> None:
        """Learn from a fired tap; ``before`` and ``after`` are observations of the object at
        rest."""
        self.taps[tap.name] += 1
        self._tapped = tap.name
        self._confirmed.pop(tap.name, None)
        self._excluded = frozenset()
        self._skipped.clear()
        # A move that failed may be possible once another object has moved.
        self._stalled = frozenset(each for each in self._stalled if each[0] == tap.name)
        self._taps_without_progress += 1
        if self._session is not None and self.move == tap.move:
            self._session.observe(tap.strike, before.pose, after.pose, after.covariance)
            self.gains[tap.name] = self._session.gains

    def skip(self, tap: TapOf) -> None:
        """Reject a tap. Until the next tap is fired, a different tap of this object is chosen if
        one is possible, even if the move is planned again."""
        self._skipped[tap.name] = (*self._skipped.get(tap.name, ()), tap.strike)
        if self._session is not None and self.move == tap.move:
            self._session.skip(tap.strike)

    def _begin(self, move: Move) -> None:
        """Make a move the current one."""
        self.move = move
        self._best, self._taps_without_progress = math.inf, 0
        if move.purpose is Purpose.MAKE_WAY:
            self._buffers[move.name] = (*self._buffers.get(move.name, ()), move.target)
            if move.blocked:
                self._waits_for[move.name] = move.blocked

    def _progresses(self, move: Move, pose: Pose) -> bool:
        """Return whether the recent taps of a move have brought its object closer to the target."""
        body = self._by_name[move.name]
        others = areas_of(self.bodies, self._settled, [move.name])
        path = self._maps.path(body, others, pose, move.target)
        turn = 0.0 if move.purpose is Purpose.MAKE_WAY else pose.rotation_to(move.target)
        left = taps(body, path, turn) if math.isfinite(path) else math.inf
        if left <= self._best - PROGRESS:
            self._best, self._taps_without_progress = left, 0
        return self._taps_without_progress < TIMEOUT

    def _residual(self, name: str, pose: Pose) -> Pose:
        goal = self._by_name[name].target
        return Pose(goal.x - pose.x, goal.y - pose.y, pose.rotation_to(goal))

    def _notice_contacts(self, poses: Mapping[str, Pose]) -> bool:
        moved = []
        for name, pose in poses.items():
            before = self._last.get(name)
            limit = TOUCHED + 6.0 * self._by_name[name].planner.settings.camera.position
            if before is not None and name != self._tapped and before.distance_to(pose) > limit:
                moved.append(name)
        self._last, self._tapped, self.touched = dict(poses), "", tuple(moved)
        return bool(moved)

    def _choose(
        self, seen: Mapping[str, Observation], poses: Mapping[str, Pose], observe_again: bool
    ) -> Move | AllDone | ObserveLonger | Refusal:
        """Check which objects are at their goals; return the next move, or AllDone."""
        done = set()
        for body in self.bodies:
            if body.goal is None:
                continue
            if self._still_at_goal(body, seen[body.name]):
                done.add(body.name)
                continue
            decision = _at_goal(body, self._most_taps).arrived(
                seen[body.name].pose, seen[body.name].covariance, observe_again=observe_again
            )
            if isinstance(decision, Done):
                done.add(body.name)
                self._confirmed[body.name] = poses[body.name]
            elif isinstance(decision, ObserveAgain):
                return ObserveLonger(body.name, decision)
        self.finished = frozenset(done)
        if all(body.goal is None or body.name in done for body in self.bodies):
            return AllDone({name: self._residual(name, poses[name]) for name in done})
        if sum(self.taps.values()) >= self._most_taps:
            return Refusal(
                RefusalReason.TOO_MANY_TAPS,
                f"{sum(self.taps.values())} taps did not bring all objects to their goals "
                f"(limit {self._most_taps}); raise the limit, or check the striker, the camera and "
                "the objects' files",
            )
        waiting = frozenset(n for n, other in self._waits_for.items() if other not in done)
        chosen = self._planner.next_move(self._scene(self._excluded | self._stalled, waiting))
        if isinstance(chosen, Refusal) and (self._stalled or waiting):
            self._stalled, self._waits_for = frozenset(), {}
            chosen = self._planner.next_move(self._scene(self._excluded, frozenset()))
        return chosen

    def _still_at_goal(self, body: Body, seen: Observation) -> bool:
        """Return whether the measured pose of an object that was confirmed at its goal is still at
        the goal.

        The confirmation holds until the object moves. A single noisy observation does not revoke
        it, because this would cost a tap.
        """
        confirmed = self._confirmed.get(body.name)
        if confirmed is None or body.goal is None:
            return False
        pose, nominal = seen.pose, body.planner.settings.camera
        noise = nominal if seen.covariance is None else noise_of(seen.covariance)
        same = math.sqrt(2.0) * STILL
        return (
            confirmed.distance_to(pose) <= same * noise.position
            and abs(confirmed.rotation_to(pose)) <= same * noise.angle
            and body.is_at_goal(pose)
        )

    def _scene(self, excluded: frozenset[tuple[str, Purpose]], waiting: frozenset[str]) -> Scene:
        due = [name for name in self._order if name not in self.finished]
        if due:
            waiting |= {b.name for b in self.bodies if b.goal is not None} - {due[0]}
        return Scene(self.bodies, self._settled, self.finished, excluded, self._buffers, waiting)

    def _step(
        self, move: Move, seen: Observation, observe_again: bool
    ) -> TapOf | ObserveLonger | Refusal | None:
        """Return the next step of the current move, or None if another move is needed."""
        body = self._by_name[move.name]
        free = self._maps.map(body, areas_of(self.bodies, self._settled, [body.name]))
        if self._session is None or self._session_move is not move:
            method = (
                body.planner if move.purpose is Purpose.TO_GOAL else coarse(body.planner.settings)
            )
            self._session = PositioningSession(
                move.target,
                method,
                free.space,
                free,
                self.gains[body.name],
                adapt=self._adapt,
                most_taps=self._most_taps,
            )
            for strike in self._skipped.get(body.name, ()):
                self._session.skip(strike)
        elif self._session_map is not free:
            self._session.use_free_space(free.space, free)
        self._session_move, self._session_map = move, free
        # The place of an object that is moved out of the way need not be confirmed by a longer
        # observation.
        observe_again = observe_again and move.purpose is Purpose.TO_GOAL
        decision = self._session.decide(seen.pose, seen.covariance, observe_again=observe_again)
        if isinstance(decision, Done):
            self.move = None
            return None
        if isinstance(decision, ObserveAgain):
            return ObserveLonger(body.name, decision)
        if isinstance(decision, Strike) and not self._progresses(move, seen.pose):
            self._stalled |= {(body.name, move.purpose)}
            self.move = None
            return None
        if isinstance(decision, Strike):
            return TapOf(body.name, decision, move)
        if decision.reason is RefusalReason.CAMERA_TOO_COARSE:
            return Refusal(decision.reason, f"'{body.name}': {decision.sentence}")
        self._excluded |= {(body.name, move.purpose)}
        self.move = None
        return None


@functools.lru_cache(maxsize=64)
def _at_goal(body: Body, most_taps: int) -> PositioningSession:
    """Return a session that only checks whether the object, alone, is at its goal."""
    return PositioningSession(
        np.array(body.target), body.planner, body.free.space, body.free, most_taps=most_taps
    )


@functools.lru_cache(maxsize=32)
def coarse(settings: PlannerSettings) -> Planner:
    """Return a planning method with a wide tolerance, for an object that is moved out of the
    way."""
    return ExactPlanner(
        replace(
            settings,
            tolerance_position=0.5 * BUFFER_SLACK,
            tolerance_angle=COARSE_ANGLE,
            box=None,
        )
    )
