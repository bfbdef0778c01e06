"""Frames on /tf, and goals in frames other than ``table``, checked with the real tf2."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time as Stamp
from geometry_msgs.msg import PoseStamped
from harness import Bench, bench
from rclpy.time import Time
from tapping_cell_msgs.msg import ArmState, ErrorCode, GoalReport, PlanState
from test_camera_pose import TRUE
from test_camera_pose import Cell as CameraCell
from test_scara_arm import arm_cell
from test_tap_planner import FAST, Actors

from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.link_frames import LINKS
from tapping_cell.hardware.scara import Joints
from tapping_cell.nodes.camera.camera_pose import CameraPose
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.conversions import from_message, to_message
from tapping_cell.nodes.frame_broadcaster import FrameBroadcaster, transform
from tapping_cell.nodes.planner.tap_planner import TapPlanner
from tapping_cell.se2 import Pose
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.truth import CameraTruth

tf2_ros = pytest.importorskip("tf2_ros", reason="tf2_ros is not installed; apt's ROS has it")


class Listener:
    """A tf2 buffer that receives the transforms published by the nodes under test."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, bench.probe)

    def wait(self, parent: str, child: str, at: Time | None = None) -> tuple[float, ...]:
        """Return x, y, z and yaw of ``child`` in ``parent`` as soon as the transform is
        available."""
        time = at or Time()
        self._bench.wait(
            lambda: self._buffer.can_transform(parent, child, time), f"{child} in {parent}"
        )
        found = self._buffer.lookup_transform(parent, child, time).transform
        place, q = found.translation, found.rotation
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        return place.x, place.y, place.z, yaw


def test_the_striker_is_where_the_joints_put_it(tmp_path: Path) -> None:
    with arm_cell(tmp_path) as cell:
        listener = Listener(cell.bench)
        cell.wait_state(ArmState.IDLE)
        cell.command(100)
        cell.wait_state(ArmState.IN_POSITION)
        arrived = Time.from_msg(cell.last.header.stamp)
        cell.bench.wait(
            lambda: Time.from_msg(cell.joints[-1].header.stamp) >= arrived, "joints at the strike"
        )
        arm = load_cell().file.arm
        state = cell.joints[-1]
        tip = arm.geometry().forward(Joints(*state.position))
        at = Time.from_msg(state.header.stamp)
        found = listener.wait(LINKS[0], "striker", at)
        assert found[:3] == pytest.approx(tip[:3], abs=1e-9)
        assert math.remainder(found[3] - tip.yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
        base = listener.wait("table", LINKS[0])
        assert base == pytest.approx((arm.base[0], arm.base[1], 0.0, arm.base[2]), abs=1e-9)
        assert listener.wait("table", "striker", at)[2] == pytest.approx(
            arm.strike_height, abs=1e-3
        )


def test_link_transforms_are_left_to_robot_state_publisher(tmp_path: Path) -> None:
    with arm_cell(tmp_path, link_frames=False) as cell:
        cell.wait_state(ArmState.IDLE)
        cell.bench.wait(lambda: cell.joints, "joint states")
        probe = cell.node
        assert not probe.get_publishers_info_by_topic("/tf")
        assert len(probe.get_publishers_info_by_topic("/tf_static")) == 1
        Listener(cell.bench).wait("table", LINKS[0])


def test_camera_and_object_frames_are_published_on_tf() -> None:
    configuration = load_cell()
    outline = np.asarray(configuration.outline())
    renderer = make_renderer(configuration, CameraTruth(), outline, 1)
    with bench(lambda: [CameraPose()], {}) as b:
        listener = Listener(b)
        cell = CameraCell(b, b.listen_own_object(), [], renderer)
        last = cell.show(30)[-1]
        at = Time.from_msg(last.header.stamp)
        found = listener.wait("table", "object", at)
        seen = last.pose.pose
        assert found == pytest.approx((*from_message(seen)[:2], 0.0, TRUE.theta), abs=2e-3)
        camera = listener.wait("table", "camera_optical")
        assert camera[:3] == pytest.approx(tuple(renderer.view.pose.position), abs=2e-3)


@pytest.fixture
def actors() -> Iterator[tuple[Actors, FrameBroadcaster]]:
    with bench(lambda: [TapPlanner()], {"tap_planner": FAST}) as b:
        made = Actors(b)
        assert b.probe is not None
        yield made, FrameBroadcaster(b.probe)


FIXTURE = Pose(0.1, -0.05, 0.7)
IN_FIXTURE = Pose(-0.12, 0.08, -0.5)


def goal(frame: str, pose: Pose, stamp: Stamp | None = None) -> PoseStamped:
    message = PoseStamped(pose=to_message(pose))
    message.header.frame_id = frame
    if stamp is not None:
        message.header.stamp = stamp
    return message


def send_until(actors: Actors, message: PoseStamped, done: Any) -> None:
    """Publish the goal repeatedly until ``done()`` is true. Transforms and goals use different
    topics, so the frame of the goal may not be known when the first goal arrives."""
    actors.bench.wait(lambda: actors.goals.get_subscription_count() == 2, "the planner is up")

    def sent() -> bool:
        actors.goals.publish(message)
        try:
            actors.bench.wait(done, "an answer", 1.0)
        except AssertionError:
            return False
        return True

    actors.bench.wait(sent, "the goal is answered")


@pytest.mark.parametrize("frame", ["fixture", "corner"])
def test_a_goal_in_a_connected_frame_is_reached_on_the_table(
    actors: tuple[Actors, FrameBroadcaster], frame: str
) -> None:
    played, broadcaster = actors
    stamp = Stamp()
    between = Pose(0.02, 0.01, -0.3)
    broadcaster.send_fixed(
        [
            transform("table", "fixture", to_message(FIXTURE), stamp),
            transform("fixture", "corner", to_message(between), stamp),
        ]
    )
    place = FIXTURE if frame == "fixture" else FIXTURE @ between
    wanted = place @ IN_FIXTURE
    accepted = (PlanState.WAITING_FOR_CELL, PlanState.LOOKING, PlanState.PLACING)
    send_until(
        played, goal(frame, IN_FIXTURE), lambda: played.plans and played.plans[-1].state in accepted
    )
    taken = played.plans[-1].goal
    assert taken.header.frame_id == "table"
    assert tuple(from_message(taken.pose)) == pytest.approx(tuple(wanted), abs=1e-9)
    end = played.end()
    assert end.state == PlanState.REACHED, end.error_msg
    assert played.pose.distance_to(wanted) < 1e-3


def test_an_unknown_frame_is_refused_with_the_known_frames(
    actors: tuple[Actors, FrameBroadcaster],
) -> None:
    played, broadcaster = actors
    reports = played.bench.listen(GoalReport, "goal_report", LATCHED)
    stamp = Stamp()
    broadcaster.send_fixed(
        [
            transform("table", "fixture", to_message(FIXTURE), stamp),
            transform("map", "elsewhere", to_message(FIXTURE), stamp),
        ]
    )
    send_until(
        played,
        goal("elsewhere", IN_FIXTURE),
        lambda: reports and "use one of table, fixture" in reports[-1].error_msg,
    )
    assert reports[-1].error_code == ErrorCode.GOAL_WRONG_FRAME
    assert "'elsewhere'" in reports[-1].error_msg


def test_a_goal_in_a_frame_that_moved_is_refused_with_its_times(
    actors: tuple[Actors, FrameBroadcaster],
) -> None:
    played, broadcaster = actors
    assert played.bench.probe is not None
    reports = played.bench.listen(GoalReport, "goal_report", LATCHED)
    now = played.bench.probe.get_clock().now()
    long_ago = Time(nanoseconds=now.nanoseconds - 20_000_000_000).to_msg()
    message = goal("tray", IN_FIXTURE, now.to_msg())

    def answered() -> bool:
        broadcaster.send([transform("table", "tray", to_message(FIXTURE), long_ago)])
        return (
            bool(reports)
            and "'tray'" in reports[-1].error_msg
            and ("extrapolation" in reports[-1].error_msg)
        )

    send_until(played, message, answered)
    assert reports[-1].error_code == ErrorCode.GOAL_WRONG_FRAME
