"""Safety invariants of a cell with several objects, in addition to those of every cell."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from tapping_cell.logic.arm_in_view import may_hide
from tapping_cell.logic.clock import to_nanoseconds
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import (
    ArmState,
    ArrangeObjects,
    ErrorCode,
    ObjectProgress,
    ObjectState,
    ObjectStates,
    PlanState,
    PositionObject,
    TapCommand,
    TapperState,
)
from tapping_cell.se2 import Pose
from tapping_cell.simulation.tabletop import TrueContact
from tapping_cell.verification.host import SLOW_COMPUTING_S
from tapping_cell.verification.invariants import (
    BUMP_M,
    ENDED,
    TAPPING,
    WAIT_SLACK_S,
    InvariantChecker,
)
from tapping_cell.verification.physical_cell import Release
from tapping_cell.verification.table_cell import Outline, PhysicalTable, TableRelease, depth

MEMORY_S = 5.0
"""Time after which the planner assumes that an object that it no longer sees was removed, s."""
MEMORY_SLACK_S = 1.0
"""Allowance for the age of messages when a time is compared with ``MEMORY_S``, s."""
STALE_S = 0.1
"""Allowance for the estimated difference of two computers' clocks when the planner decides whether
an image was taken after a tap, s."""
OVERLAP_M = 0.002
"""Allowance for the errors of arm and camera when two objects, or tip and object, overlap, m."""
INFORMED_S = 0.7
"""Maximum time from when the planner's process receives where another object is until no shot is
fired for which this object is in the striker's way, s."""
CLEAR_M = 0.02
"""If the predicted way of a tapped object is farther than this from another object, m, the tap does
not move the other object."""
SHIFT_M, SHIFT_RAD = 0.001, 0.01
"""Change of an object's pose, m and rad, after which the planner may discard a decision."""
SILENT_S = 1.0
"""If the planner has not published its state for this time, s, its process was frozen."""
AXIS_POINTS = 12
"""Number of points on the axis of the tool at which an overlap is checked."""


@dataclass(slots=True)
class Sight:
    """Ground truth on one object, and what the tapper's process has received about it. Times are in
    s from the start of the run."""

    hidden_since: float = math.inf
    removed_until: float = -math.inf
    """Time until which it is, or was last, off the table."""
    moved_by_hand: tuple[float, Pose] | None = None
    seen_by_tapper: deque[tuple[float, Pose]] = field(default_factory=lambda: deque(maxlen=100))


@dataclass(slots=True)
class Told:
    """Last observation of one object that the planner's process has received. Times are in s from
    the start of the run."""

    exposed: float = -math.inf
    """Exposure of the last image in which the object was searched for."""
    seen: float = -math.inf
    """Exposure of the last image in which it was seen."""
    since: float = math.inf
    """Time at which the planner's process first received a pose that it still has, within
    ``BUMP_M``."""
    received: float = -math.inf
    """Time at which the planner's process last received that it was seen."""
    covered: float = -math.inf
    """Time at which the planner's process last received that it was not seen, while the arm may
    have hidden it. The planner may still remember it then."""
    pose: Pose | None = None
    newest: Pose | None = None
    """Pose received last; ``pose`` differs from it by less than ``BUMP_M``."""
    settled: Pose | None = None
    """Pose received at the last change by more than ``SHIFT_M`` or ``SHIFT_RAD``."""
    at_rest: bool = False
    visible: bool = False


@dataclass(frozen=True, slots=True)
class Asked:
    """Request of a goal: names and goals of its objects."""

    goals: Mapping[str, Pose]
    arrangement: bool = False


@dataclass(slots=True)
class TableInvariantChecker(InvariantChecker):
    """Checks a cell with several objects. Times are in s from the start of the run."""

    longest_view: float = 2.1  # the computation of a decision takes some time
    others: dict[str, Sight] = field(default_factory=dict)
    """All objects except the cell's own. The attributes of the base class are those of the cell's
    own object."""
    asked: dict[int, Asked] = field(default_factory=dict)
    """Requests by their index, except goals of the cell's own object."""
    told: dict[str, dict[str, Told]] = field(default_factory=dict)
    """What the planner's process has received on each topic, by the name of the object."""
    _planned_among: dict[int, dict[str, Pose]] = field(default_factory=dict)
    """For each tap, the poses of the objects that the planner's process had received last when it
    commanded the tap."""
    _planned_without: dict[int, set[str]] = field(default_factory=dict)
    """For each tap, the objects that counted as removed when the planner commanded the tap."""
    _planned_with: dict[int, tuple[Outline, ...]] = field(default_factory=dict)
    """For each tap, the objects without an object file that the planner's process knew when it
    commanded the tap."""
    _unknown: tuple[Outline, ...] = ()
    """Objects without an object file that the planner's process received last."""
    _searched: float = -math.inf
    """Exposure of the image in which they were searched for."""
    _measured: dict[str, int] = field(default_factory=dict)
    """Stamp (ns) of the last measurement of each other object that the tapper received."""
    _arrangements_begun: set[int] = field(default_factory=set)
    _tap: int = 0
    """Id of the last tap that the planner has commanded."""
    _contact_at: float = -math.inf
    """Time of the last contact of two objects."""
    _served: str = ""
    """Object of the last tap that the arm has served; empty for the cell's own object."""
    _begun_by_arm: int = 0
    """Id of the last tap that the arm has begun to serve."""
    _view_changed_at: float = -math.inf
    """Time at which the planner's process last received that something has changed on the table."""
    _deciding_since: float = math.inf
    """Time since which the planner has observed and decided, without tapping; inf while it does
    not. The time starts again when something changes on the table."""
    _reported_at: float = -math.inf
    """Time at which the planner last published its state."""

    @property
    def _table(self) -> PhysicalTable:
        assert isinstance(self.physical, PhysicalTable)
        return self.physical

    @contextmanager
    def regarding(self, name: str) -> Iterator[None]:
        """Apply the checks of the base class to this object (empty: the cell's own object)."""
        table = self._table
        if name in ("", table.own):
            yield
            return
        own = self.hidden_since, self.moved_by_hand, self.seen_by_tapper
        other = self.others[name]
        self.hidden_since, self.moved_by_hand = other.hidden_since, other.moved_by_hand
        self.seen_by_tapper = other.seen_by_tapper
        try:
            with table.regarding(name):
                yield
        finally:
            self.hidden_since, self.moved_by_hand, self.seen_by_tapper = own

    def add_objects(self, names: Sequence[str]) -> None:
        """Also check these objects."""
        self.others = {name: Sight() for name in names}

    def note_hand(self, name: str, time: float, pose: Pose) -> None:
        """Record that a hand moves an object from this pose."""
        if name in self.others:
            self.others[name].moved_by_hand = time, pose
        else:
            self.moved_by_hand = time, pose

    # What the processes receive

    def on_state_received_by_tapper(self, state: ObjectState) -> None:
        """Process the state of another object that the tapper's process received. The same
        measurement is received several times."""
        stamp = to_nanoseconds(state.header.stamp)
        if state.visible and stamp != self._measured.get(state.object_id):
            self._measured[state.object_id] = stamp
            pose = from_message(state.pose.pose)
            self.others[state.object_id].seen_by_tapper.append((self.scheduler.now, pose))

    def on_object_received_by_planner(self, topic: str, state: ObjectState) -> None:
        """Process a measurement of an object that the planner's process received on a topic."""
        told = self.told.setdefault(topic, {}).setdefault(state.object_id, Told())
        exposed = self.exposed(to_nanoseconds(state.header.stamp))
        told.exposed = max(told.exposed, exposed)
        if (told.at_rest, told.visible) != (state.at_rest, state.visible) or state.error_code:
            self._view_changed_at = self.scheduler.now
        told.at_rest, told.visible = state.at_rest, state.visible
        if not state.visible:
            if told.newest is not None and self._may_be_covered(told.newest):
                told.covered = self.scheduler.now
            return
        told.seen, told.received = max(told.seen, exposed), self.scheduler.now
        pose = told.newest = from_message(state.pose.pose)
        if told.settled is None or _is_shifted(told.settled, pose):
            told.settled, self._view_changed_at = pose, self.scheduler.now
        if told.pose is None or told.pose.distance_to(pose) > BUMP_M:
            told.pose, told.since = pose, self.scheduler.now
        if not state.error_code:
            self._check_others_of_tap(topic, state.object_id, pose)

    def on_search_received_by_planner(self, message: ObjectStates) -> None:
        """Process the outlines of the objects without an object file that the planner's process
        received. The planner must withdraw its tap if a further one was found."""
        stamp = to_nanoseconds(message.unknown_searched_at)
        self._searched = self.exposed(stamp)
        outlines = tuple(
            tuple((point.x, point.y) for point in outline.points)
            for outline in message.unknown_objects
        )
        if outlines != self._unknown:
            self._unknown, self._view_changed_at = outlines, self.scheduler.now
        known = self._planned_with.get(self._tap)
        found = known is not None and any(outline not in known for outline in self._unknown)
        if found and self._waiting[0] in TAPPING:
            self.expect_withdrawal("an unknown object was found")

    def _may_be_covered(self, pose: Pose) -> bool:
        """Return whether the arm may hide an object at a pose from the camera."""
        physical, shape = self.physical, self.physical.cell.object
        tip, height = physical.tip(self.scheduler.now)
        return may_hide(
            physical.cell,
            physical.truth.camera.position,
            (tip.x, tip.y, height, tip.theta),
            (pose.x, pose.y, shape.height),
            shape.shape.reach(),
        )

    def _sources(self) -> tuple[str, ...]:
        """Return the topics by which the planner observes the objects of its present goal: first
        that of the tapped object, then that of the other objects."""
        if self._goal is not None and self._goal in self.asked:
            return "object_states", "object_states"
        return "object_state", "other_objects"

    def _observes_by_object_state(self) -> bool:
        return self._goal is None or self._goal not in self.asked

    def _known(self, name: str, tapped: str) -> Told:
        first, second = self._sources()
        topic = first if name == tapped else second
        return self.told.get(topic, {}).get(name, Told())

    def _check_others_of_tap(self, topic: str, name: str, pose: Pose) -> None:
        """Check that the planner withdraws its tap if it receives that another object was moved, or
        put on the table, since it commanded the tap."""
        tap = self._tap
        before = self._planned_among.get(tap, {}).get(name)
        appeared = name in self._planned_without.get(tap, ())
        if topic != self._sources()[1] or self._waiting[0] not in TAPPING:
            return
        if not appeared and (before is None or before.distance_to(pose) <= BUMP_M):
            return
        change = "appeared"
        if before is not None:
            change = f"was moved by {1e3 * before.distance_to(pose):.1f} mm"
        self.expect_withdrawal(f"'{name}' {change}")

    # Commands

    def on_planner_killed(self, crash: bool) -> None:
        """Process the end of the planner's process, which can withdraw no tap any more."""
        self._tap = 0
        super(TableInvariantChecker, self).on_planner_killed(crash)

    def on_tap_received_by_arm(self, command: TapCommand) -> None:
        """Process a TAP that the arm's process has handled. Another command with the same id may
        follow, but the arm refuses it."""
        if self._arm == (ArmState.MOVING, command.tap_id) and command.tap_id != self._begun_by_arm:
            self._begun_by_arm, self._served = command.tap_id, command.object_id

    def on_publish(self, node: str, topic: str, message: object) -> None:
        """Process a message that a node publishes."""
        is_tap = isinstance(message, TapCommand) and message.request == TapCommand.TAP
        if is_tap and node == "tap_planner":
            assert isinstance(message, TapCommand)
            self._tap = message.tap_id
        super(TableInvariantChecker, self).on_publish(node, topic, message)

    def _check_basis(self, tap_id: int) -> None:
        """Check that the planner commanded this tap on the basis of sufficient observations of all
        objects, and that these observations allow the tap."""
        command = self.commands[tap_id]
        tapped = command.object_id or self._table.own
        known = {name: self._known(name, tapped) for name in self._table.table.worlds}
        arranged = self._sources()[0] == "object_states"
        if not known[tapped].visible:
            self.violate(
                "planned without a view",
                f"tap {tap_id} was commanded although the planner's last image does not show"
                f" '{tapped}'",
            )
        if not known[tapped].at_rest:
            self.violate(
                "planned while it moved",
                f"tap {tap_id} was commanded although '{tapped}' was observed in motion",
            )
        self._check_planned_pose(tap_id, known[tapped].newest)
        self._check_image(tap_id, known[tapped].seen)
        now, tip = self.scheduler.now, from_message(command.strike_pose)
        predicted = from_message(command.predicted_pose)
        reference = self._planned_among.setdefault(tap_id, {})
        since = max(self._goal_begun_at, self._last_shot())
        for name, told in known.items():
            if name == tapped:
                continue
            if told.exposed < since - STALE_S:
                self.violate(
                    "object not observed",
                    f"tap {tap_id} was commanded, but the planner has not received an image of"
                    f" '{name}' that was taken since the last tap or the beginning of the goal"
                    f" ({now - since:.2f} s ago)",
                )
            if arranged and told.visible and not told.at_rest:
                self.violate(
                    "planned while it moved",
                    f"tap {tap_id} of '{tapped}' was commanded although '{name}' was observed in"
                    " motion",
                )
            unseen = now - told.seen
            if arranged and told.seen < since - STALE_S and unseen < MEMORY_S - MEMORY_SLACK_S:
                self.violate(
                    "hidden object ignored",
                    f"tap {tap_id} was commanded although the planner has not seen '{name}' since"
                    " the last tap or the beginning of the goal, and last saw it only"
                    f" {unseen:.2f} s ago",
                )
            gone = now - max(told.received, told.covered)
            if gone > MEMORY_S + MEMORY_SLACK_S and not told.visible:
                self._planned_without.setdefault(tap_id, set()).add(name)
            if told.newest is None or unseen > MEMORY_S - MEMORY_SLACK_S:
                continue
            reference[name] = told.newest
            radius = self._table.inner_radius
            if told.newest.distance_to(tip) < radius - OVERLAP_M:
                self.violate(
                    "tip in another object",
                    f"the strike pose of tap {tap_id} is inside '{name}' as the planner had last"
                    " observed it",
                )
            if told.newest.distance_to(predicted) < 2.0 * radius - OVERLAP_M:
                self.violate(
                    "planned collision",
                    f"after tap {tap_id}, '{tapped}' would overlap '{name}' as the planner had last"
                    " observed it",
                )

        self._check_unknown(tap_id, tip, predicted)
        if self._view_is_clear() and self._searched < since - STALE_S:
            self.violate(
                "table not searched",
                f"tap {tap_id} was commanded, but the planner has not received a search for objects"
                " without an object file that was made since the last tap or the beginning of the"
                f" goal ({now - since:.2f} s ago)",
            )

    def _view_is_clear(self) -> bool:
        """Return whether the devices' states that the planner received last say that the camera's
        view is clear. Otherwise, the table is not searched."""
        arm, tapper = self._received.get(ArmState), self._received.get(TapperState)
        return (
            isinstance(arm, ArmState)
            and isinstance(tapper, TapperState)
            and arm.state == ArmState.IDLE
            and arm.clear_of_camera
            and tapper.state == TapperState.SAFE
        )

    def _check_unknown(self, tap_id: int, tip: Pose, predicted: Pose) -> None:
        """Check that neither the tool at the strike pose nor the object at its predicted pose
        overlaps an object without an object file."""
        self._planned_with[tap_id] = self._unknown
        for outline in self._unknown:
            x, y = np.mean(outline, axis=0)
            inside = max(depth(outline, part) for part in self._axis_of_tool(tip))
            inside += self.physical.cell.file.tapper.tool_radius
            if inside > OVERLAP_M:
                self.violate(
                    "tool in an unknown object",
                    f"at the strike pose of tap {tap_id}, the tool would overlap the unknown object"
                    f" at x {1e3 * x:.0f} mm, y {1e3 * y:.0f} mm, which the planner knew, by"
                    f" {1e3 * inside:.0f} mm",
                )
            inside = depth(outline, (predicted.x, predicted.y)) + self._table.inner_radius
            if inside > OVERLAP_M:
                self.violate(
                    "planned into an unknown object",
                    f"after tap {tap_id}, the object would overlap the unknown object at x"
                    f" {1e3 * x:.0f} mm, y {1e3 * y:.0f} mm, which the planner knew, by"
                    f" {1e3 * inside:.0f} mm",
                )

    def _axis_of_tool(self, tip: Pose) -> list[tuple[float, float]]:
        """Return points on the axis of the tool, which is a bar behind the tip."""
        tapper = self.physical.cell.file.tapper
        behind = np.linspace(tapper.tool_start, tapper.tool_length, AXIS_POINTS)
        x, y = tip.x - behind * math.cos(tip.theta), tip.y - behind * math.sin(tip.theta)
        return list(zip(x.tolist(), y.tolist(), strict=True))

    def tapped_goals(self) -> Mapping[str, Pose]:
        """Return the goals of the objects that the planner's present goal moves; empty if there is
        none."""
        if self._goal is None:
            return {}
        if self._goal in self.asked:
            return self.asked[self._goal].goals
        return {self._table.own: self._requests[self._goal][0]}

    # Releases

    def after_event(self) -> None:
        """Check the invariants of releases, contacts, charging and motion after an event."""
        super(TableInvariantChecker, self).after_event()
        for contact in self._table.table.take_contacts():
            self._contact_at = contact.time
            self._check_contact(contact)

    def _check_contact(self, contact: TrueContact) -> None:
        """Check that the planner could not foresee this contact of two objects."""
        release = self.physical.releases[-1] if self.physical.releases else None
        if not isinstance(release, TableRelease) or release.shot not in self.planners:
            return
        command = self._command_of(release)
        names = {contact.name, contact.other}
        if command is None or (command.object_id or self._table.own) not in names:
            return
        moved = [self.others.get(name, self).moved_by_hand for name in names]
        if any(one is not None and one[0] > release.time - self.unseen_limit for one in moved):
            return
        tapped = command.object_id or self._table.own
        (other,) = names - {tapped}
        start, end = from_message(command.object_pose), from_message(command.predicted_pose)
        apart = _distance(release.poses[other], start, end) - 2.0 * self._table.radius
        if apart > CLEAR_M and release.time > self.motor_weak_until:
            self.violate(
                "unforeseen contact",
                f"after shot {release.shot}, '{contact.name}' hit '{contact.other}', although the"
                f" predicted way of '{tapped}' was {1e3 * apart:.0f} mm away from it",
            )

    def _check_scene(self, release: Release, command: TapCommand) -> None:
        assert isinstance(release, TableRelease)
        name = command.object_id or self._table.own
        with self.regarding(name):
            super(TableInvariantChecker, self)._check_scene(
                replace(release, object_pose=release.poses[name]), command
            )
        if release.met in ("", name) or release.shot not in self.planners:
            return
        # Another object is in the striker's way. The planner must know it if it was told.
        met = self._known(release.met, name)
        if met.pose is None or met.pose.distance_to(release.poses[release.met]) > BUMP_M:
            return
        if release.time > met.since + INFORMED_S and release.time - met.seen < MEMORY_S:
            self.violate(
                "other object struck",
                f"shot {release.shot} was released for '{name}', but '{release.met}' is in the"
                f" striker's way; the planner knew it for {release.time - met.since:.2f} s",
            )

    def _check_view(self, message: ArmState) -> None:
        if self._contact_at > self._placed_tap_seen_at:
            # The object that was tapped has hit another one and is not where the arm expects it.
            self._clear = message.clear_of_camera
            return
        with self.regarding(self._served):
            super(TableInvariantChecker, self)._check_view(message)

    # Reports and goals

    def _begin_goal(self, message: PlanState) -> None:
        asked = self.asked.get(self._goal) if self._goal is not None else None
        if asked is not None:
            return  # the present object of an arrangement changes
        super(TableInvariantChecker, self)._begin_goal(message)
        assert self._goal is not None
        begun = self.asked.get(self._goal)
        if begun is not None and begun.arrangement:
            if self._goal in self._arrangements_begun:
                self.violate("arrangement resumed", "the planner began an arrangement again")
            self._arrangements_begun.add(self._goal)
        own = self._table.own
        names = (own,) if begun is None else tuple(begun.goals)
        if (message.object_id or own) not in names:
            self.violate(
                "goal of another object",
                f"the planner began a goal of '{message.object_id}', but it was sent for"
                f" {', '.join(names)}",
            )

    def _on_plan_state(self, message: PlanState) -> None:
        if message.state in ENDED and self._goal is None and self._waiting[0] in ENDED:
            # The report of a goal that has ended is repeated.
            name = ""
        else:
            name = message.object_id
        with self.regarding(name):
            super(TableInvariantChecker, self)._on_plan_state(message)
        self._check_decisions(message)

    def _check_decisions(self, message: PlanState) -> None:
        """Check that the planner of a cell in which nothing changes does not discard its decisions
        again and again, each time with a new time limit."""
        now = self.scheduler.now
        interrupted, self._reported_at = now - self._reported_at > SILENT_S, now
        if message.state not in (PlanState.LOOKING, PlanState.PLANNING):
            self._deciding_since = math.inf
            return
        if interrupted or self._deciding_since == math.inf:
            self._deciding_since = now
        self._deciding_since = max(self._deciding_since, self._view_changed_at)
        # A decision that begins shortly before the deadline may ask for a further image. The second
        # decision, after the deadline, does not.
        computing = 2 * SLOW_COMPUTING_S[1]
        limit = self.deadlines[PlanState.LOOKING] + computing + WAIT_SLACK_S
        without = now - self._deciding_since
        if without > limit:
            self.violate(
                "no decision",
                f"the planner has observed and decided for {without:.1f} s (limit {limit:g} s)"
                " without a result, although nothing has changed on the table",
            )
            self._deciding_since = now

    def check_result(
        self,
        request: int,
        result: PositionObject.Result | ArrangeObjects.Result,
        tolerance: tuple[float, float],
    ) -> None:
        """Check the result of an action goal against the ground truth. ``tolerance``: m and rad."""
        asked = self.asked.get(request)
        if isinstance(result, PositionObject.Result):
            with self.regarding("" if asked is None else next(iter(asked.goals))):
                super(TableInvariantChecker, self).check_result(request, result, tolerance)
            return
        assert asked is not None
        self._check_count("the result gives", request, result.taps)
        if len(result.records) != result.taps:
            self.violate(
                "false count",
                f"the result gives {result.taps} taps, but {len(result.records)} records",
            )
        reported = {progress.object_id: progress for progress in result.objects}
        if result.error_code == ErrorCode.NONE:
            for name, goal in asked.goals.items():
                if name not in reported or reported[name].state != ObjectProgress.REACHED:
                    self.violate(
                        "false claim", f"the arrangement ended without '{name}' at its goal"
                    )
                with self.regarding(name):
                    self._check_claim(f"the result says for '{name}'", goal, tolerance)
        commanded = self._taps.get(request, [])
        told = set(commanded) - self._forged
        for name, progress in reported.items():
            fired = sum(
                one.shot in told and (self.commands[one.shot].object_id == name)
                for one in self.physical.releases
            )
            if result.error_code == ErrorCode.NONE and progress.taps < fired:
                self.violate(
                    "false count",
                    f"the result gives {progress.taps} taps of '{name}', but {fired} were fired",
                )
            if progress.state == ObjectProgress.REACHED:
                self._check_progress(progress)

    def _check_progress(self, progress: ObjectProgress) -> None:
        """Check the measured pose of an object that is reported at its goal."""
        pose, goal = from_message(progress.pose.pose), from_message(progress.goal_pose)
        off, turned = pose.distance_to(goal), abs(pose.rotation_to(goal))
        if off > progress.position_tolerance or turned > progress.angle_tolerance:
            self.violate(
                "false progress",
                f"'{progress.object_id}' is reported at its goal, but was measured"
                f" {1e3 * off:.3f} mm and {math.degrees(turned):.3f} deg away from it",
            )


def _distance(point: Pose, start: Pose, end: Pose) -> float:
    """Return the distance of a point from the straight way between two poses, m."""
    dx, dy = end.x - start.x, end.y - start.y
    length = dx * dx + dy * dy
    along = 0.0
    if length > 0.0:
        along = ((point.x - start.x) * dx + (point.y - start.y) * dy) / length
    share = min(1.0, max(0.0, along))
    return point.distance_to(Pose(start.x + share * dx, start.y + share * dy, 0.0))


def _is_shifted(before: Pose, after: Pose) -> bool:
    return before.distance_to(after) > SHIFT_M or abs(before.rotation_to(after)) > SHIFT_RAD
