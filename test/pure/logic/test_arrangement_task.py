"""Arrangements of several objects in virtual time, with the planner's state machine and simulated
devices. This file also tests the tapper's checks of the object that is tapped."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
from logic_parts import goal_handling
from test_objects_without_a_file import square_at
from test_planner_with_played_devices import COVARIANCE, FAST, shipped
from virtual_node import VirtualNode

from lab.virtual_cell import host
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.logic.arrangement import (
    FOLLOWS,
    OPEN,
    PROGRESS_TABLE,
    ArrangementTask,
    Change,
    Progress,
)
from tapping_cell.logic.clock import Now
from tapping_cell.logic.goal_handling import GoalHandling
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.planner_states import State
from tapping_cell.logic.poses import from_message, to_message
from tapping_cell.logic.tapper_peers import PeerLimits, TapperPeers
from tapping_cell.messages import (
    ArmState,
    ArrangementState,
    ArrangeObjects,
    Bool,
    ErrorCode,
    ObjectGoal,
    ObjectProgress,
    ObjectState,
    ObjectStates,
    PlanState,
    Point,
    Polygon,
    PoseStamped,
    PositionObject,
    TapCommand,
    TapperState,
    UnknownObjects,
)
from tapping_cell.messages import Pose as PoseMessage
from tapping_cell.planning.arrangement import ArrangementSession
from tapping_cell.se2 import Pose

PATIENT = replace(FAST, observe_deadline=8.0)
"""Settings with which the planner waits longer than an object is remembered."""
PLACES = (Pose(-0.12, 0.03, 0.0), Pose(0.04, 0.05, 0.2), Pose(0.10, -0.12, 0.0))


@cache
def files() -> tuple[ObjectFile, ...]:
    """Return two more disks like the cell's own. Three of these disks fit on the table."""
    own = shipped()[0].object
    return tuple(replace(own, name=f"disk {number}") for number in (2, 3))


@cache
def handling() -> GoalHandling:
    cell, maps = shipped()
    return goal_handling(cell, "", files(), maps=maps, solve_in_background=False)


class Table(VirtualNode):
    """Simulated camera, arm and tapper of a table with three disks."""

    def __init__(self, places: tuple[Pose, ...] = PLACES, settings: PlannerSettings = FAST) -> None:
        cell = shipped()[0]
        self.names = [cell.object.name, *(file.name for file in files())]
        self.poses = dict(zip(self.names, places, strict=True))
        self.hidden: set[str] = set()
        self.unknown: list[Polygon] = []
        self.seldom: set[str] = set()
        """Objects that the camera observes only every 1.2 s."""
        self.measured: dict[str, ObjectState] = {}
        self.look_began = -math.inf
        self.withdrawals: list[int] = []
        self.tap: TapCommand | None = None
        self.taps: list[TapCommand] = []
        self.outcome = TapperState.NONE
        self.arm_state = ArmState.IDLE
        self.on_tap = lambda: None
        self.on_withdrawal = lambda: None
        self.on_clear_view: Callable[[], None] = lambda: None
        self.cleared = 0
        self.tip = PoseMessage()
        self.results: list[ArrangeObjects.Result] = []
        self.reports: list[ArrangementState] = []

        def connect(_: Any, __: float, now: Now) -> GoalHandling:
            return handling()

        super().__init__(
            "tap_planner",
            None,
            lambda _: (PlannerLogic(settings), None),
            connect,
            "plan_state",
            cell,
            started=False,
        )
        self.network.subscribe("actors", "tap_command", lambda _, m: self._on_command(m))
        self.network.subscribe("actors", "arrangement_state", lambda _, m: self.reports.append(m))
        self.scheduler.after(0.0, self._publish)
        self.process.start()
        self.wait(lambda: self.states, "the planner is up")
        self.run(0.3)

    def _on_command(self, command: TapCommand) -> None:
        if command.request == TapCommand.CLEAR_VIEW:
            self.cleared += 1
            self.on_clear_view()
        if command.request != TapCommand.TAP:
            self.arm_state = ArmState.IDLE
            self.withdrawals.append(command.tap_id)
            self.on_withdrawal()
            return
        self.taps.append(command)
        self.tap, self.outcome, self.arm_state = command, TapperState.FIRED, ArmState.IN_POSITION
        self.poses[command.object_id] = from_message(command.predicted_pose)
        self.on_tap()

    def _publish(self) -> None:
        stamp, states = self.stamp(), []
        due = self.scheduler.now >= self.look_began + 1.2
        self.look_began = self.scheduler.now if due else self.look_began
        for name in self.names:
            if name in self.seldom and not due and name in self.measured:
                states.append(self.measured[name])
                continue
            state = ObjectState(
                visible=name not in self.hidden, at_rest=True, frames_fused=40, object_id=name
            )
            state.header.stamp, state.header.frame_id = stamp, "table"
            state.pose.pose = to_message(self.poses[name])
            state.pose.covariance = COVARIANCE.reshape(-1).tolist()
            states.append(state)
            self.measured[name] = state
        message = ObjectStates(objects=states, searches_unknown_objects=True)
        unknown = UnknownObjects(outlines=self.unknown)
        message.header.stamp = unknown.header.stamp = stamp
        self.publish("unknown_objects", unknown)
        self.publish("object_states", message)
        idle = self.arm_state == ArmState.IDLE
        tap_id = self.tap.tap_id if self.tap is not None else 0
        arm = ArmState(
            state=self.arm_state,
            tap_id=0 if idle else tap_id,
            homed=True,
            clear_of_camera=idle,
            tip_pose=self.tip,
        )
        arm.header.stamp = stamp
        self.publish("arm_state", arm)
        self.publish(
            "tapper_state",
            TapperState(
                state=TapperState.SAFE,
                tap_id=tap_id,
                outcome=self.outcome,
                interlock_closed=True,
            ),
        )
        self.scheduler.after(0.03, self._publish)

    def send(self, goals: dict[str, Pose], **rest: Any) -> None:
        asked = ArrangeObjects.Goal(
            goals=[goal_of(name, pose) for name, pose in goals.items()], **rest
        )
        self.process.request("arrange_objects", asked, 1, self.results.append)

    def end(self) -> ArrangeObjects.Result:
        self.wait(lambda: self.results, "the end of the arrangement", 200.0)
        self.run(0.1)
        return self.results[0]


def goal_of(name: str, pose: Pose) -> ObjectGoal:
    message = PoseStamped(pose=to_message(pose))
    message.header.frame_id = "table"
    return ObjectGoal(object_id=name, goal_pose=message)


@pytest.fixture
def cell() -> Table:
    return Table()


def moved(pose: Pose, dx: float, dy: float, turn: float = 0.0) -> Pose:
    return Pose(pose.x + dx, pose.y + dy, pose.theta + turn)


def test_every_object_is_brought_to_its_goal_and_reported(cell: Table) -> None:
    goals = {
        name: moved(cell.poses[name], *step)
        for name, step in zip(
            cell.names, ((0.01, -0.02, 0.1), (0.02, 0.0), (-0.02, 0.01)), strict=True
        )
    }
    cell.send(goals)
    result = cell.end()
    assert result.error_code == ErrorCode.NONE, result.error_msg
    assert [one.object_id for one in result.objects] == list(goals)
    for one in result.objects:
        assert one.state == ObjectProgress.REACHED and one.has_goal
        assert from_message(one.goal_pose).distance_to(goals[one.object_id]) < 1e-9
        assert one.residual_distance < 0.001
        assert cell.poses[one.object_id].distance_to(goals[one.object_id]) < 0.001
    # Each tap names its object and is counted once.
    assert {tap.object_id for tap in cell.taps} == set(goals)
    assert len(cell.taps) == result.taps == len(result.records)
    assert sum(one.taps for one in result.objects) == result.taps
    assert [record.object_id for record in result.records] == [t.object_id for t in cell.taps]
    assert not cell.reports[-1].active and cell.reports[-1].taps == result.taps
    assert any(report.active for report in cell.reports)
    # plan_state names the object that is being tapped.
    placing = {state.object_id for state in cell.states if state.state == PlanState.PLACING}
    assert placing == set(goals)


def test_a_goal_may_be_for_any_object_of_the_cell(cell: Table) -> None:
    name, goal = cell.names[2], Pose(0.0, -0.13, 0.0)
    before = dict(cell.poses)
    results: list[PositionObject.Result] = []
    asked = PositionObject.Goal(object_id=name, goal_pose=goal_of(name, goal).goal_pose)
    cell.process.request("position_object", asked, 2, results.append)
    cell.wait(lambda: results, "the end of the goal", 60.0)
    assert results[0].error_code == ErrorCode.NONE
    assert from_message(results[0].final_pose.pose.pose).distance_to(goal) < 0.001
    assert {tap.object_id for tap in cell.taps} == {name}
    assert all(cell.poses[other] == before[other] for other in cell.names[:2])


def test_a_goal_of_another_object_is_resumed_for_that_object(cell: Table) -> None:
    name = cell.names[1]
    goal = goal_of(name, Pose(-0.05, -0.12, 0.0)).goal_pose
    cell.process.request(
        "position_object", PositionObject.Goal(object_id=name, goal_pose=goal), 2, lambda _: None
    )
    cell.wait(lambda: cell.taps, "the first tap")
    assert cell.process.disk.goal is not None and cell.process.disk.goal["object_id"] == name
    cell.process.kill()
    cell.process.start()
    cell.wait(lambda: cell.last.state == PlanState.REACHED, "the end of the resumed goal", 60.0)
    assert {tap.object_id for tap in cell.taps} == {name}


def test_two_objects_swap_places(cell: Table) -> None:
    one, other = cell.names[:2]
    goals = {one: cell.poses[other], other: cell.poses[one]}
    cell.send(goals)
    result = cell.end()
    assert result.error_code == ErrorCode.NONE, result.error_msg
    assert all(cell.poses[name].distance_to(goal) < 0.001 for name, goal in goals.items())
    states = {one.state for report in cell.reports for one in report.objects}
    assert ObjectProgress.MAKING_WAY in states and ObjectProgress.WAITING in states


def test_the_order_of_the_list_is_kept_if_requested(cell: Table) -> None:
    names = cell.names[::-1]
    cell.send({name: moved(cell.poses[name], 0.015, 0.0) for name in names}, in_order=True)
    assert cell.end().error_code == ErrorCode.NONE
    tapped = list(dict.fromkeys(tap.object_id for tap in cell.taps))
    assert tapped == names


@pytest.mark.parametrize(
    "code",
    ["unknown", "twice", "may move", "none", "overlap", "off table", "not a number"],
)
def test_an_invalid_layout_is_refused_before_the_first_tap(cell: Table, code: str) -> None:
    one, other = cell.names[:2]
    near = Pose(0.0, 0.0, 0.0)
    goals = [goal_of(one, near), goal_of(other, Pose(0.13, 0.0, 0.0))]
    may_move: list[str] = []
    if code == "unknown":
        goals[1].object_id = "teapot"
    elif code == "twice":
        goals[1].object_id = one
    elif code == "may move":
        may_move = ["teapot"]
    elif code == "none":
        goals = []
    elif code == "overlap":
        goals[1] = goal_of(other, Pose(0.06, 0.0, 0.0))
    elif code == "not a number":
        goals[1] = goal_of(other, Pose(math.nan, 0.0, 0.0))
    else:
        goals[1] = goal_of(other, Pose(0.5, 0.0, 0.0))
    asked = ArrangeObjects.Goal(goals=goals, may_move=may_move)
    cell.process.request("arrange_objects", asked, 1, cell.results.append)
    result = cell.end()
    expected = {
        "unknown": ErrorCode.GOAL_UNKNOWN_OBJECT,
        "twice": ErrorCode.GOAL_UNKNOWN_OBJECT,
        "may move": ErrorCode.GOAL_UNKNOWN_OBJECT,
        "none": ErrorCode.COMMAND_INVALID,
        "overlap": ErrorCode.GOALS_OVERLAP,
        "off table": ErrorCode.GOAL_OFF_TABLE,
        "not a number": ErrorCode.GOAL_NOT_FINITE,
    }[code]
    assert result.error_code == expected, result.error_msg
    assert not cell.taps
    if code in ("overlap", "off table", "not a number"):
        assert f"'{other}'" in result.error_msg


def test_a_touched_object_is_observed_and_replanned(cell: Table) -> None:
    one, other = cell.names[:2]
    goals = {name: moved(cell.poses[name], 0.02, 0.0) for name in (one, other)}

    def touch() -> None:
        cell.on_tap = lambda: None
        struck = cell.taps[-1].object_id
        pushed = other if struck == one else one
        cell.poses[pushed] = moved(cell.poses[pushed], 0.0, -0.015)

    cell.on_tap = touch
    cell.send(goals)
    result = cell.end()
    assert result.error_code == ErrorCode.NONE, result.error_msg
    assert all(cell.poses[name].distance_to(goal) < 0.001 for name, goal in goals.items())


def test_an_object_turned_away_from_its_goal_is_not_reported_at_its_goal(cell: Table) -> None:
    """A person turns it while the other object is on its way; then the arrangement is stopped."""
    one, other = cell.names[:2]
    goals = {one: cell.poses[one], other: moved(cell.poses[other], 0.06, 0.0)}

    def turn() -> None:
        cell.on_tap = lambda: cell.publish("emergency_stop", Bool(data=True))
        cell.poses[one] = moved(cell.poses[one], 0.0, 0.0, 0.2)
        cell.poses[other] = PLACES[1]

    cell.on_tap = turn
    cell.send(goals, in_order=True)
    result = cell.end()
    assert [tap.object_id for tap in cell.taps] == [other, other]
    assert ObjectProgress.REACHED in {
        report.objects[0].state for report in cell.reports if report.objects
    }
    assert result.error_code == ErrorCode.EMERGENCY_STOP
    assert {progress.state for progress in result.objects} == {ObjectProgress.FAILED}


def test_an_object_turned_away_is_noticed_even_if_no_decision_follows(cell, monkeypatch):
    """A person turns an object away from its goal, and the next decision fails."""
    one, other = cell.names[:2]

    def fail() -> None:
        raise RuntimeError("the decision failed")

    def turn() -> None:
        cell.poses[one] = moved(cell.poses[one], 0.0, 0.0, 0.2)
        monkeypatch.setattr(ArrangementTask, "computation", lambda _, frames: fail)

    cell.on_tap = turn
    cell.send({one: cell.poses[one], other: moved(cell.poses[other], 0.06, 0.0)}, in_order=True)
    result = cell.end()
    assert [tap.object_id for tap in cell.taps] == [other]
    assert ObjectProgress.REACHED in {
        report.objects[0].state for report in cell.reports if report.objects
    }
    assert result.error_code == ErrorCode.INTERNAL
    assert {progress.state for progress in result.objects} == {ObjectProgress.FAILED}


def test_a_tap_is_learnt_although_an_unknown_object_appears(cell: Table) -> None:
    name = cell.names[0]
    learnt = []

    def appear() -> None:
        cell.unknown = [square_at(-0.15, -0.15)]
        task = cell.process.logic._task
        learnt.append((task.arrangement, task.arrangement.gains[name]))

    cell.on_tap = appear
    cell.send({name: moved(cell.poses[name], 0.06, 0.0)})
    assert cell.end().error_code == ErrorCode.NONE
    arrangement, before = learnt[0]
    after = arrangement.gains[name]
    learnt_now = after.taken + after.outliers - before.taken - before.outliers
    assert learnt_now == len(cell.taps) >= 1


def test_a_restarted_planner_reports_that_no_arrangement_is_active(cell: Table) -> None:
    cell.send({name: moved(cell.poses[name], 0.06, 0.0) for name in cell.names[:1]})
    cell.wait(lambda: cell.reports[-1].active, "the arrangement")
    cell.process.kill()
    cell.process.start()
    cell.wait(lambda: not cell.reports[-1].active, "the restarted planner")


@pytest.mark.parametrize("code", [ErrorCode.IMAGE_INVALID, ErrorCode.STAMP_INVALID])
def test_a_problem_of_the_image_is_named(cell: Table, code: int) -> None:
    """camera_pose reports it only for the cell's own object."""
    publish = cell.network.publish

    def refuse(sender: str, topic: str, message: Any) -> None:
        if topic == "object_states":
            own = ObjectState(
                object_id=cell.names[0], error_code=code, error_msg="the image is dark"
            )
            own.header.stamp = message.header.stamp
            message.objects[0] = own
        publish(sender, topic, message)

    cell.network.publish = refuse  # type: ignore[method-assign]
    cell.send({cell.names[1]: moved(cell.poses[cell.names[1]], 0.03, 0.0)})
    result = cell.end()
    assert (result.error_code, result.error_msg) == (code, "the image is dark")


def test_no_tap_is_commanded_if_an_object_was_moved_during_the_decision(cell, monkeypatch):
    monkeypatch.setattr(host, "COMPUTING_S", (0.5, 0.5))
    one, other = cell.names[:2]
    cell.send({one: moved(cell.poses[one], 0.02, 0.0)})
    cell.wait(lambda: cell.process.logic.state is State.PLANNING, "the first decision")
    for name in (one, other):
        cell.poses[name] = moved(cell.poses[name], 0.0, 0.01)
    before = cell.poses[one]
    assert cell.end().error_code == ErrorCode.NONE
    assert from_message(cell.taps[0].object_pose).distance_to(before) < 1e-9


def test_the_result_of_a_failed_goal_has_the_pose_of_its_own_object(cell: Table) -> None:
    name, goal = cell.names[1], moved(cell.poses[cell.names[1]], 0.06, 0.0)
    results: list[PositionObject.Result] = []
    asked = PositionObject.Goal(object_id=name, goal_pose=goal_of(name, goal).goal_pose, max_taps=1)
    cell.process.request("position_object", asked, 2, results.append)
    cell.wait(lambda: results, "the result", 60.0)
    (result,) = results
    assert result.error_code == ErrorCode.TAP_LIMIT_REACHED
    final = from_message(result.final_pose.pose.pose)
    assert final.distance_to(cell.poses[name]) < 0.001
    assert result.residual_distance == pytest.approx(final.distance_to(goal))


def test_any_object_can_be_probed() -> None:
    handling.cache_clear()  # the taps of other tests have taught it the friction
    cell = Table()
    name = cell.names[1]
    goal = goal_of(name, moved(cell.poses[name], 0.05, 0.0)).goal_pose
    results: list[PositionObject.Result] = []
    asked = PositionObject.Goal(object_id=name, goal_pose=goal, probe=True)
    cell.process.request("position_object", asked, 2, results.append)
    cell.wait(lambda: results, "the result", 60.0)
    assert results[0].error_code == ErrorCode.NONE
    first = results[0].records[0]
    assert first.object_id == name and "probe" in first.reason, first.reason


def test_a_goal_of_one_object_is_no_arrangement(cell: Table) -> None:
    name = cell.names[1]
    goal = goal_of(name, moved(cell.poses[name], 0.02, 0.0)).goal_pose
    results: list[PositionObject.Result] = []
    asked = PositionObject.Goal(object_id=name, goal_pose=goal)
    cell.process.request("position_object", asked, 2, results.append)
    cell.wait(lambda: results, "the result", 60.0)
    assert results[0].error_code == ErrorCode.NONE
    assert not any(report.active for report in cell.reports)


def test_an_object_that_leaves_its_goal_during_the_decision_is_tapped(cell, monkeypatch):
    """The object is moved by less than the distance beyond which an object counts as moved."""
    monkeypatch.setattr(host, "COMPUTING_S", (0.5, 0.5))
    one = cell.names[0]
    goal = cell.poses[one]
    cell.send({one: goal})
    cell.wait(lambda: cell.process.logic.state is State.PLANNING, "the decision")
    cell.poses[one] = moved(goal, 0.0018, 0.0)
    assert cell.end().error_code == ErrorCode.NONE
    assert cell.poses[one].distance_to(goal) < 0.001 and cell.taps


def test_no_tap_is_commanded_if_an_unknown_object_appears_during_the_decision(cell, monkeypatch):
    monkeypatch.setattr(host, "COMPUTING_S", (0.5, 0.5))
    one = cell.names[0]
    cell.send({one: moved(cell.poses[one], 0.02, 0.0)})
    cell.wait(lambda: cell.process.logic.state is State.PLANNING, "the first decision")
    cell.unknown = [square_at(*moved(cell.poses[one], 0.0, 0.09)[:2])]
    cell.wait(lambda: cell.process.logic.state is not State.PLANNING, "the end of the decision")
    assert cell.process.logic.state is State.LOOKING and cell.taps == []
    assert cell.end().error_code == ErrorCode.NONE


def test_an_object_moved_by_hand_before_the_tap_cancels_the_tap(cell: Table) -> None:
    one, other = cell.names[:2]
    cell.send({one: moved(cell.poses[one], 0.02, 0.0)})
    cell.wait(lambda: cell.states[-1].state == PlanState.LOOKING, "it looks")
    # From now on, commands are only recorded; the simulated arm and tapper do not react to them.
    cell._on_command = lambda command: cell.taps.append(command)  # type: ignore[method-assign]
    cell.wait(lambda: cell.taps, "a tap is commanded")
    cell.poses[other] = moved(cell.poses[other], 0.01, 0.0)
    cell.wait(lambda: cell.states[-1].state == PlanState.SETTLING, "it gives the tap up", 1.0)
    withdrawn: list[int] = []

    def commanded() -> list[int]:
        withdrawn[:] = [tap.tap_id for tap in cell.taps if tap.request == TapCommand.WITHDRAW]
        return withdrawn

    cell.wait(commanded, "the arm is sent away")
    assert withdrawn == [cell.taps[0].tap_id]


def test_a_hidden_object_is_waited_for_and_finally_named(cell: Table) -> None:
    one, other = cell.names[:2]
    cell.hidden = {other}
    cell.send({name: moved(cell.poses[name], 0.02, 0.0) for name in (one, other)})
    result = cell.end()
    assert result.error_code == ErrorCode.OBJECT_NOT_SEEN and not cell.taps
    assert f"'{other}' is not seen" in result.error_msg


def test_a_rarely_observed_object_is_not_reported_as_hidden(cell: Table) -> None:
    one, other, third = cell.names
    cell.seldom = {third}
    cell.send({name: moved(cell.poses[name], 0.02, 0.0) for name in (one, other)})
    assert cell.end().error_code == ErrorCode.NONE
    between = [tap.tap_id for tap in cell.taps[:-1]]
    assert between and all(cell.withdrawals.count(tap_id) == 1 for tap_id in between)


def test_the_arm_withdraws_further_from_any_object_that_it_hides(cell: Table) -> None:
    one, other, _ = cell.names

    def withdrawn() -> None:
        # After the first withdrawal of each tap, the arm still hides the other object.
        once = cell.withdrawals.count(cell.withdrawals[-1]) == 1
        cell.hidden = {other} if once else set()

    cell.on_withdrawal = withdrawn
    cell.send({one: moved(cell.poses[one], 0.05, 0.0)})
    assert cell.end().error_code == ErrorCode.NONE
    assert all(cell.withdrawals.count(tap.tap_id) == 2 for tap in cell.taps)


def test_a_missing_object_without_a_goal_is_ignored(cell: Table) -> None:
    one, _, third = cell.names
    cell.hidden = {third}
    cell.run(handling().objects.memory + 1.0)
    cell.send({one: moved(cell.poses[one], 0.02, 0.0)})
    assert cell.end().error_code == ErrorCode.NONE


def over(cell: Table, pose: Pose) -> None:
    """Let the camera's lens be above the table, and place the arm's tip over a pose."""
    lens = PoseMessage(position=Point(x=0.0, y=0.0, z=0.7))
    cell.publish("camera/pose", PoseStamped(pose=lens))
    cell.tip = to_message(pose, 0.05)


def test_an_object_under_the_arm_does_not_count_as_removed(cell: Table) -> None:
    """The arm moves aside first, and the object is then in the way of the tap."""
    one, _, third = cell.names
    over(cell, cell.poses[third])
    cell.run(0.3)
    cell.hidden = {third}
    cell.run(handling().objects.memory + 3.0)
    cell.on_clear_view = lambda: over(cell, Pose(-0.2, 0.15, 0.0))
    cell.send({one: moved(cell.poses[one], 0.02, 0.0)})
    cell.run(FAST.observe_deadline)
    assert not cell.taps
    cell.wait(lambda: cell.cleared, "the arm is asked to move aside")
    cell.hidden = set()
    assert cell.end().error_code == ErrorCode.NONE


def test_an_object_that_a_hand_hides_is_awaited_before_the_first_tap() -> None:
    cell = Table(settings=PATIENT)
    one, _, third = cell.names
    cell.hidden = {third}
    cell.run(0.3)
    cell.send({one: moved(cell.poses[one], 0.02, 0.0)})
    cell.run(handling().objects.memory - 0.8)
    assert not cell.taps and cell.states[-1].state == PlanState.LOOKING
    cell.hidden = set()
    assert cell.end().error_code == ErrorCode.NONE


def test_without_a_memory_a_hidden_object_is_not_awaited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handling().objects, "memory", 0.0)
    cell = Table(settings=PATIENT)
    one, _, third = cell.names
    cell.hidden = {third}
    cell.run(0.3)
    cell.send({one: moved(cell.poses[one], 0.02, 0.0)})
    cell.run(1.0)
    assert cell.taps


def test_a_planner_that_has_never_seen_an_object_also_awaits_it() -> None:
    cell = Table(settings=PATIENT)
    one, _, third = cell.names
    cell.hidden = {third}
    cell.run(0.1)
    cell.process.kill()
    cell.process.start()
    cell.run(0.5)
    cell.send({one: moved(cell.poses[one], 0.02, 0.0)})
    cell.run(handling().objects.memory - 1.0)
    assert not cell.taps and cell.states[-1].state == PlanState.LOOKING
    assert cell.end().error_code == ErrorCode.NONE


def test_an_object_that_is_taken_away_and_put_back_is_left_out_meanwhile() -> None:
    cell = Table(settings=PATIENT)
    one, other, third = cell.names
    goals = {one: moved(cell.poses[one], 0.05, 0.0), other: moved(cell.poses[other], 0.0, 0.04)}

    def take_away() -> None:
        cell.hidden, cell.on_tap = {third}, put_back

    def put_back() -> None:
        cell.hidden = set()

    # The first tap moves its object by less than planned, so further taps follow.
    answer = cell._on_command

    def fall_short(command: TapCommand) -> None:
        if command.request == TapCommand.TAP and len(cell.taps) < 3:
            planned = from_message(command.object_pose), from_message(command.predicted_pose)
            half = [0.5 * (before + after) for before, after in zip(*planned, strict=True)]
            command.predicted_pose = to_message(Pose(*half))
        answer(command)

    cell._on_command = fall_short  # type: ignore[method-assign]
    cell.on_tap = take_away
    cell.send(goals)
    result = cell.end()
    assert result.error_code == ErrorCode.NONE, result.error_msg
    assert all(cell.poses[name].distance_to(goal) < 0.001 for name, goal in goals.items())
    assert sum(progress.taps for progress in result.objects) == result.taps == len(cell.taps)


def test_an_object_at_its_goal_is_reported_even_if_a_new_object_blocks_the_other_goal() -> None:
    cell = Table(settings=PATIENT)
    one, other, third = cell.names
    cell.hidden = {third}
    cell.run(handling().objects.memory + 1.0)
    goals = {one: moved(cell.poses[one], 0.02, 0.0), other: moved(cell.poses[other], 0.04, 0.0)}

    def block() -> None:
        if cell.taps[-1].object_id == other:
            cell.hidden, cell.poses[third] = set(), goals[other]
            cell.poses[other] = PLACES[1]

    cell.on_tap = block
    cell.send(goals, in_order=True)
    result = cell.end()
    assert result.error_code == ErrorCode.GOALS_OVERLAP, result.error_msg
    assert [progress.state for progress in result.objects] == [
        ObjectProgress.REACHED,
        ObjectProgress.FAILED,
    ]


def test_an_object_that_is_put_on_the_table_cancels_the_tap_and_is_avoided(cell: Table) -> None:
    one, _, third = cell.names
    cell.hidden = {third}
    cell.run(handling().objects.memory + 1.0)
    goal = moved(cell.poses[one], 0.05, 0.0)
    cell.send({one: goal})
    cell.wait(lambda: cell.states[-1].state == PlanState.LOOKING, "it looks")
    answer, commanded = cell._on_command, list[TapCommand]()
    cell._on_command = commanded.append  # type: ignore[method-assign]
    cell.wait(lambda: commanded, "a tap is commanded")
    cell.hidden = set()
    cell.wait(lambda: cell.states[-1].state == PlanState.SETTLING, "it gives the tap up", 1.0)
    cell._on_command = answer  # type: ignore[method-assign]
    assert cell.end().error_code == ErrorCode.NONE
    assert cell.poses[one].distance_to(goal) < 0.001


def test_a_cancelled_arrangement_ends_its_tap(cell: Table) -> None:
    one = cell.names[0]
    cell.on_tap = lambda: setattr(cell, "outcome", TapperState.NONE)
    cell.send({one: moved(cell.poses[one], 0.02, 0.0)})
    cell.wait(lambda: cell.taps, "a tap is commanded")
    cell.process.request("cancel", None, 1, lambda _: None, waits=False)
    result = cell.end()
    assert result.error_code == ErrorCode.GOAL_CANCELED
    assert cell.states[-1].state == PlanState.CANCELED and cell.arm_state == ArmState.IDLE


def test_a_failed_computation_ends_the_arrangement_with_an_error_code(cell, monkeypatch):
    def broken(*_: Any, **__: Any) -> None:
        raise ArithmeticError("no number")

    monkeypatch.setattr(ArrangementSession, "decide", broken)
    cell.send({cell.names[0]: Pose(0.0, -0.1, 0.0)})
    assert cell.end().error_code == ErrorCode.INTERNAL
    assert not cell.taps


def test_an_emergency_stop_and_the_time_limit_end_an_arrangement() -> None:
    for code in (ErrorCode.EMERGENCY_STOP, ErrorCode.DEADLINE_EXCEEDED):
        cell = Table()

        def wait_for_tapper(cell: Table = cell) -> None:
            cell.outcome, cell.poses[cell.names[0]] = TapperState.NONE, PLACES[0]

        cell.on_tap = wait_for_tapper
        limit = 0.5 if code == ErrorCode.DEADLINE_EXCEEDED else 0.0
        one = cell.names[0]
        cell.send({one: moved(cell.poses[one], 0.02, 0.0)}, time_limit=limit)
        if code == ErrorCode.EMERGENCY_STOP:
            cell.wait(lambda cell=cell: cell.taps, "a tap is commanded")  # type: ignore[misc]
            cell.publish("emergency_stop", Bool(data=True))
        result = cell.end()
        assert result.error_code == code
        assert result.objects[0].state == ObjectProgress.FAILED
        assert result.objects[0].error_code == code


def test_every_transition_of_an_open_object_leads_to_its_stated_state() -> None:
    for progress in Progress:
        for change in Change:
            allowed = PROGRESS_TABLE.get((progress, change), frozenset())
            assert allowed <= {FOLLOWS[change]}
            if progress is Progress.FAILED:
                assert not allowed
            elif progress in OPEN and change is not Change.GIVEN_UP:
                assert allowed


# The tapper checks the object that is tapped.


def states_of(**poses: Pose) -> ObjectStates:
    message = ObjectStates()
    message.header.stamp.sec = 10
    for name, pose in poses.items():
        state = ObjectState(object_id=name, visible=True)
        state.header.stamp.sec = 10
        state.pose.pose = to_message(pose)
        message.objects.append(state)
    return message


def test_the_last_check_uses_the_tapped_object() -> None:
    now = Now(10.0, 10_000_000_000)
    here, there, away = Pose(0.0, 0.0, 0.0), Pose(0.1, 0.0, 0.0), Pose(0.15, 0.0, 0.0)
    peers = TapperPeers(PeerLimits())
    own = states_of(own=here)
    peers.on_object_states(own, now)

    def reason(name: str, planned: Pose) -> int:
        peers.begin_tap(name, 0.0)
        found = peers._disturbance(planned, now)
        return found[0] if found is not None else ErrorCode.NONE

    # An object that was never seen is not tapped, even if the cell's own object is at the planned
    # pose.
    assert reason("other", there) == ErrorCode.OBJECT_NOT_SEEN
    assert reason("other", here) == ErrorCode.OBJECT_NOT_SEEN
    peers.on_object_states(states_of(own=here, other=there), now)
    assert reason("other", there) == ErrorCode.NONE
    assert reason("other", here) == ErrorCode.OBJECT_MOVED
    assert reason("own", here) == reason("", here) == ErrorCode.NONE
    assert reason("own", there) == ErrorCode.OBJECT_MOVED
    # The age of an object's state is computed from its own stamp, and an older state does not
    # replace a newer one.
    late = states_of(other=away)
    late.objects[0].header.stamp.sec = 9
    peers.on_object_states(late, now)
    assert reason("other", there) == ErrorCode.NONE
    later = Now(10.0 + PeerLimits().unseen + 0.1, 10_600_000_000)
    peers.on_object_states(own, later)
    peers.begin_tap("other", 0.0)
    assert peers._disturbance(there, later)[0] == ErrorCode.OBJECT_NOT_SEEN  # type: ignore[index]
    assert math.isfinite(later.steady)


def test_the_reported_residual_is_that_of_the_present_object(cell: Table) -> None:
    """Another object, of which an observation is missing, is watched meanwhile."""
    name = cell.names[0]
    goal = moved(cell.poses[name], 0.1, 0.0)
    cell.send({name: goal})
    cell.hidden.add(cell.names[1])
    cell.run(1.5)
    looking = [one for one in cell.states if one.state == PlanState.LOOKING]
    assert len(looking) > 1
    assert {one.object_id for one in looking} == {name}
    assert {round(one.residual_distance, 6) for one in looking} == {0.1}
