"""The action single_tap makes one tap with the planner's safety checks and always returns a
record."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from tapping_cell_msgs.action import SingleTap
from tapping_cell_msgs.msg import ArmState, ErrorCode, PlanState, TapCommand, TapperState
from test_tap_planner import Actors, acted

from tapping_cell.nodes.clients.single_tap_client import SingleTapClient
from tapping_cell.nodes.conversions import from_message
from tapping_cell.se2 import Pose

SPEED, INCIDENCE = 0.6, math.radians(20.0)


@dataclass
class Experiment:
    """The planner with simulated devices, and the client for experiments."""

    actors: Actors
    client: SingleTapClient

    def tap(
        self, speed: float = SPEED, incidence: float = INCIDENCE, slack: float = math.pi
    ) -> SingleTap.Result:
        return self.client.tap(speed, incidence, math.nan, slack, lambda: None)

    def begin(self) -> tuple[threading.Thread, list[SingleTap.Result]]:
        """Start a tap in the background."""
        results: list[SingleTap.Result] = []
        thread = threading.Thread(target=lambda: results.append(self.tap()), daemon=True)
        thread.start()
        return thread, results


@pytest.fixture
def experiment() -> Iterator[Experiment]:
    with acted(ready_deadline=10.0) as actors, SingleTapClient() as client:
        actors.pose = Pose(0.05, -0.03, 0.4)
        deadline = time.monotonic() + 60.0
        while missing := client.missing():
            assert time.monotonic() < deadline, missing
            time.sleep(0.05)
        yield Experiment(actors, client)


def test_a_tap_is_made_once_and_recorded(experiment: Experiment) -> None:
    actors = experiment.actors
    before = actors.pose
    result = experiment.tap()
    assert result.error_code == ErrorCode.NONE, result.error_msg
    (command,) = actors.taps()
    record = result.record
    assert record.tap_id == command.tap_id and record.outcome == TapperState.FIRED
    assert record.planner == "prescribed"
    assert command.striker_speed == record.striker_speed == SPEED
    assert from_message(record.object_pose).distance_to(before) < 1e-6
    assert from_message(record.measured_pose.pose).distance_to(actors.pose) < 1e-6
    # Without a given direction, the tap goes towards the middle.
    assert math.hypot(actors.pose.x, actors.pose.y) < math.hypot(before.x, before.y)
    ends = [c.tap_id for c in actors.commands if c.request == TapCommand.WITHDRAW]
    assert set(ends) == {command.tap_id}  # two withdrawals: the second one parks the arm
    actors.bench.wait(lambda: actors.plans[-1].state == PlanState.IDLE, "it ends in idle")


def test_a_second_tap_and_a_tap_during_a_goal_are_refused(experiment: Experiment) -> None:
    actors = experiment.actors
    actors.arm_arrives = False
    actors.send(Pose(0.0, 0.0, 0.4))
    actors.bench.wait(actors.taps, "the goal's first tap")
    refused = experiment.tap()
    assert refused.error_code == ErrorCode.PLANNER_BUSY and "under way" in refused.error_msg
    assert refused.record.tap_id == 0
    assert len(actors.taps()) == 1


def test_a_goal_replaces_a_single_tap(experiment: Experiment) -> None:
    actors = experiment.actors
    actors.arm_arrives = False
    thread, results = experiment.begin()
    actors.bench.wait(actors.taps, "the tap")
    actors.arm_arrives = True
    actors.send(Pose(0.04, -0.03, 0.4))
    thread.join(60)
    assert results[0].error_code == ErrorCode.GOAL_REPLACED
    assert actors.end().state == PlanState.REACHED
    ids = [command.tap_id for command in actors.taps()]
    assert len(ids) == len(set(ids)) >= 2


def test_an_impossible_tap_is_refused_with_a_message(experiment: Experiment) -> None:
    for asked, code, word in (
        ((0.001, INCIDENCE), ErrorCode.TAPPER_SPEED_OUT_OF_RANGE, "2500 mm/s"),
        ((math.nan, INCIDENCE), ErrorCode.TAPPER_SPEED_OUT_OF_RANGE, "nan"),
        ((SPEED, math.radians(80)), ErrorCode.COMMAND_INVALID, "80.0 deg"),
        ((SPEED, math.nan), ErrorCode.COMMAND_INVALID, "nan"),
        ((SPEED, INCIDENCE, -1.0), ErrorCode.COMMAND_INVALID, "slack"),
        ((2.4, INCIDENCE), ErrorCode.TAP_LEAVES_TABLE, "lower striker speed"),
    ):
        refused = experiment.tap(*asked)
        assert refused.error_code == code, refused.error_msg
        assert word in refused.error_msg
        assert refused.record.tap_id == 0
    assert experiment.actors.taps() == []


def test_a_tap_out_of_the_cameras_view_is_refused(experiment: Experiment) -> None:
    experiment.actors.references = (101, 104)
    refused = experiment.tap()
    assert refused.error_code == ErrorCode.TAP_LEAVES_VIEW
    assert experiment.actors.taps() == []


def test_an_object_lost_after_the_tap_leaves_a_record_without_an_end(
    experiment: Experiment,
) -> None:
    actors = experiment.actors
    actors.lost_when_fired = True
    result = experiment.tap()
    assert result.error_code == ErrorCode.OBJECT_NOT_SEEN, result.error_msg
    assert result.record.tap_id == actors.taps()[0].tap_id
    assert math.isnan(result.record.measured_pose.pose.position.x)


def test_after_an_unknown_outcome_the_object_is_observed_and_the_tap_not_repeated(
    experiment: Experiment,
) -> None:
    actors = experiment.actors
    actors.tapper_answers = TapperState.UNKNOWN
    result = experiment.tap()
    assert result.error_code == ErrorCode.NONE
    assert result.record.outcome == TapperState.UNKNOWN
    assert len(actors.taps()) == 1


def test_a_tap_known_not_to_have_fired_is_tried_three_times_with_new_ids(
    experiment: Experiment,
) -> None:
    actors = experiment.actors
    actors.tapper_answers = TapperState.NOT_FIRED
    result = experiment.tap()
    # The tapper gives no error code for the taps that were not fired, so the planner reports that
    # another program ended them.
    assert result.error_code == ErrorCode.NOT_READY and result.record.tap_id == 0
    ids = [command.tap_id for command in actors.taps()]
    assert len(ids) == len(set(ids)) == 3


def test_a_tap_that_moves_nothing_is_recorded_too(experiment: Experiment) -> None:
    actors = experiment.actors
    actors.moves_when_fired = False
    before = actors.pose
    result = experiment.tap()
    assert result.error_code == ErrorCode.NONE
    assert from_message(result.record.measured_pose.pose).distance_to(before) < 1e-6
    assert len(actors.taps()) == 1


def test_canceling_withdraws_the_arm(experiment: Experiment) -> None:
    actors = experiment.actors
    actors.arm_arrives = False

    class Stop(Exception):
        pass

    def check() -> None:
        if actors.taps():
            raise Stop

    with pytest.raises(Stop):
        experiment.client.tap(SPEED, INCIDENCE, math.nan, math.pi, check)
    actors.bench.wait(lambda: actors.plans[-1].state == PlanState.CANCELED, "canceled")
    assert actors.commands[-1].request == TapCommand.WITHDRAW
    assert actors.arm_state == ArmState.IDLE
