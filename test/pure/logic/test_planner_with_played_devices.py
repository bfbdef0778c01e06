"""The state machine of the planner in virtual time, with simulated devices that fail: every wait
ends with an error message, and nothing is fired twice."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logic_parts import alone, goal_handling
from virtual_node import VirtualNode

from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.goal_handling import GoalHandling
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.poses import from_message, to_message
from tapping_cell.logic.table_maps import TableMaps
from tapping_cell.logic.task import Task
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    GoalReport,
    ObjectState,
    PlanState,
    PoseStamped,
    PositionObject,
    TapCommand,
    TapperState,
    Time,
)
from tapping_cell.se2 import Pose

START = Pose(-0.05, 0.02, 0.2)
GOAL = Pose(-0.03, 0.02, 0.25)
FAST = PlannerSettings(
    ready_deadline=2.0,
    observe_deadline=1.5,
    place_deadline=1.5,
    fire_deadline=1.0,
    withdraw_deadline=1.5,
    silence_limit=0.5,
)

COVARIANCE = np.zeros((6, 6))
COVARIANCE[0, 0] = COVARIANCE[1, 1] = 1e-10
COVARIANCE[5, 5] = 1e-8


@cache
def shipped() -> tuple[Cell, TableMaps]:
    cell = load_cell()
    return cell, TableMaps(cell)


class Actors(VirtualNode):
    """Simulated camera, arm and tapper. Each device behaves normally unless a test changes its
    behaviour."""

    def __init__(self, settings: PlannerSettings = FAST, cell: Cell | None = None) -> None:
        self.pose = START
        self.moves_when_fired = True
        self.tip = Pose(0.0, 0.0, 0.0)
        self.object_id = "aluminium disk"
        self.visible = self.at_rest = True
        self.rest_since = Time()
        self.covariance: list[float] = COVARIANCE.reshape(-1).tolist()
        self.searches = False
        self.camera_active = self.arm_active = self.tapper_active = True
        self.arm_arrives = self.arm_withdraws = True
        self.lost_withdrawals = 0
        self.arm_state = ArmState.IDLE
        self.arm_error: tuple[int, str] = (0, "")
        self.taps_out_of_reach = 0
        self.tapper_answers: int | None = TapperState.FIRED
        self.tapper_state = TapperState.SAFE
        self.last_stops = {"arm": Time(), "tapper": Time()}
        self.tapper_error: tuple[int, str] = (0, "")
        self.commands: list[TapCommand] = []
        self.tap: TapCommand | None = None
        self.outcome = TapperState.NONE
        cell, maps = (cell, TableMaps(cell)) if cell is not None else shipped()

        def connect(_: Any, __: float, now: Now) -> GoalHandling:
            limit = settings.goal_time_limit
            return goal_handling(
                cell, "", now=now, time_limit=limit, maps=maps, solve_in_background=False
            )

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
        self.scheduler.after(0.0, self._publish)
        self.process.start()

    def _on_command(self, command: TapCommand) -> None:
        self.commands.append(command)
        if command.request == TapCommand.TAP:
            self.tap, self.outcome = command, TapperState.NONE
            if self.taps_out_of_reach:
                self.taps_out_of_reach -= 1
                self.arm_state = ArmState.WITHDRAWING
                self.arm_error = ErrorCode.ARM_OUT_OF_REACH, "joint elbow would need 170 deg"
                return
            self.arm_error = (0, "")
            self.arm_state = ArmState.IN_POSITION if self.arm_arrives else ArmState.MOVING
            if self.arm_arrives and self.tapper_answers is not None:
                self.outcome = self.tapper_answers
                fired = self.tapper_answers != TapperState.NOT_FIRED
                if fired and self.moves_when_fired:
                    self.pose = from_message(command.predicted_pose)
        elif command.request == TapCommand.WITHDRAW and self.lost_withdrawals:
            self.lost_withdrawals -= 1
        elif command.request == TapCommand.WITHDRAW and self.arm_withdraws:
            self.arm_state = ArmState.IDLE

    def _publish(self) -> None:
        now = self.stamp()
        tap_id = self.tap.tap_id if self.tap is not None else 0
        if self.camera_active:
            seen = ObjectState(
                visible=self.visible,
                at_rest=self.at_rest,
                at_rest_since=self.rest_since,
                frames_fused=30,
                object_id=self.object_id,
            )
            seen.header.stamp, seen.header.frame_id = now, "table"
            seen.pose.pose = to_message(self.pose)
            seen.references_used = list(range(101, 109))
            seen.pose.covariance = self.covariance
            states = alone(seen)
            states.searches_unknown_objects = self.searches
            self.publish("object_states", states)
        if self.arm_active:
            code, sentence = self.arm_error
            idle = self.arm_state == ArmState.IDLE
            arm = ArmState(
                state=self.arm_state,
                tap_id=0 if idle else tap_id,
                homed=True,
                clear_of_camera=idle,
                tip_pose=to_message(self.tip),
                last_stop=self.last_stops["arm"],
                error_code=code,
                error_msg=sentence,
            )
            arm.header.stamp = now
            self.publish("arm_state", arm)
        if self.tapper_active:
            code, sentence = self.tapper_error
            self.publish(
                "tapper_state",
                TapperState(
                    state=self.tapper_state,
                    tap_id=tap_id,
                    outcome=self.outcome,
                    interlock_closed=True,
                    last_stop=self.last_stops["tapper"],
                    error_code=code,
                    error_msg=sentence,
                ),
            )
        self.scheduler.after(0.03, self._publish)

    @property
    def plans(self) -> list[PlanState]:
        return self.states

    def send(self, goal: Pose = GOAL) -> None:
        self.wait(lambda: self.states, "the planner is up")
        self.run(0.3)
        message = PoseStamped(pose=to_message(goal))
        message.header.frame_id = "table"
        self.publish("goal_pose", message)

    def request_goal(self, goal: Pose = GOAL, **rest: Any) -> list[PositionObject.Result]:
        """Request a goal as an action; its result is added to the returned list."""
        self.wait(lambda: self.states, "the planner is up")
        self.run(0.3)
        message = PoseStamped(pose=to_message(goal))
        message.header.frame_id = "table"
        results: list[PositionObject.Result] = []
        request = PositionObject.Goal(goal_pose=message, **rest)
        self.process.request("position_object", request, 1, results.append)
        return results

    def until(self, state: int) -> None:
        """Wait until the planner is in this state."""
        self.wait(lambda: self.plans[-1].state == state, f"plan state {state}")

    def end(self, patience: float = 60.0) -> PlanState:
        final = (PlanState.REACHED, PlanState.FAILED)
        self.wait(lambda: self.plans[-1].state in final, "the goal's end", patience)
        end = self.plans[-1]
        self.run(0.1)  # also receive the messages that are sent together with this state
        return end

    def taps(self) -> list[TapCommand]:
        return [command for command in self.commands if command.request == TapCommand.TAP]


@pytest.fixture
def actors() -> Actors:
    return Actors()


def test_the_goal_is_reached_with_working_devices(actors: Actors) -> None:
    actors.send()
    end = actors.end()
    assert end.state == PlanState.REACHED, end.error_msg
    assert end.taps == len(actors.taps()) >= 1
    # Each tap ends with a withdrawal. After the last tap, a second withdrawal parks the arm. The
    # ids increase.
    ids = [command.tap_id for command in actors.taps()]
    assert ids == sorted(set(ids))
    ended = [c.tap_id for c in actors.commands if c.request == TapCommand.WITHDRAW]
    assert ended == [*ids, ids[-1]]


def test_commands_plans_and_records_name_the_object(actors: Actors) -> None:
    name = shipped()[0].object.name
    reports: list[GoalReport] = []
    actors.network.subscribe("test", "goal_report", lambda _, report: reports.append(report))
    actors.send()
    end = actors.end()
    assert {command.object_id for command in actors.taps()} == {name}
    assert end.object_id == end.last_tap.object_id == name
    assert [report.object_id for report in reports] == [name]
    assert {record.object_id for record in reports[0].records} == {name}


def test_a_goal_for_an_object_that_the_cell_does_not_have_is_refused(actors: Actors) -> None:
    results = actors.request_goal(object_id="teapot")
    actors.wait(lambda: results, "the result")
    assert results[0].error_code == ErrorCode.GOAL_UNKNOWN_OBJECT
    assert "'teapot'" in results[0].error_msg and shipped()[0].object.name in results[0].error_msg
    assert not actors.taps()


def test_an_arm_that_does_not_arrive_ends_the_goal_with_a_message(actors: Actors) -> None:
    actors.arm_arrives = False
    actors.send()
    end = actors.end()
    assert end.error_code == ErrorCode.ARM_TIMEOUT and "within 2 s" in end.error_msg
    assert len(actors.taps()) == 1
    assert actors.commands[-1].request == TapCommand.WITHDRAW


def test_the_planner_reports_a_tap_under_way_at_every_tick(actors: Actors) -> None:
    """The tapper discharges the striker if these reports end."""
    actors.arm_arrives = False
    actors.send()
    actors.wait(actors.taps, "the tap")
    before = len(actors.plans)
    actors.run(1.0)
    assert len(actors.plans) - before >= 9


def test_a_tap_out_of_the_arms_reach_is_replaced_by_another(actors: Actors) -> None:
    actors.taps_out_of_reach = 1
    actors.send()
    end = actors.end()
    assert end.state == PlanState.REACHED, end.error_msg
    first, second = (from_message(command.strike_pose) for command in actors.taps()[:2])
    assert abs(first.rotation_to(second)) > math.radians(5.0)
    assert end.taps == len(actors.taps()) - 1


def test_an_arm_that_reaches_no_tap_ends_the_goal_with_its_own_message(actors: Actors) -> None:
    actors.taps_out_of_reach = 100
    actors.send()
    end = actors.end()
    assert (end.state, end.error_code) == (PlanState.FAILED, ErrorCode.ARM_OUT_OF_REACH)
    assert "elbow" in end.error_msg
    assert len(actors.taps()) == FAST.attempts
    assert end.taps == 0


class Touched(Actors):
    """A hand moves the object while the tapper charges for each of the first taps. The tapper
    reports the withdrawn tap as not fired."""

    def __init__(self) -> None:
        super().__init__()
        self.tapper_answers = None

    def _on_command(self, command: TapCommand) -> None:
        super()._on_command(command)
        if command.request == TapCommand.WITHDRAW and self.outcome == TapperState.NONE:
            self.outcome = TapperState.NOT_FIRED
        elif command.request == TapCommand.TAP and self.tapper_answers is None:
            self.scheduler.after(0.3, self._touch)

    def _touch(self) -> None:
        self.pose = Pose(self.pose.x + 0.003, self.pose.y, self.pose.theta)
        if len(self.taps()) > FAST.attempts:
            self.tapper_answers = TapperState.FIRED


def test_an_object_that_is_touched_before_the_shot_does_not_end_the_goal() -> None:
    actors = Touched()
    actors.wait(lambda: actors.states, "the planner is up")
    actors.run(0.3)
    actors.send()
    end = actors.end()
    assert (end.state, end.error_code) == (PlanState.REACHED, ErrorCode.NONE)
    assert len(actors.taps()) > FAST.attempts > end.taps > 0


@pytest.mark.parametrize("variance", [math.nan, math.inf, -math.inf, 1e308, 1.5])
def test_an_implausible_covariance_does_not_end_the_goal(actors: Actors, variance: float) -> None:
    actors.send()
    actors.until(PlanState.LOOKING)
    plausible = actors.covariance
    actors.covariance = [variance if row % 7 == 0 else 0.0 for row in range(36)]
    actors.run(0.5)
    monitor, now = actors.process.logic._monitor, actors.process._clock.now()
    assert not monitor.usable(0.0, 1, now)
    assert monitor.why_not_observed(None, 1, now)[0] == ErrorCode.OBJECT_NOT_SEEN
    assert "covariance" in monitor.why_not_observed(None, 1, now)[1]
    actors.covariance = plausible
    assert actors.end().error_code == ErrorCode.NONE


def test_an_arm_that_does_not_withdraw_ends_the_goal_with_a_message(actors: Actors) -> None:
    actors.arm_withdraws = False
    actors.send()
    assert actors.end().error_code == ErrorCode.ARM_TIMEOUT
    assert len(actors.taps()) == 1


def test_a_faulted_arm_ends_the_goal_with_its_own_message(actors: Actors) -> None:
    actors.arm_arrives = False
    actors.send()
    actors.wait(actors.taps, "a tap")
    actors.arm_error = (ErrorCode.ARM_ALARM, "a limit switch was hit")
    actors.arm_state = ArmState.FAULT
    end = actors.end()
    assert (end.error_code, end.error_msg) == actors.arm_error


STOPPED = (ErrorCode.TAPPER_STOPPED, "the tapper was stopped")


@pytest.mark.parametrize(
    "phase",
    [
        PlanState.WAITING_FOR_CELL,
        PlanState.LOOKING,
        PlanState.PLACING,
        PlanState.FIRING,
        PlanState.SETTLING,
    ],
)
def test_a_stop_ends_the_goal_at_once_in_every_phase(actors: Actors, phase: int) -> None:
    """Whoever clears the stop afterwards starts no motion."""
    actors.visible = phase != PlanState.LOOKING
    actors.camera_active = phase != PlanState.WAITING_FOR_CELL
    actors.arm_arrives = phase != PlanState.PLACING
    actors.arm_withdraws = phase != PlanState.SETTLING
    if phase == PlanState.FIRING:
        actors.tapper_answers = None
    actors.run(0.6)
    actors.send()
    actors.until(phase)
    actors.tapper_state, actors.tapper_error = TapperState.STOPPED, STOPPED
    actors.run(0.2)
    end = actors.plans[-1]
    assert (end.state, end.error_code, end.error_msg) == (PlanState.FAILED, *STOPPED)
    commanded = len(actors.taps())
    actors.tapper_state, actors.tapper_error = TapperState.SAFE, (0, "")
    actors.visible = actors.camera_active = actors.arm_arrives = actors.arm_withdraws = True
    actors.run(5.0)
    assert len(actors.taps()) == commanded and actors.plans[-1].state == PlanState.FAILED


@pytest.mark.parametrize("device", ["arm", "tapper"])
@pytest.mark.parametrize(
    "phase", [PlanState.WAITING_FOR_CELL, PlanState.LOOKING, PlanState.SETTLING]
)
def test_a_stop_that_was_cleared_while_the_planner_was_frozen_ends_the_goal(actors, phase, device):
    """The planner receives only the last state of arm and tapper, which no longer is STOPPED."""
    actors.last_stops = {"arm": Time(sec=5), "tapper": Time(sec=6)}
    actors.visible = phase != PlanState.LOOKING
    actors.camera_active = phase != PlanState.WAITING_FOR_CELL
    actors.arm_withdraws = phase != PlanState.SETTLING
    actors.run(0.6)
    actors.send()
    actors.until(phase)
    actors.last_stops[device] = Time(sec=7)
    actors.run(0.2)
    end, code = actors.plans[-1], getattr(ErrorCode, f"{device.upper()}_STOPPED")
    assert (end.state, end.error_code) == (PlanState.FAILED, code)
    commanded = len(actors.taps())
    actors.visible = actors.camera_active = actors.arm_withdraws = True
    actors.run(3.0)
    assert len(actors.taps()) == commanded and actors.plans[-1].state == PlanState.FAILED
    actors.send()
    actors.run(0.2)
    assert actors.plans[-1].state != PlanState.FAILED, "the stop is older than this goal"


def test_a_restarted_driver_that_was_not_stopped_ends_no_goal(actors: Actors) -> None:
    actors.last_stops = {"arm": Time(sec=5), "tapper": Time(sec=6)}
    actors.visible = False
    actors.run(0.6)
    actors.send()
    actors.until(PlanState.LOOKING)
    actors.last_stops = {"arm": Time(), "tapper": Time()}
    actors.run(0.2)
    assert actors.plans[-1].state == PlanState.LOOKING


def test_an_old_message_that_arrives_again_does_not_report_its_stop_again(actors: Actors) -> None:
    actors.visible = False
    actors.run(0.6)
    for time in (5, 7):
        actors.last_stops["arm"] = Time(sec=time)
        actors.run(0.2)
    actors.send()
    actors.until(PlanState.LOOKING)
    for time in (5, 0, 7):
        actors.last_stops["arm"] = Time(sec=time)
        actors.run(0.1)
    assert actors.plans[-1].state == PlanState.LOOKING
    actors.last_stops["arm"] = Time(sec=6)  # the clock was set back before the next stop
    actors.run(0.1)
    assert actors.plans[-1].error_code == ErrorCode.ARM_STOPPED


def test_a_goal_that_is_sent_before_the_stop_is_known_ends_at_once(actors: Actors) -> None:
    actors.tapper_active = False
    actors.send()
    actors.until(PlanState.WAITING_FOR_CELL)
    actors.tapper_state, actors.tapper_error = TapperState.STOPPED, STOPPED
    actors.tapper_active = True
    actors.run(0.2)
    assert (actors.plans[-1].state, actors.plans[-1].error_code) == (PlanState.FAILED, STOPPED[0])


@pytest.mark.parametrize("phase", [PlanState.PLACING, PlanState.SETTLING])
def test_an_arm_that_loses_its_reference_ends_the_goal_at_once(actors: Actors, phase: int) -> None:
    actors.arm_arrives = phase != PlanState.PLACING
    actors.arm_withdraws = False
    actors.send()
    actors.until(phase)
    actors.arm_error = ErrorCode.ARM_NOT_HOMED, "the arm is not homed; home the arm"
    actors.arm_state = ArmState.NOT_HOMED
    actors.run(0.2)
    end = actors.plans[-1]
    assert (end.state, end.error_code, end.error_msg) == (PlanState.FAILED, *actors.arm_error)


def test_a_goal_waits_for_an_arm_that_is_not_homed_yet(actors: Actors) -> None:
    actors.arm_state = ArmState.NOT_HOMED
    actors.run(0.6)
    actors.send()
    actors.run(1.0)
    assert actors.plans[-1].state == PlanState.WAITING_FOR_CELL
    actors.arm_state = ArmState.IDLE
    assert actors.end().state == PlanState.REACHED


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({"arm_state": ArmState.NOT_HOMED}, ErrorCode.ARM_BUSY, "the arm is busy"),
        ({"camera_active": False}, ErrorCode.CAMERA_SILENT, "camera_pose"),
        ({"tapper_state": TapperState.CHARGED}, ErrorCode.TAPPER_BUSY, "the tapper is busy"),
    ],
)
def test_the_planner_reports_what_it_waits_for(actors, change, code, words) -> None:
    for name, value in change.items():
        setattr(actors, name, value)
    actors.run(2.5)  # a camera that has sent a message counts as silent after the message timeout
    actors.send()
    actors.run(0.6)
    waiting = actors.plans[-1]
    assert (waiting.state, waiting.error_code) == (PlanState.WAITING_FOR_CELL, code)
    assert words in waiting.error_msg
    actors.camera_active = True
    actors.arm_state, actors.tapper_state = ArmState.IDLE, TapperState.SAFE
    assert actors.end().state == PlanState.REACHED
    assert not any(plan.error_code for plan in actors.plans if plan.state == PlanState.LOOKING)


@pytest.mark.parametrize(
    ("phase", "reported", "outcomes"),
    [
        # In these phases the tapper may be about to fire, or its report may be under way.
        (PlanState.PLACING, None, [TapperState.UNKNOWN]),
        (PlanState.FIRING, None, [TapperState.UNKNOWN]),
        (PlanState.SETTLING, TapperState.FIRED, [TapperState.FIRED]),
        (PlanState.SETTLING, TapperState.UNKNOWN, [TapperState.UNKNOWN]),
        (PlanState.SETTLING, TapperState.NOT_FIRED, []),
    ],
)
def test_the_result_of_a_cancelled_goal_contains_a_tap_that_may_have_been_fired(
    actors: Actors, phase: int, reported: int | None, outcomes: list[int]
) -> None:
    actors.arm_arrives = phase != PlanState.PLACING
    actors.arm_withdraws = False
    actors.tapper_answers = reported
    reports: list[GoalReport] = []
    actors.network.subscribe("test", "goal_report", lambda _, report: reports.append(report))
    results = actors.request_goal()
    actors.until(phase)
    actors.process.request("cancel", None, 1, lambda _: None, waits=False)
    actors.wait(lambda: results, "the result")
    actors.run(0.1)
    (result,) = results
    assert result.error_code == ErrorCode.GOAL_CANCELED
    assert [record.outcome for record in result.records] == outcomes
    assert result.taps == actors.plans[-1].taps == len(outcomes)
    assert [record.outcome for record in reports[0].records] == outcomes


def test_a_shot_that_is_reported_after_its_tap_was_given_up_is_recorded(actors: Actors) -> None:
    actors.arm_arrives = False
    actors.send()
    actors.wait(actors.taps, "a tap")
    first = actors.taps()[0]
    actors.pose, actors.at_rest = from_message(first.predicted_pose), False
    actors.until(PlanState.LOOKING)
    actors.outcome = TapperState.FIRED
    actors.run(0.1)
    actors.arm_arrives = actors.at_rest = True
    actors.wait(lambda: actors.plans[-1].last_tap.tap_id, "a record")
    record = actors.plans[-1].last_tap
    assert (record.tap_id, record.outcome) == (first.tap_id, TapperState.FIRED)


def test_a_tap_that_the_tapper_did_not_fire_is_not_recorded_if_the_object_was_moved(actors):
    actors.arm_arrives = False
    actors.send()
    actors.wait(actors.taps, "a tap")
    actors.pose, actors.at_rest = Pose(-0.04, 0.03, 0.2), False
    actors.until(PlanState.LOOKING)
    actors.outcome = TapperState.NOT_FIRED
    actors.run(0.1)
    actors.tap = None  # tapper_state of another tapper's node follows
    actors.run(0.1)
    actors.arm_arrives = actors.at_rest = True
    end = actors.end()
    assert end.state == PlanState.REACHED and end.taps == len(actors.taps()) - 1


def test_after_an_unknown_outcome_the_object_is_observed_and_the_tap_not_repeated(actors):
    actors.tapper_answers = TapperState.UNKNOWN
    actors.send()
    assert actors.end().state == PlanState.REACHED
    ids = [command.tap_id for command in actors.taps()]
    assert len(ids) == len(set(ids))


def test_a_tapper_that_never_answers_is_given_a_new_tap_id(actors):
    actors.tapper_answers = None
    actors.send()
    actors.wait(lambda: len(actors.taps()) >= 2, "another look, then another tap")
    first, second = actors.taps()[:2]
    assert second.tap_id > first.tap_id


LATE_CODES = (
    ErrorCode.CAMERA_SILENT,
    ErrorCode.ARM_SILENT,
    ErrorCode.NOT_READY,
    ErrorCode.TAPPER_ARM_NOT_IN_POSITION,
)


@pytest.mark.parametrize(
    ("code", "taps"),
    [*((code, 10) for code in LATE_CODES), (ErrorCode.OBJECT_MOVED, 3), (ErrorCode.NONE, 3)],
)
def test_a_tap_with_a_late_message_is_attempted_more_often(actors, code, taps):
    actors.tapper_answers = TapperState.NOT_FIRED
    actors.tapper_error = (code, "refused") if code else (0, "")
    actors.send()
    end = actors.end()
    assert end.state == PlanState.FAILED and end.error_code == (code or ErrorCode.NOT_READY)
    assert len(actors.taps()) == taps and end.taps == 0


def test_late_messages_before_a_tap_do_not_end_the_goal(actors: Actors) -> None:
    actors.tapper_answers = TapperState.NOT_FIRED
    actors.tapper_error = (ErrorCode.CAMERA_SILENT, "the last picture is 0.47 s old")
    actors.send()
    actors.wait(lambda: len(actors.taps()) == 5, "a fifth attempt")
    actors.tapper_answers, actors.tapper_error = TapperState.FIRED, (0, "")
    assert actors.end().state == PlanState.REACHED


def test_taps_ended_by_another_program_are_reported_as_such(actors: Actors) -> None:
    """If the tapper fires nothing and reports no error, the planner concludes that another program
    has ended its taps."""
    actors.tapper_answers = TapperState.NOT_FIRED
    actors.send()
    end = actors.end()
    assert end.error_code == ErrorCode.NOT_READY
    assert "another program" in end.error_msg and "tap_command" in end.error_msg


def test_a_camera_that_observes_another_object_refuses_the_goal(actors: Actors) -> None:
    actors.object_id = "brass ring"
    results = actors.request_goal()
    actors.wait(lambda: results, "the refusal", patience=1.0)
    assert results[0].error_code == ErrorCode.CONFIGURATION_CONFLICT
    assert "'brass ring'" in results[0].error_msg and "'aluminium disk'" in results[0].error_msg
    assert not actors.taps()


def test_a_goal_waits_while_two_nodes_do_the_work_of_one(actors: Actors) -> None:
    logic, clock = actors.process.logic, actors.process._clock
    sentence = "2 nodes publish arm_state (/a, /b)"
    actors.arm_arrives = False
    actors.send()
    actors.until(PlanState.PLACING)
    logic.on_conflict(sentence, clock.now())
    actors.outcome = TapperState.NOT_FIRED
    actors.tapper_error = (ErrorCode.CONFIGURATION_CONFLICT, sentence)
    actors.until(PlanState.WAITING_FOR_CELL)
    number = len(actors.taps())
    actors.run(1.0)
    assert len(actors.taps()) == number
    actors.arm_arrives, actors.tapper_error = True, (0, "")
    logic.on_conflict("", clock.now())
    assert actors.end().state == PlanState.REACHED


class Nudged(Actors):
    """A person moves the object whenever a tap was commanded."""

    def _on_command(self, command: TapCommand) -> None:
        super()._on_command(command)
        if command.request == TapCommand.TAP:
            self.pose = self.pose @ Pose(0.004, 0.0, 0.0)


def test_taps_that_are_given_up_are_limited_in_number() -> None:
    actors = Nudged()
    actors.arm_arrives = False
    actors.send(Pose(0.06, 0.02, 0.3))
    end = actors.end(patience=120.0)
    assert end.state == PlanState.FAILED and end.error_code == ErrorCode.NOT_READY
    assert "before the tap" in end.error_msg
    assert len(actors.taps()) == FAST.late_attempts and end.taps == 0


@pytest.mark.parametrize(("age", "replaces"), [(0.0, True), (-1.0, True), (5.0, False)])
def test_an_older_goal_does_not_replace_a_newer_one(
    actors: Actors, age: float, replaces: bool
) -> None:
    actors.send()
    actors.until(PlanState.PLACING)
    other = PoseStamped(pose=to_message(Pose(0.02, 0.0, 0.0)))
    other.header.frame_id = "table"
    # The first goal has no stamp, so it counts as sent SKEW_LIMIT_S before it was received.
    other.header.stamp = to_stamp(actors.process._clock.now().ros - round(1e9 * age))
    actors.publish("goal_pose", other)
    actors.run(0.5)
    goal = from_message(actors.plans[-1].goal.pose)
    assert (goal.distance_to(Pose(0.02, 0.0, 0.0)) < 1e-9) == replaces
    if not replaces:
        assert any(state.error_code == ErrorCode.GOAL_STALE for state in actors.plans)


def test_taps_without_effect_end_the_goal(actors: Actors) -> None:
    actors.moves_when_fired = False
    actors.send()
    end = actors.end()
    assert end.error_code == ErrorCode.TAP_WITHOUT_EFFECT
    assert "3 taps" in end.error_msg
    assert len(actors.taps()) == 3


def test_a_tap_that_misses_learns_nothing_from_an_earlier_slide(actors, monkeypatch):
    tracks = []
    monkeypatch.setattr(Task, "take_in", _with_tracks(Task.take_in, tracks))
    actors.run(0.3)
    actors.at_rest = False
    for step in range(5, 0, -1):
        actors.pose = Pose(START.x - 0.01 * step, START.y, START.theta)
        actors.run(0.04)
    actors.pose, actors.at_rest, actors.rest_since = START, True, actors.stamp()
    actors.moves_when_fired = False
    actors.send()
    assert actors.end().error_code == ErrorCode.TAP_WITHOUT_EFFECT
    assert tracks == [None, None, None]


def _with_tracks(take_in, tracks):
    """Return a ``Task.take_in`` that adds each track to a list."""

    def take(task, shot, seen, track=None):
        tracks.append(track)
        take_in(task, shot, seen, track)

    return take


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"visible": False}, ErrorCode.OBJECT_NOT_SEEN),
        ({"at_rest": False}, ErrorCode.OBJECT_NOT_AT_REST),
        ({"camera_active": False}, ErrorCode.CAMERA_SILENT),
        ({"arm_active": False}, ErrorCode.ARM_SILENT),
        ({"tapper_active": False}, ErrorCode.TAPPER_SILENT),
        ({"arm_state": ArmState.NOT_HOMED}, ErrorCode.ARM_BUSY),
    ],
    ids=lambda value: str(value),
)
def test_a_missing_device_is_named_and_no_tap_is_commanded(actors, change, code):
    for name, value in change.items():
        setattr(actors, name, value)
    actors.run(0.6)
    actors.send()
    end = actors.end()
    assert end.error_code == code, end.error_msg
    assert len(end.error_msg) > 15
    assert actors.taps() == []


def test_an_object_under_the_arm_is_reported_with_the_arm_position_and_the_remedy(actors):
    """The object may be placed, or may stop, where the withdrawn arm hides it."""
    actors.visible, actors.tip = False, Pose(0.15, -0.08, 0.0)
    actors.run(0.6)
    actors.send()
    end = actors.end()
    assert end.error_code == ErrorCode.OBJECT_NOT_SEEN
    assert "its tool is at x 150 mm, y -80 mm" in end.error_msg
    assert "if the object lies there, move it to a visible place" in end.error_msg
    assert actors.taps() == []


def test_an_arm_that_may_hide_the_object_is_asked_once_to_move_away(actors: Actors) -> None:
    actors.visible = False
    actors.run(0.6)
    actors.send()
    actors.wait(lambda: actors.commands, "a command")
    actors.visible = True
    assert actors.end().state == PlanState.REACHED
    asked = [c for c in actors.commands if c.request == TapCommand.CLEAR_VIEW]
    assert len(asked) == 1 and asked[0] is actors.commands[0]
    assert 0 < asked[0].tap_id < min(tap.tap_id for tap in actors.taps())


def test_an_object_moved_before_the_tap_is_observed_again(actors: Actors) -> None:
    actors.arm_arrives = False
    actors.send()
    actors.wait(actors.taps, "a tap")
    actors.pose = Pose(-0.04, 0.03, 0.2)
    actors.arm_arrives = True
    actors.wait(lambda: len(actors.taps()) >= 2, "a second tap")
    first, second = actors.taps()[:2]
    assert actors.commands[1].request == TapCommand.WITHDRAW
    assert actors.commands[1].tap_id == first.tap_id < second.tap_id
    assert from_message(second.object_pose).distance_to(Pose(-0.04, 0.03, 0.2)) < 1e-6


def test_a_tap_left_by_a_crashed_planner_is_withdrawn(actors: Actors) -> None:
    actors.tap = TapCommand(tap_id=77)
    actors.arm_state = ArmState.IN_POSITION
    actors.send()
    actors.wait(lambda: actors.commands, "a command")
    assert actors.commands[0].request == TapCommand.WITHDRAW
    assert actors.commands[0].tap_id == 77
    assert actors.end().state == PlanState.REACHED


@pytest.mark.parametrize("wrong", [3_000_000_000, 2**64 - 1])
def test_a_tap_id_that_arm_and_tapper_would_refuse_does_not_count(actors, wrong):
    actors.tap = TapCommand(tap_id=wrong)
    actors.send()
    assert actors.end().state == PlanState.REACHED
    clock = actors.stamp().sec
    assert actors.taps() and all(tap.tap_id <= clock for tap in actors.taps())


def test_the_next_tap_id_is_above_a_greater_id_of_arm_or_tapper(actors: Actors) -> None:
    greater = actors.stamp().sec + 1000
    actors.tap = TapCommand(tap_id=greater)
    actors.send()
    assert actors.end().state == PlanState.REACHED
    assert actors.taps()[0].tap_id == greater + 1


@pytest.mark.parametrize("crashed", [False, True])
def test_a_lost_withdrawal_is_repeated(actors: Actors, crashed: bool) -> None:
    """``crashed``: the tap was left by a planner that has crashed."""
    if crashed:
        actors.tap, actors.arm_state = TapCommand(tap_id=77), ArmState.IN_POSITION
    actors.lost_withdrawals = 1
    actors.send()
    assert actors.end().state == PlanState.REACHED


def test_the_residual_is_reported(actors: Actors) -> None:
    actors.send()
    actors.wait(lambda: any(math.isfinite(p.residual_distance) for p in actors.plans), "a residual")
    first = next(p for p in actors.plans if math.isfinite(p.residual_distance))
    assert first.residual_distance == pytest.approx(START.distance_to(GOAL), abs=1e-6)
    assert first.residual_rotation == pytest.approx(START.rotation_to(GOAL), abs=1e-6)
    actors.end()


def test_the_final_pose_is_that_of_the_decision(actors: Actors) -> None:
    results = actors.request_goal()
    actors.wait(lambda: results, "the result")
    (result,) = results
    assert result.error_code == 0, result
    assert from_message(result.final_pose.pose.pose) == pytest.approx(actors.pose)
    assert result.residual_distance == pytest.approx(GOAL.distance_to(actors.pose), abs=1e-9)


def test_a_goal_waits_for_its_solution_among_other_obstacles(actors, monkeypatch):
    """A solver in the background begins anew if an obstacle moves after the goal was solved."""
    ready_at = [0.0]
    update, decide, decided = GoalHandling.update_free_space, Task.decide, []

    def change(*arguments: Any) -> Any:
        if not ready_at[0]:
            ready_at[0] = actors.now() + 3.0
        return update(*arguments)

    def note(*arguments: Any) -> Any:
        decided.append(actors.now())
        return decide(*arguments)

    monkeypatch.setattr(GoalHandling, "update_free_space", change)
    monkeypatch.setattr(Task, "decide", note)
    monkeypatch.setattr(Task, "ready", property(lambda _: actors.now() >= ready_at[0]))
    actors.send()
    assert actors.end().state == PlanState.REACHED
    assert decided[0] >= ready_at[0] > 0.0


def test_a_goal_ends_at_its_time_limit_and_withdraws_its_tap() -> None:
    made = Actors(replace(FAST, goal_time_limit=1.0, place_deadline=10.0))
    made.arm_arrives = False
    made.send()
    sent = made.now()
    assert made.end(8.0).error_code == ErrorCode.DEADLINE_EXCEEDED
    assert made.now() - sent < 1.5
    made.wait(lambda: made.arm_state == ArmState.IDLE, "the tap was withdrawn")


def test_a_goal_that_the_arm_cannot_serve_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "config"
    shutil.copytree(shared_folder(), folder)
    path = folder / "cell.yaml"
    path.write_text(path.read_text().replace("forearm: 0.375", "forearm: 0.150"))
    made = Actors(cell=load_cell(path))
    made.send(Pose(0.2, -0.12, 0.0))
    made.wait(
        lambda: any(p.error_code == ErrorCode.GOAL_OUT_OF_REACH for p in made.plans), "refused"
    )
    assert made.taps() == []


def test_a_goal_that_replaces_another_one_knows_what_was_learnt(actors: Actors) -> None:
    actors.send(Pose(0.1, 0.05, 2.5))  # several taps away
    actors.wait(lambda: actors.plans[-1].last_tap.tap_id, "a tap from which the planner learns")
    actors.send(Pose(-0.1, 0.05, 0.3))
    actors.wait(lambda: actors.plans[-1].goal.pose.position.x == -0.1, "the other goal")
    first = next(n for n, one in enumerate(actors.plans) if one.goal.pose.position.x == -0.1)
    assert actors.plans[first - 1].learnt.explained > 0
    assert actors.plans[first].learnt == actors.plans[first - 1].learnt
