"""The node camera_pose over real DDS: from rendered images to poses, and its error reports."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time as Stamp
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from harness import TIMEOUT_S, Bench, bench
from rclpy.duration import Duration
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image, JointState
from tapping_cell_msgs.msg import ErrorCode, ObjectState, ObjectStates

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import load_object
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic.poses import covariance_from_message
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.camera.camera_pose import MAX_LATE, CameraPose
from tapping_cell.nodes.camera.dropped_frames import LONGEST_WAIT_S
from tapping_cell.nodes.camera.picture_publisher import PicturePublisher
from tapping_cell.nodes.camera.pose_messages import camera_from_message
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.conversions import from_message
from tapping_cell.se2 import Pose
from tapping_cell.simulation.arm_drawing import ArmDrawing
from tapping_cell.simulation.rendered_camera import Occluder, SceneRenderer
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.truth import CameraTruth
from tapping_cell.vision import View

TRUE = Pose(0.06, -0.04, 0.8)
TRIES = 20
"""Maximum number of repetitions: images are sent best-effort, so some may be lost."""


@dataclass
class Cell:
    """The node under test, and publishers that replace the camera."""

    bench: Bench
    states: list[ObjectState]
    poses: list[PoseWithCovarianceStamped]
    renderer: SceneRenderer

    def __post_init__(self) -> None:
        assert self.bench.probe is not None
        self.node = self.bench.probe
        create = self.node.create_publisher
        self.images = create(Image, "camera/image_raw", qos_profile_sensor_data)
        self.infos = create(CameraInfo, "camera/camera_info", qos_profile_sensor_data)
        self.info = images.to_camera_info(load_cell().camera)
        self.bench.wait(
            lambda: (
                self.images.get_subscription_count() == 1
                and self.infos.get_subscription_count() == 1
            ),
            "the node listens",
        )
        # The stamps advance at the camera's rate regardless of the machine's speed, starting half a
        # minute ago.
        self.stamp = self.node.get_clock().now() - Duration(seconds=30.0)

    def publish(self, picture: Image, stamp: Time) -> None:
        """Publish an image with its calibration, without waiting for its reception."""
        self.info.header.stamp = picture.header.stamp = stamp.to_msg()
        self.infos.publish(self.info)
        self.images.publish(picture)

    def send(self, picture: Image) -> ObjectState:
        """Send an image, again if it is lost, and return the state that the node publishes for
        it."""
        stamps = []
        for _ in range(TRIES):
            self.stamp += Duration(seconds=1 / 30)
            self.publish(picture, self.stamp)
            stamps.append(self.stamp.to_msg())
            deadline = time.monotonic() + 1.0
            while time.monotonic() < deadline:
                for state in reversed(self.states):
                    if state.header.stamp in stamps:
                        return state
                time.sleep(0.002)
        raise AssertionError(f"none of {TRIES} pictures was answered")

    def show(self, frames: int, pose: Pose = TRUE) -> list[ObjectState]:
        """Return the states published for ``frames`` images of the object at a pose."""
        return [
            self.send(images.to_message(self.renderer.render(pose), "mono8")) for _ in range(frames)
        ]


@pytest.fixture
def cell() -> Iterator[Cell]:
    configuration = load_cell()
    outline = np.asarray(configuration.outline())
    renderer = make_renderer(configuration, CameraTruth(), outline, 1)
    with bench(lambda: [CameraPose()], {}) as b:
        states = b.listen_own_object()
        poses = b.listen(PoseWithCovarianceStamped, "object_pose")
        yield Cell(b, states, poses, renderer)


def test_an_object_at_rest_is_measured_and_every_image_gets_a_result(cell: Cell) -> None:
    answers = cell.show(60)
    seen = sum(state.visible for state in answers)
    assert seen >= 58
    cell.bench.wait(lambda: len(cell.poses) >= seen, f"a pose for each of {seen} looks")
    last = answers[-1]
    assert last.at_rest
    assert last.header.frame_id == "table" and last.object_id == "aluminium disk"
    assert last.frames_fused >= 10 and len(last.references_used) >= 2
    measured = from_message(last.pose.pose)
    assert measured.distance_to(TRUE) < 0.0001
    assert abs(measured.rotation_to(TRUE)) < math.radians(0.1)
    deviation = np.sqrt(np.diag(covariance_from_message(last.pose.covariance)))
    assert np.all(deviation > 0) and deviation[0] < 0.0002


def test_the_camera_pose_maps_a_pixel_to_a_table_position(cell: Cell) -> None:
    received = cell.bench.listen(PoseStamped, "camera/pose", LATCHED)
    cell.show(20)
    cell.bench.wait(lambda: received, "camera/pose")
    assert received[-1].header.frame_id == "table"
    view = View(load_cell().camera, camera_from_message(received[-1].pose))
    height = load_cell().object.height
    pixel = cell.renderer.view.project([TRUE.x, TRUE.y], height)
    assert np.hypot(*(view.on_plane(pixel, height) - (TRUE.x, TRUE.y))) < 0.001


def test_a_moving_object_is_not_reported_at_rest(cell: Cell) -> None:
    cell.show(30)
    moving = [cell.show(1, TRUE @ Pose(0.0005 * step, 0.0, 0.0))[0] for step in range(20)]
    assert not any(state.at_rest for state in moving[4:])


@pytest.mark.parametrize("problem", ["encoding", "size", "bytes"])
def test_an_unusable_image_is_refused_with_a_message(cell: Cell, problem: str) -> None:
    cell.show(5)
    picture = images.to_message(cell.renderer.render(TRUE), "mono8")
    if problem == "encoding":
        picture.encoding = "32FC1"
    elif problem == "size":
        picture = images.to_message(cell.renderer.render(TRUE)[:480, :640].copy(), "mono8")
    else:
        picture.data = picture.data[:1000]
    refused = cell.send(picture)
    assert refused.error_code == ErrorCode.IMAGE_INVALID
    assert not refused.visible and len(refused.error_msg) > 20


def test_a_camera_timeout_is_reported_and_recovers(cell: Cell) -> None:
    cell.show(10)
    cell.bench.wait(
        lambda: cell.states and cell.states[-1].error_code == ErrorCode.CAMERA_SILENT,
        "silence noticed",
    )
    assert not cell.states[-1].visible
    assert cell.show(10)[-1].visible


def test_an_uncalibrated_camera_is_refused(cell: Cell) -> None:
    cell.info.k = [0.0] * 9
    assert cell.show(5)[-1].error_code == ErrorCode.CAMERA_NOT_CALIBRATED


def test_images_without_a_calibration_are_refused_with_a_message(cell: Cell) -> None:
    picture = images.to_message(cell.renderer.render(TRUE), "mono8")

    def answered() -> list[str]:
        picture.header.stamp = cell.node.get_clock().now().to_msg()
        cell.images.publish(picture)
        code = ErrorCode.CAMERA_NOT_CALIBRATED
        return [state.error_msg for state in cell.states if state.error_code == code]

    cell.bench.wait(answered, "answered")
    assert "camera/camera_info" in answered()[0]


def test_a_future_stamp_is_refused_without_side_effects(cell: Cell) -> None:
    cell.show(5)
    past, cell.stamp = cell.stamp, cell.node.get_clock().now() + Duration(seconds=60.0)
    picture = images.to_message(cell.renderer.render(TRUE), "mono8")
    assert cell.send(picture).error_code == ErrorCode.STAMP_INVALID
    cell.stamp = past
    assert cell.show(10)[-1].visible


def test_a_clock_that_was_set_back_is_detected(cell: Cell) -> None:
    assert cell.show(10)[-1].visible
    cell.stamp -= Duration(seconds=3600.0)
    answers = cell.show(40)
    assert answers[0].error_code == ErrorCode.STAMP_INVALID
    assert answers[-1].visible


def test_no_image_is_used_again_while_the_clock_of_the_camera_stands(cell: Cell) -> None:
    assert cell.show(10)[-1].visible
    picture = images.to_message(cell.renderer.render(TRUE), "mono8")
    before = len(cell.states)

    def answered(frames: int) -> bool:
        cell.publish(picture, cell.stamp)
        return len(cell.states) >= before + frames

    cell.bench.wait(lambda: answered(2 * MAX_LATE), "the images are answered")
    assert {state.error_code for state in cell.states[before:]} == {ErrorCode.STAMP_INVALID}
    assert cell.show(10)[-1].visible


def test_a_calibration_for_another_resolution_is_refused(cell: Cell) -> None:
    half = load_cell().camera
    cell.info = images.to_camera_info(replace(half, width=640, height=512))
    last = cell.show(5)[-1]
    assert last.error_code == ErrorCode.IMAGE_INVALID
    assert "640 x 512" in last.error_msg


@pytest.mark.parametrize("problem", ["binning", "region of interest"])
def test_a_calibration_for_other_pixels_is_refused(cell: Cell, problem: str) -> None:
    if problem == "binning":
        cell.info.binning_x = cell.info.binning_y = 2
    else:
        cell.info.roi.x_offset, cell.info.roi.width, cell.info.roi.height = 100, 640, 480
    last = cell.show(5)[-1]
    assert last.error_code == ErrorCode.CAMERA_NOT_CALIBRATED
    assert problem in last.error_msg


def test_an_occluded_reference_is_reported_in_the_diagnostics(cell: Cell) -> None:
    received = cell.bench.listen(DiagnosticArray, "/diagnostics")
    cell.show(20)
    marker = load_cell().references.markers[0]
    corners = 0.03 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) + [marker.x, marker.y]
    cover = Occluder(np.column_stack([corners, np.full(4, 0.01)]))
    words = f"reference marker {marker.id} is not seen"

    def reported() -> bool:
        picture = images.to_message(cell.renderer.render(TRUE, occluders=[cover]), "mono8")
        assert cell.send(picture).visible
        return any(words in status.message for array in received for status in array.status)

    cell.bench.wait(reported, words)


def test_occluded_references_are_reported_in_the_state(cell: Cell) -> None:
    covers = []
    for marker in load_cell().references.markers:
        corners = 0.04 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) + [marker.x, marker.y]
        covers.append(Occluder(np.column_stack([corners, np.full(4, 0.01)])))

    def reported() -> bool:
        picture = cell.renderer.render(TRUE, occluders=covers)
        state = cell.send(images.to_message(picture, "mono8"))
        assert not state.visible
        return state.error_code == ErrorCode.REFERENCES_NOT_SEEN and "reference" in state.error_msg

    cell.bench.wait(reported, "the references are missing")


def test_a_second_copy_of_the_object_marker_is_reported_in_the_state(cell: Cell) -> None:
    places = cell.renderer.view.project([[TRUE.x, TRUE.y], [-TRUE.x, -TRUE.y]], 0.012)
    (x, y), (left, top) = np.rint(places).astype(int)

    def reported() -> bool:
        picture = cell.renderer.render(TRUE)
        marker = picture[y - 60 : y + 60, x - 60 : x + 60]
        picture[top - 60 : top + 60, left - 60 : left + 60] = marker
        state = cell.send(images.to_message(picture, "mono8"))
        assert not state.visible
        return state.error_code == ErrorCode.MARKER_AMBIGUOUS and "marker" in state.error_msg

    cell.bench.wait(reported, "the marker is seen twice")


def test_two_objects_in_one_image() -> None:
    """The images contain the cell's object and, pasted into them, another object."""
    folder = shared_folder() / "objects"
    plain = load_object(folder / "plain_disk_with_dot.yaml")
    configuration = load_cell()
    first = make_renderer(configuration, CameraTruth(), configuration.outline(), 1)
    second = SceneRenderer(
        first.view.camera,
        first.view.pose,
        configuration.references,
        configuration.outline(),
        plain.seen(),
        first.settings,
        seed=2,
    )
    other = Pose(-0.15, 0.08, -0.5)
    given = {"camera_pose": {"other_object_files": folder / "plain_disk_with_dot.yaml"}}
    with bench(lambda: [CameraPose()], given) as b:
        states = b.listen_own_object()
        every = b.listen(ObjectStates, "object_states", LATCHED)
        cell = Cell(b, states, [], first)
        middle = int(first.view.project([(TRUE.x + other.x) / 2, 0.0])[0])
        for _ in range(60):
            picture = first.render(TRUE)
            picture[:, :middle] = second.render(other)[:, :middle]
            last = cell.send(images.to_message(picture, "mono8"))
        b.wait(lambda: every[-1].objects[1].visible, "the other object")
    assert last.visible
    assert from_message(last.pose.pose).distance_to(TRUE) < 0.0001
    found = every[-1].objects[1]
    assert found.object_id == "plain disk with dot"
    seen = from_message(found.pose.pose)
    assert seen.distance_to(other) < 0.0001 and abs(seen.rotation_to(other)) < math.radians(0.2)


def test_old_queued_images_are_skipped_for_the_newest(cell: Cell) -> None:
    assert cell.show(10)[-1].visible
    held, release = threading.Event(), threading.Event()
    stamps: list[Stamp] = []

    def hold() -> None:
        timer.cancel()
        held.set()
        release.wait(TIMEOUT_S)

    def answers() -> list[Stamp]:
        return [state.header.stamp for state in cell.states if state.header.stamp in stamps]

    # Block the executor of the node, as a busy machine does, so that images queue up.
    for _ in range(TRIES):
        held.clear()
        release.clear()
        stamps.clear()
        timer = cell.node.create_timer(0.0, hold)
        assert held.wait(TIMEOUT_S)
        for _ in range(8):
            cell.stamp += Duration(seconds=1 / 30)
            cell.publish(images.to_message(cell.renderer.render(TRUE), "mono8"), cell.stamp)
            stamps.append(cell.stamp.to_msg())
        time.sleep(2.0 * LONGEST_WAIT_S)
        release.set()
        cell.bench.wait(answers, "an answer")
        if answers()[0] == stamps[-1]:
            break
    else:
        # A single image may be lost, but the last image is unlikely to be lost in every attempt.
        raise AssertionError(f"none of {TRIES} times was the newest picture answered first")
    assert cell.show(5)[-1].visible


def test_compressed_images_are_measured() -> None:
    configuration = load_cell()
    renderer = make_renderer(configuration, CameraTruth(), np.asarray(configuration.outline()), 1)
    with bench(lambda: [CameraPose()], {"camera_pose": {"image_transport": "compressed"}}) as b:
        assert b.probe is not None
        states = b.listen_own_object()
        publisher = PicturePublisher(b.probe, 95)
        b.wait(publisher.subscribers, "the node listens")
        info = images.to_camera_info(configuration.camera)
        stamp = b.probe.get_clock().now() - Duration(seconds=5.0)
        for number in range(40):
            stamp += Duration(seconds=1 / 30)
            picture = images.to_message(renderer.render(TRUE), "mono8")
            picture.header.stamp = stamp.to_msg()
            received = len(states)
            publisher.publish(picture, info)
            b.wait(
                lambda received=received: len(states) > received, f"picture {number} is answered"
            )
    measured = from_message(states[-1].pose.pose)
    assert states[-1].at_rest and states[-1].frames_fused >= 10
    assert measured.distance_to(TRUE) < 0.0001
    assert abs(measured.rotation_to(TRUE)) < math.radians(0.1)


def test_what_the_arm_hides_is_no_problem(cell: Cell) -> None:
    """The arm covers the object and a reference marker. Without its joints, this is a problem."""
    configuration = load_cell()
    arm = configuration.arm
    tip = configuration.arm_base.inverse() @ TRUE @ Pose(-0.07, 0.0, 0.0)
    joints = arm.geometry().inverse((tip.x, tip.y, arm.strike_height, tip.theta)).joints
    assert joints is not None
    drawing = ArmDrawing(arm, configuration.file.tapper, configuration.arm_base).at(joints)
    corners = [[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, -1.0, 0.0]]
    hand = Occluder(np.array([TRUE.x, TRUE.y, 0.02]) + 0.04 * np.array(corners))
    cell.show(4)

    def covered() -> ObjectState:
        for _ in range(8):
            image = cell.renderer.render(TRUE, occluders=(hand,), drawings=(drawing,))
            state = cell.send(images.to_message(image, "mono8"))
        return state

    state = covered()
    assert not state.visible and state.error_code == ErrorCode.OBJECT_NOT_SEEN
    health = cell.bench.listen(DiagnosticArray, "/diagnostics")
    publisher = cell.node.create_publisher(JointState, "joint_states", 10)
    cell.bench.wait(lambda: publisher.get_subscription_count() > 0, "the node listens")
    message = JointState(name=list(Joints._fields), position=[float(each) for each in joints])
    for _ in range(TRIES):
        publisher.publish(message)
        # Joints of another robot on the same topic change nothing.
        publisher.publish(JointState(name=["wheel"], position=[1.0]))
        state = covered()
        if not state.error_code:
            break
    assert (state.visible, state.error_code, state.error_msg) == (False, ErrorCode.NONE, "")
    health.clear()
    for _ in range(TRIES):
        covered()
        if len(health) > 1:
            break
    assert health[-1].status[0].level == DiagnosticStatus.OK, health[-1].status[0].message
    assert cell.show(4)[-1].visible
