"""The records that `calibrate arm` and `calibrate tapper` make with a running cell."""

from __future__ import annotations

import argparse
import math
import threading
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from harness import Bench, bench
from rich.console import Console
from sensor_msgs.msg import JointState
from tapping_cell_msgs.msg import ArmState, ErrorCode, ObjectState, ObjectStates
from test_tap_series import ScriptedClient
from trajectory_msgs.msg import JointTrajectory

from tapping_cell.calibration import arm, tapper
from tapping_cell.calibration.arm import calibrate_arm
from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.csv_table import RecordError, read_csv
from tapping_cell.calibration.growing_csv import GrowingCsv
from tapping_cell.calibration.tapper import SHARES
from tapping_cell.cli.calibration import arm_recording, arm_verb, tapper_recording
from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.scara import Joints
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.clients.single_tap_client import SingleTapClient
from tapping_cell.nodes.conversions import to_message
from tapping_cell.se2 import Pose

pytestmark = pytest.mark.usefixtures("own_signals")

CELL = load_cell()
QUIET = Console(quiet=True)
MOUNT = Pose(-0.03, 0.012, 0.4)
BASE = CELL.arm_base @ Pose(0.002, -0.001, 0.01)


@dataclass
class HeldMarker:
    """Simulated arm and camera. The arm holds a marker, and the camera sees this marker at the pose
    to which the arm has moved."""

    bench: Bench
    blind: bool = False
    refuses: bool = False
    unseen: int = 0
    """Number of postures, beginning with the next one, at which the camera does not see the
    marker."""
    joints: Joints = field(default_factory=lambda: Joints(0.4, 0.8, -0.02, 0.0))
    other_file: float = 0.0
    """Error of the tip in the cell file that the running cell uses, in m."""
    visits: int = 0
    _visible: bool = True
    _error: str = ""

    def __post_init__(self) -> None:
        node = self.bench.probe
        assert node is not None
        self._node, self._lock = node, threading.Lock()
        self._rest = node.get_clock().now()
        self._arm = node.create_publisher(ArmState, "arm_state", LATCHED)
        self._joints = node.create_publisher(JointState, "joint_states", 10)
        self._object = node.create_publisher(ObjectStates, "object_states", LATCHED)
        node.create_subscription(JointTrajectory, "joint_trajectory", self._on_move, COMMAND)
        node.create_timer(0.02, self._publish)

    def _on_move(self, message: JointTrajectory) -> None:
        with self._lock:
            if self.refuses:
                self._error = "joint elbow beyond its limit"
                return
            self.visits += 1
            self.joints = Joints(*message.points[-1].positions)
            self._rest = self._node.get_clock().now()
            self._visible = not self.blind and self.unseen == 0
            self.unseen = max(self.unseen - 1, 0)

    def _publish(self) -> None:
        with self._lock:
            now = self._node.get_clock().now().to_msg()
            arm = ArmState(state=ArmState.IDLE, homed=True, error_msg=self._error)
            arm.error_code = ErrorCode.TRAJECTORY_INVALID if self._error else 0
            arm.header.stamp = now
            here = JointState(name=list(Joints._fields), position=list(self.joints))
            here.header.stamp = now
            tip = CELL.file.arm.geometry().forward(self.joints)
            thought = CELL.arm_base @ Pose(tip.x + self.other_file, tip.y, tip.yaw)
            arm.tip_pose = to_message(thought, tip.z)
            held = BASE @ Pose(tip.x, tip.y, tip.yaw) @ MOUNT
            seen = ObjectState(visible=self._visible, at_rest=self._visible, frames_fused=30)
            seen.header.stamp, seen.at_rest_since = now, self._rest.to_msg()
            seen.pose.pose = to_message(held)
            self._arm.publish(arm)
            self._joints.publish(here)
            self._object.publish(ObjectStates(header=seen.header, objects=[seen]))


@pytest.fixture
def held() -> Iterator[HeldMarker]:
    with bench(list, {}) as made:
        yield HeldMarker(made)


def asked(path: Path, **options: object) -> argparse.Namespace:
    return argparse.Namespace(
        **{"record": path, "resume": False, "namespace": "", "poses": 8, "taps": 30, **options}
    )


def test_an_arm_record_is_made_resumed_and_calibrates_the_arm(
    held: HeldMarker, tmp_path: Path
) -> None:
    path = tmp_path / "poses.csv"
    assert arm_recording.record(asked(path, poses=6), CELL, QUIET)
    assert held.visits == 6
    with pytest.raises(RecordError, match="--resume"):
        arm_recording.record(asked(path), CELL, QUIET)
    held.unseen = 1
    assert arm_recording.record(asked(path, resume=True), CELL, QUIET)
    assert held.visits == 9
    record = arm_verb.record_of(read_csv(path, arm.RECORD_COLUMNS))
    assert len(record.rows) == 8
    found = calibrate_arm(record, CELL.file.arm.geometry()).values
    assert (found["base_x"], found["base_y"]) == pytest.approx((BASE.x, BASE.y), abs=1e-6)
    assert math.remainder(found["base_yaw"] - BASE.theta, math.tau) == pytest.approx(0, abs=1e-6)


def test_an_arm_that_does_not_move_stops_the_recording_with_its_own_message(
    held: HeldMarker, tmp_path: Path
) -> None:
    held.refuses = True
    with pytest.raises(CalibrationRefused, match="joint elbow beyond its limit"):
        arm_recording.record(asked(tmp_path / "poses.csv"), CELL, QUIET)


def test_a_cell_file_other_than_that_of_the_running_cell_is_refused(
    held: HeldMarker, tmp_path: Path
) -> None:
    held.other_file = 0.02
    with pytest.raises(CalibrationRefused, match="running cell's own file"):
        arm_recording.record(asked(tmp_path / "poses.csv"), CELL, QUIET)
    assert held.visits == 0


def test_a_marker_that_is_never_seen_stops_the_recording(
    held: HeldMarker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tapping_cell.nodes.clients.arm_pose_client.UNSEEN_TIMEOUT_S", 0.1)
    held.blind = True
    with pytest.raises(CalibrationRefused, match="6 consecutive postures"):
        arm_recording.record(asked(tmp_path / "poses.csv"), CELL, QUIET)
    assert (tmp_path / "poses.csv").read_text().count("\n") == 1


def test_energies_are_within_the_tapper_limits_and_shuffled_over_the_range() -> None:
    energies = tapper_recording.energies_of(CELL)
    curve = CELL.file.tapper.curve()
    assert energies == sorted(energies) and energies[-1] > 10 * energies[0]
    assert all(curve.slowest <= curve.speed_for(energy) <= curve.fastest for energy in energies)
    every = list(tapper_recording.order(energies, 30, []))
    assert tuple(Counter(every)[energy] for energy in energies) == SHARES
    # The first third of the taps already contains all energies.
    assert len(set(every[:10])) == len(SHARES)
    rest = list(tapper_recording.order(energies, 30, [1.001 * energy for energy in every[:12]]))
    assert Counter(rest) == Counter(every) - Counter(every[:12])


class ScriptedTapClient(ScriptedClient):
    """A client with scripted taps. It also provides the object's state and the camera rate, which a
    recording needs."""

    simulated = True

    @property
    def object_state(self) -> ObjectState:
        return ObjectState(object_id=CELL.object.name)

    def camera_rate(self, duration: float, check: object) -> float:
        return 30.0


def recorded(answers: list[str | int], path: Path) -> np.ndarray:
    energies = [0.001 * number for number in range(1, 4)]
    growing = GrowingCsv(path, tapper_recording.HEADER, resume=False)
    client = cast(SingleTapClient, ScriptedTapClient(answers))
    tapper_recording._make(CELL, client, energies, growing, QUIET)
    return read_csv(path, tapper.RECORD_COLUMNS).columns("energy", "distance")


def test_taps_are_recorded_with_their_travel_and_lost_taps_are_repeated(tmp_path: Path) -> None:
    answers: list[str | int] = ["ok", "lost", "ok", int(ErrorCode.OBJECT_NOT_SEEN), "miss"]
    rows = recorded(answers, tmp_path / "taps.csv")
    np.testing.assert_allclose(rows[:, 0], [0.001, 0.002, 0.003])
    np.testing.assert_allclose(rows[:, 1], [0.04, 0.04, 0.0001], rtol=1e-3)


def test_an_object_that_is_lost_repeatedly_stops_the_recording(tmp_path: Path) -> None:
    with pytest.raises(CalibrationRefused, match="4 consecutive taps are unusable"):
        recorded(["ok", *(["lost"] * 5)], tmp_path / "taps.csv")
    assert len(read_csv(tmp_path / "taps.csv", tapper.RECORD_COLUMNS).rows) == 1
