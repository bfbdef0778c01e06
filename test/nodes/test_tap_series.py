"""The trials of an experiment, with a client whose answers are scripted."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from tapping_cell_msgs.action import SingleTap
from tapping_cell_msgs.msg import ErrorCode, TapperState, TapRecord

from tapping_cell.calibration.design import Design
from tapping_cell.calibration.experiment import ExperimentFile
from tapping_cell.calibration.trials import Track, read_trials
from tapping_cell.cli.tap_maker import SeriesStopped
from tapping_cell.cli.tap_series import TapSeries
from tapping_cell.logic.poses import covariance_to_message
from tapping_cell.mechanics import Disk, Impact, Sliding, Striker, Tap
from tapping_cell.nodes.clients.goal_client import Finished
from tapping_cell.nodes.clients.single_tap_client import SingleTapClient
from tapping_cell.nodes.conversions import to_message
from tapping_cell.report.bag import BagWriter
from tapping_cell.se2 import Pose

DISK = Disk(radius=0.048, mass=0.2455, height=0.012)
TAP = Tap(
    sliding=Sliding(DISK, friction=0.17, torque_factor=3.64, gravity=9.81),
    impact=Impact(DISK, Striker(0.1, 0.0054), restitution=0.86, friction=0.20),
)
DESIGN = Design(speeds=(0.6,), incidences=(0.3,), trials=3)
HEADER = ExperimentFile(format=1, made="2026-01-01", source="simulated", camera_rate_hz=30.0)
TRAVEL = 0.04
FRICTION = 1.7


@dataclass
class ScriptedClient:
    """A client whose taps end as scripted: "ok", "miss", "lost", an error code without a tap, or an
    error code with a tap of unknown outcome."""

    answers: list[str | int | tuple[int, str]]
    pose: Pose = field(default_factory=lambda: Pose(0.0, 0.0, 0.0))
    goal_code: int = 0
    goals: list[Pose] = field(default_factory=list)
    directions: list[float] = field(default_factory=list)
    _track: Track | None = None

    def missing(self) -> list[str]:
        return []

    def object_pose(self) -> Pose:
        return self.pose

    def tap(
        self, speed: float, incidence: float, direction: float, slack: float, check: object
    ) -> SingleTap.Result:
        answer = self.answers.pop(0)
        if isinstance(answer, int):
            return SingleTap.Result(error_code=answer, error_msg="so it was told")
        if isinstance(answer, tuple):
            record = TapRecord(tap_id=1, outcome=TapperState.UNKNOWN)
            return SingleTap.Result(error_code=answer[0], error_msg=answer[1], record=record)
        self.directions.append(direction)
        travel = {"ok": TRAVEL, "miss": 0.0001, "lost": TRAVEL}[answer]
        record = TapRecord(tap_id=1, outcome=TapperState.FIRED, striker_speed=speed, dx=TRAVEL)
        record.object_pose = to_message(self.pose)
        record.strike_pose = to_message(Pose(self.pose.x - 0.0684, self.pose.y, 0.0))
        record.measured_pose.covariance = covariance_to_message(np.diag([1e-10, 1e-10, 1e-8]))
        time = np.arange(-0.5, 1.0, 1 / 30)
        start_speed = math.sqrt(2 * FRICTION * travel)
        sliding = np.clip(time, 0.0, start_speed / FRICTION)
        along = start_speed * sliding - FRICTION / 2 * sliding**2
        still = np.zeros(time.shape)
        x = self.pose.x + along * math.cos(direction)
        y = self.pose.y + along * math.sin(direction)
        self._track = Track(time, x, y, still, still + 1e-5, still + 1e-4)
        self.pose = Pose(float(x[-1]), float(y[-1]), 0.0)
        gone = Pose(math.nan, math.nan, math.nan)
        record.measured_pose.pose = to_message(gone if answer == "lost" else self.pose)
        return SingleTap.Result(
            error_code=ErrorCode.OBJECT_NOT_SEEN if answer == "lost" else 0,
            error_msg="a hand" if answer == "lost" else "",
            record=record,
        )

    def tip_of(self, tap_id: int) -> Pose | None:
        return None

    def track_of(self, record: TapRecord) -> Track | None:
        return self._track

    def write_bag(self, bag: object) -> None:
        return

    def send(self, goal: Pose, tolerance: tuple[float, float]) -> None:
        self.goals.append(goal)

    def events(self) -> Iterator[Finished]:
        if not self.goal_code:
            self.pose = self.goals[-1]
        yield Finished(self.goal_code, "as told", self.pose, 0.0, 0.0, 1)

    def cancel(self) -> None:
        return


def series(client: ScriptedClient, folder: Path, design: Design = DESIGN) -> TapSeries:
    return TapSeries(
        cast(SingleTapClient, client),
        folder,
        design,
        HEADER,
        TAP,
        cast(BagWriter, None),
        [],
        lambda: None,
    )


def test_each_trial_is_saved_before_the_next_one(tmp_path: Path) -> None:
    client = ScriptedClient(["ok"] * 3)
    for number, done in enumerate(series(client, tmp_path).run(), start=1):
        assert done.trial.trial == number
        assert len(read_trials(tmp_path).trials) == number
    assert number == 3 and client.goals == []
    # The first tap goes away from the middle and the second one back towards it.
    assert math.remainder(client.directions[1] - client.directions[0], math.pi) == pytest.approx(
        0.0, abs=1e-6
    )


def test_unusable_trials_are_recorded_with_a_reason_and_repeated(tmp_path: Path) -> None:
    made = list(series(ScriptedClient(["ok", "miss", "lost", "ok", "ok"]), tmp_path).run())
    assert [done.trial.outcome for done in made] == ["ok", "missed", "lost", "ok", "ok"]
    read = read_trials(tmp_path)
    assert [trial.outcome for trial in read.trials] == ["ok", "missed", "lost", "ok", "ok"]
    assert read.trials[2].note == "a hand" and read.left_out == ()


def test_a_run_that_fails_repeatedly_is_aborted(tmp_path: Path) -> None:
    client = ScriptedClient(["ok"] + ["miss"] * 9)
    with pytest.raises(SeriesStopped, match="only 1 of 6 trials are usable"):
        list(series(client, tmp_path).run())
    assert len(client.answers) == 4


def test_without_free_space_the_object_is_moved_to_the_middle(tmp_path: Path) -> None:
    client = ScriptedClient(
        [ErrorCode.TAP_LEAVES_TABLE, "ok", "ok", "ok"], pose=Pose(0.2, 0.1, 0.4)
    )
    assert len(list(series(client, tmp_path).run())) == 3
    assert client.goals == [Pose(0.0, 0.0, 0.4)]


def test_without_free_space_in_the_middle_it_stops_with_the_planners_message(
    tmp_path: Path,
) -> None:
    with pytest.raises(SeriesStopped, match="TAP_LEAVES_VIEW: so it was told") as stopped:
        list(series(ScriptedClient([ErrorCode.TAP_LEAVES_VIEW]), tmp_path).run())
    assert stopped.value.code == ErrorCode.TAP_LEAVES_VIEW


def test_an_object_that_cannot_be_returned_stops_the_series(tmp_path: Path) -> None:
    client = ScriptedClient([ErrorCode.NO_TAP_FOUND], Pose(0.2, 0.1, 0.0), ErrorCode.ARM_TIMEOUT)
    with pytest.raises(SeriesStopped, match="brought back") as stopped:
        list(series(client, tmp_path).run())
    assert stopped.value.code == ErrorCode.ARM_TIMEOUT


def test_a_temporary_error_is_waited_for_with_a_limit(tmp_path: Path) -> None:
    passing = int(ErrorCode.OBJECT_NOT_SEEN)
    client = ScriptedClient([passing, passing, "ok", passing, passing, "ok", "ok"])
    assert len(list(series(client, tmp_path / "a").run())) == 3
    with pytest.raises(SeriesStopped, match="OBJECT_NOT_SEEN"):
        list(series(ScriptedClient([passing] * 5), tmp_path / "b").run())


def test_a_fault_stops_the_series_at_once(tmp_path: Path) -> None:
    client = ScriptedClient(["ok", ErrorCode.TAPPER_INTERLOCK_OPEN, "ok"])
    with pytest.raises(SeriesStopped, match="TAPPER_INTERLOCK_OPEN"):
        list(series(client, tmp_path).run())
    assert client.answers == ["ok"]
    assert len(read_trials(tmp_path).trials) == 1


def test_a_stop_during_a_tap_ends_the_series_even_if_the_cell_is_reset(tmp_path: Path) -> None:
    client = ScriptedClient(["ok", (int(ErrorCode.EMERGENCY_STOP), "emergency stop"), "ok"])
    with pytest.raises(SeriesStopped, match="EMERGENCY_STOP"):
        list(series(client, tmp_path).run())
    assert client.answers == ["ok"]
    assert len(read_trials(tmp_path).trials) == 1, "a tap of unknown outcome is no trial"


def test_a_tap_of_unknown_outcome_that_was_replaced_is_repeated(tmp_path: Path) -> None:
    client = ScriptedClient([(int(ErrorCode.GOAL_REPLACED), "replaced"), "ok", "ok", "ok"])
    assert len(list(series(client, tmp_path).run())) == 3


def test_a_stopped_series_is_resumed_where_it_ended(tmp_path: Path) -> None:
    first = series(ScriptedClient(["ok", "lost"]), tmp_path)
    made = first.run()
    next(made), next(made)
    second = series(ScriptedClient(["ok", "ok"]), tmp_path)
    second.trials.extend(read_trials(tmp_path).trials)
    assert [done.trial.trial for done in second.run()] == [3, 4]
