"""Pose measurement node: receives images and publishes the object's pose with its covariance.

The other objects of the cell (key ``objects`` of the cell file, parameter ``other_object_files``)
are usually measured in turn, at most one per image. However, the object that ``plan_state`` names
and every object that moved recently are measured in every image. While the planner waits for
observations, all objects are measured in every image. The latest states of
all objects are published on ``object_states``, and the outlines of the objects that no object file
describes on ``unknown_objects``.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from tapping_cell_msgs.msg import ErrorCode, ObjectState, ObjectStates, PlanState, UnknownObjects

from tapping_cell.configuration.cell import Cell, load_further_objects
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.configuration.schema import choice, quantity, text
from tapping_cell.logic.frames import TABLE
from tapping_cell.logic.poses import covariance_to_message
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.camera.annotated_images import AnnotatedImages
from tapping_cell.nodes.camera.arm_view import ArmView
from tapping_cell.nodes.camera.detections import DetectionPublisher
from tapping_cell.nodes.camera.dropped_frames import Backlog
from tapping_cell.nodes.camera.pose_messages import camera_to_message
from tapping_cell.nodes.camera.unknown_search import UnknownSearch
from tapping_cell.nodes.cell_node import LATCHED, CellNode, run
from tapping_cell.nodes.cell_parameters import ObjectParameters
from tapping_cell.nodes.conversions import from_message, seconds, to_message
from tapping_cell.nodes.frame_broadcaster import FrameBroadcaster, transform
from tapping_cell.se2 import Pose
from tapping_cell.vision import (
    CameraError,
    CameraModel,
    Observation,
    PoseTracker,
    Problem,
    RoundRobin,
    TrackerSettings,
    marker_ids,
)
from tapping_cell.vision.annotate import annotate
from tapping_cell.vision.images import GreyImage, ImageRefused

CODES = {
    Problem.NONE: ErrorCode.NONE,
    Problem.WRONG_IMAGE: ErrorCode.IMAGE_INVALID,
    Problem.LATE_FRAME: ErrorCode.STAMP_INVALID,
    Problem.FROZEN_FRAME: ErrorCode.IMAGE_INVALID,
    Problem.DARK: ErrorCode.IMAGE_INVALID,
    Problem.OVEREXPOSED: ErrorCode.IMAGE_INVALID,
    Problem.TABLE_UNKNOWN: ErrorCode.REFERENCES_NOT_SEEN,
    Problem.TABLE_CONTRADICTED: ErrorCode.CAMERA_MOVED,
    Problem.REFERENCES_HIDDEN: ErrorCode.REFERENCES_NOT_SEEN,
    Problem.CAMERA_MOVED: ErrorCode.CAMERA_MOVED,
    Problem.CAMERA_MOVED_TOO_FAR: ErrorCode.CAMERA_MOVED,
    Problem.OBJECT_HIDDEN: ErrorCode.OBJECT_NOT_SEEN,
    Problem.WRONG_MARKER: ErrorCode.OBJECT_NOT_SEEN,
    Problem.DUPLICATE_MARKER: ErrorCode.MARKER_AMBIGUOUS,
    Problem.MIRRORED_MARKER: ErrorCode.OBJECT_NOT_SEEN,
    Problem.MISSHAPEN_MARKER: ErrorCode.OBJECT_NOT_SEEN,
    Problem.DUPLICATE_OBJECT: ErrorCode.MARKER_AMBIGUOUS,
    Problem.MISSHAPEN_OBJECT: ErrorCode.OBJECT_NOT_SEEN,
    Problem.WRONG_OBJECT: ErrorCode.OBJECT_NOT_SEEN,
    Problem.DOT_HIDDEN: ErrorCode.OBJECT_NOT_SEEN,
}
TABLE_SEEN = (ErrorCode.NONE, ErrorCode.OBJECT_NOT_SEEN, ErrorCode.MARKER_AMBIGUOUS)
"""Error codes of object states for which the table was located in the image."""

REFERENCE_PATIENCE_S = 4.0
"""Time after which a missing reference marker is reported in a cell with an arm, s; longer than a
marker is hidden during a tap. The positions of a moving arm arrive late, and are unknown before
the arm is homed."""
WATCH_PERIOD_S = 0.05
"""Period of the check for missing images."""
MISSED_LOG_PERIOD = 5
"""Number of checks without a new image between two reports of a silent camera."""
CAMERA_PERIOD_S = 1.0
"""Period at which the camera pose is published."""
STAMP_AHEAD_S = 1.0
"""Maximum time by which an image stamp may be ahead of this node's clock."""
MAX_LATE = 15
"""Number of consecutive images, each older than the last accepted image, after which tracking
restarts. These images span about half a second; messages are not reordered over so long a time."""


@dataclass(frozen=True, slots=True)
class Parameters(ObjectParameters):
    """Parameters of camera_pose."""

    other_object_files: str = text(
        "paths of the object files of additional objects on the table, separated by commas",
        default="",
    )
    search_unknown_objects: bool = text(
        "search for objects without an object file, which the planner avoids (only with an arm)",
        default=True,
    )
    silence_limit: float = quantity(
        "time without an image after which the camera is reported as silent",
        "s",
        0.1,
        60.0,
        default=0.4,
    )
    annotated_rate: float = quantity(
        "maximum rate of camera/image_annotated, which is published only while it has subscribers",
        "Hz",
        0.1,
        60.0,
        default=10.0,
    )
    compressed_rate: float = quantity(
        "maximum rate of camera/image_annotated/compressed, which is published only while it has "
        "subscribers, such as run_recorder",
        "Hz",
        0.1,
        60.0,
        default=1.0,
    )
    compressed_width: int = quantity(
        "maximum width of camera/image_annotated/compressed", "pixels", 160, 4096, default=960
    )
    image_transport: str = choice(
        "raw: camera/image_raw; compressed: camera/image_raw/compressed, for a camera on another "
        "computer",
        "raw",
        "compressed",
        default="raw",
    )


class CameraPose(CellNode[Parameters]):
    """See the module's docstring."""

    def __init__(self) -> None:
        super().__init__("camera_pose", Parameters)
        self._cell: Cell | None = None
        self._other_files: tuple[ObjectFile, ...] = ()
        self._turns = RoundRobin(0)
        self._tracker: PoseTracker | None = None
        self._arm: ArmView | None = None
        self._unknown: UnknownSearch | None = None
        self._camera: CameraModel | None = None
        self._calibration: tuple[object, ...] = ()
        self._camera_problem = ""
        self._bits = 8
        self._late = 0
        self._late_stamp = 0.0
        self._unanswered_since = 0.0
        self._goal: Pose | None = None
        self._tapped = ""
        self._awaited = False
        self._other_states: list[ObjectState] = []
        self._seen_at: dict[str, Pose] = {}
        self._received = time.monotonic()
        self._missed = 0
        self._camera_published_at = 0.0
        self._backlog = Backlog()
        self._frames = 0
        self._busy_seconds = 0.0
        self._last = ObjectState()
        self._notice = ""
        self._pose_publisher = self.create_publisher(PoseWithCovarianceStamped, "object_pose", 10)
        self._states_publisher = self.create_publisher(ObjectStates, "object_states", LATCHED)
        self._unknown_publisher = self.create_publisher(UnknownObjects, "unknown_objects", LATCHED)
        self._detections = DetectionPublisher(self)
        self._camera_publisher = self.create_publisher(PoseStamped, "camera/pose", LATCHED)
        self._annotated = AnnotatedImages(
            self,
            self.settings.annotated_rate,
            self.settings.compressed_rate,
            self.settings.compressed_width,
        )
        self._broadcaster = FrameBroadcaster(self)
        self.create_subscription(
            CameraInfo, "camera/camera_info", self._on_camera_info, images.PICTURES
        )
        compressed = self.settings.image_transport == "compressed"
        self._picture_type = CompressedImage if compressed else Image
        self._picture_topic = images.COMPRESSED if compressed else images.RAW
        self._pictures = self.create_subscription(
            self._picture_type,
            self._picture_topic,
            # The callback has a second argument, the message info of the middleware. rclpy supports
            # this argument at run time, but not in its type annotations.
            cast(Callable[[Image], None], self._on_image),
            images.COMPRESSED_PICTURES if compressed else images.PICTURES,
        )
        self.create_subscription(PlanState, "plan_state", self._on_plan_state, LATCHED)
        self.create_timer(WATCH_PERIOD_S, self._watch)

    def configure(self) -> None:
        """Read the cell, table and object files."""
        self._cell = self.settings.load_cell()
        self._other_files = load_further_objects(self._cell, self.settings.other_object_files)
        self._other_states = [ObjectState(object_id=file.name) for file in self._other_files]
        for state in self._other_states:
            state.header.frame_id = TABLE
        self._camera, self._calibration, self._bits = None, (), 8
        self._seen_at.clear()
        if self._cell.file.arm is not None:
            self._arm = ArmView(self, self._cell)
            if self.settings.search_unknown_objects:
                self._unknown = UnknownSearch(
                    self, self._cell, self._other_files, self._arm, self._unknown_publisher
                )

    def cleanup(self) -> None:
        """Discard the track and the unknown objects."""
        self._tracker = None
        if self._unknown is not None:
            self._unknown.close()
        if self._arm is not None:
            self._arm.close()
        self._arm = self._unknown = None

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Report the number of processed images and the current error."""
        values: dict[str, object] = {
            "pictures": self._frames,
            "dropped frames": self._backlog.passed_over,
            "milliseconds a picture": f"{1000 * self._busy_seconds / max(1, self._frames):.2f}",
        }
        warning = self._last.error_msg or self._notice or self._backlog.sentence
        if self._last.error_code or warning:
            return DiagnosticStatus.WARN, warning, values
        return DiagnosticStatus.OK, "ok", values

    def _on_plan_state(self, message: PlanState) -> None:
        busy = message.state not in (PlanState.IDLE, PlanState.CANCELED)
        self._tapped = message.object_id if busy else ""
        self._awaited = message.state == PlanState.LOOKING
        self._goal = from_message(message.goal.pose) if busy else None

    def _on_camera_info(self, message: CameraInfo) -> None:
        if not self.active or self._cell is None:
            return
        calibration = images.calibration_of(message)
        if calibration == self._calibration:
            return
        self._calibration = calibration
        try:
            camera = images.from_camera_info(message)
        except CameraError as error:
            self._camera_problem = str(error)
            self._tracker = self._camera = None
            return
        if camera == self._cell.camera:
            # Only the calibration file states standard deviations; camera_info has no field for
            # them.
            camera = self._cell.camera
        self._camera_problem = ""
        self._camera = camera
        self._make_trackers(camera, self._cell)

    def _make_trackers(self, camera: CameraModel, cell: Cell) -> None:
        seen, others = cell.object.seen(), [file.seen() for file in self._other_files]
        settings = TrackerSettings(other_ids=marker_ids([seen, *others]))
        self._late = 0
        self._tracker = PoseTracker(
            camera,
            cell.references,
            seen,
            settings,
            others,
            self._hidden_references,
            0.0 if self._arm is None else REFERENCE_PATIENCE_S,
        )
        self._turns = RoundRobin(len(others))

    def _on_image(self, message: Image, info: dict[str, int]) -> None:
        self._received = time.monotonic()
        if not self.active:
            return
        self._answer(self._newest(message, info))
        self._backlog.processed(time.time())

    def _newest(self, message: Image, info: dict[str, int]) -> Image:
        """Return ``message``, or a newer image from the queue if ``message`` is stale (see
        ``Backlog``)."""
        self._backlog.arrived(_arrival(info))
        while self._backlog.stale(time.time()):
            with self._pictures.handle:
                taken = self._pictures.handle.take_message(self._picture_type, False)
            if taken is None:
                break
            self._backlog.passed_over += 1
            message, info = taken
            self._backlog.arrived(_arrival(info))
        return message

    def _answer(self, message: Image) -> None:
        began = time.perf_counter()
        if self._tracker is None:
            self._report_no_camera(message)
            return
        stamp = seconds(message.header.stamp)
        if problem := self._problem_of_stamp(stamp):
            self._refuse(message, ErrorCode.STAMP_INVALID, problem)
            return
        assert self._camera is not None
        try:
            image = images.read(message, (self._camera.width, self._camera.height), self._bits)
        except ImageRefused as error:
            self._refuse(message, ErrorCode.IMAGE_INVALID, str(error))
            return
        self._note_depth(image)
        grey = image.pixels
        tapped = [n for n, file in enumerate(self._other_files) if file.name == self._tapped]
        due = self._turns.due(stamp, range(len(self._other_files)) if self._awaited else tapped)
        observation, others = self._tracker.update_several(
            grey, stamp, due, every_frame=self._awaited
        )
        sentence = image.explain(observation.sentence, observation.visible)
        observation = self._explained(self._cell_object, replace(observation, sentence=sentence))
        others = {n: self._explained(self._other_files[n], one) for n, one in others.items()}
        self._publish(message, observation, others)
        self._count_late(observation, stamp)
        self._publish_camera(message)
        self._search_unknown(grey, stamp)
        self._frames += 1
        self._busy_seconds += time.perf_counter() - began
        shown = next(((self._other_files[n], others[n]) for n in tapped if n in others), None)
        self._annotate(message, grey, *(shown or (self._cell_object, observation)))

    @property
    def _cell_object(self) -> ObjectFile:
        assert self._cell is not None
        return self._cell.object

    def _hidden_references(self) -> Collection[int]:
        """Return the ids of the reference markers that the arm may hide."""
        if self._arm is None or self._tracker is None or self._cell is None:
            return ()
        markers = self._cell.references.markers
        places = [(marker.x, marker.y, 0.0) for marker in markers]
        radii = [marker.size / math.sqrt(2.0) for marker in markers]
        hidden = self._arm.hides(self._tracker.view, places, radii)
        return [marker.id for marker, gone in zip(markers, hidden, strict=True) if gone]

    def _explained(self, file: ObjectFile, seen: Observation) -> Observation:
        """Return an observation without a problem if the arm hides the place where the object was
        seen last."""
        if seen.pose is not None:
            self._seen_at[file.name] = seen.pose
        last = self._seen_at.get(file.name)
        if CODES[seen.problem] != ErrorCode.OBJECT_NOT_SEEN or last is None or self._arm is None:
            return seen
        assert self._tracker is not None
        place = [(last.x, last.y, file.height)]
        if not self._arm.hides(self._tracker.view, place, [file.shape.reach()])[0]:
            return seen
        return replace(seen, problem=Problem.NONE, sentence="the arm hides the object")

    def _note_depth(self, image: GreyImage) -> None:
        """Log how many bits of 16 hold the image. The number never decreases while the node is
        configured, so that a dark image does not change the brightness of later ones."""
        if image.bits != self._bits:
            self.get_logger().info(f"the camera's images have {image.depth}")
            self._bits = image.bits

    def _problem_of_stamp(self, stamp: float) -> str:
        """Return why an image with this stamp (s) cannot be used, or an empty text."""
        if stamp <= 0.0:
            return (
                f"the image's stamp is {stamp:.0f}: its header has no time; make the camera's "
                "node set it"
            )
        ahead = stamp - 1e-9 * self.get_clock().now().nanoseconds
        if ahead > STAMP_AHEAD_S:
            # If this stamp were accepted, every correct stamp after it would count as late.
            return (
                f"the image's stamp is {ahead:.1f} s ahead of this node's clock (limit "
                f"{STAMP_AHEAD_S:.1f} s); synchronise the clocks"
            )
        return ""

    def _search_unknown(self, grey: NDArray[np.uint8], stamp: float) -> None:
        """Search for objects without a file in an image in which the table was located."""
        assert self._tracker is not None
        if self._unknown is not None and self._last.error_code in TABLE_SEEN:
            states = (self._last, *self._other_states)
            self._unknown.search(grey, stamp, self._tracker.view, states, self._awaited)

    def _report_no_camera(self, picture: Image) -> None:
        """Report that images arrive without a camera calibration."""
        now = time.monotonic()
        if self._camera_problem:
            self._refuse(picture, ErrorCode.CAMERA_NOT_CALIBRATED, self._camera_problem)
        elif not self._unanswered_since:
            self._unanswered_since = now
        elif now - self._unanswered_since > self.settings.silence_limit:
            self._refuse(
                picture,
                ErrorCode.CAMERA_NOT_CALIBRATED,
                "images arrive without a calibration: there is no message on "
                "camera/camera_info; check that the camera's node publishes it",
            )

    def _count_late(self, observation: Observation, stamp: float) -> None:
        """Restart tracking after the camera's clock was set back, because then every image counts
        as late. Images with one and the same stamp (s) do not count: the clock stands still."""
        if observation.problem is not Problem.LATE_FRAME:
            self._late = 0
        elif stamp != self._late_stamp:
            self._late += 1
        self._late_stamp = stamp
        if self._late >= MAX_LATE and self._camera is not None and self._cell is not None:
            self.get_logger().warning(
                f"the stamps of {self._late} consecutive images are not later than that of an "
                "image received before them: the camera's clock was probably set back; tracking "
                "restarts"
            )
            self._make_trackers(self._camera, self._cell)

    def _publish(
        self, picture: Image, observation: Observation, others: Mapping[int, Observation]
    ) -> None:
        for number, other in others.items():
            self._other_states[number] = _state_of(picture, self._other_files[number].name, other)
        state = self._last = _state_of(picture, self._cell_object.name, observation)
        self._publish_states()
        if state.visible:
            pose = PoseWithCovarianceStamped(header=state.header, pose=state.pose)
            self._pose_publisher.publish(pose)
            stamp = state.header.stamp
            self._broadcaster.send([transform(TABLE, "object", state.pose.pose, stamp)])
        self._note(observation)

    def _publish_states(self) -> None:
        states = ObjectStates(
            header=self._last.header,
            objects=[self._last, *self._other_states],
            searches_unknown_objects=self._unknown is not None and self._unknown.searches,
        )
        self._states_publisher.publish(states)
        self._detections.publish(states, (self._cell_object, *self._other_files))

    def _note(self, observation: Observation) -> None:
        """Log a warning that does not invalidate the pose, such as an occluded reference marker."""
        if observation.visible and observation.sentence != self._notice:
            self._notice = observation.sentence
            if self._notice:
                self.get_logger().warning(self._notice)

    def _publish_camera(self, picture: Image) -> None:
        """Publish the camera pose in ``table``, so that subscribers can project pixels onto the
        table."""
        assert self._tracker is not None
        now, view = time.monotonic(), self._tracker.view
        if view is None or now - self._camera_published_at < CAMERA_PERIOD_S:
            return
        self._camera_published_at = now
        message = PoseStamped(pose=camera_to_message(view.pose))
        message.header.stamp = picture.header.stamp
        message.header.frame_id = TABLE
        self._camera_publisher.publish(message)
        # A static transform may be sent repeatedly: the camera is fixed relative to the table, and
        # each new transform is only a more accurate estimate.
        stamp = message.header.stamp
        self._broadcaster.send_fixed([transform(TABLE, images.OPTICAL_FRAME, message.pose, stamp)])

    def _refuse(self, picture: Image, code: int, sentence: str) -> None:
        assert self._cell is not None
        self._last = _empty_state(picture, self._cell.object.name, code, sentence)
        self._publish_states()

    def _annotate(
        self,
        message: Image,
        grey: NDArray[np.uint8],
        file: ObjectFile,
        observation: Observation,
    ) -> None:
        """Publish the image with one object: the object that is being tapped, else the cell's."""
        if not self._annotated.is_due(time.monotonic()):
            return
        assert self._tracker is not None
        picture = annotate(
            grey,
            self._tracker.view,
            observation,
            file.shape.outline(),
            file.height,
            self._goal if self._tapped in ("", file.name) else None,
            unknown=[] if self._unknown is None else self._unknown.outlines,
            name=file.name if self._other_files else "",
        )
        self._annotated.publish(picture, message.header, time.monotonic())

    def _watch(self) -> None:
        """Report when no image arrives."""
        now = time.monotonic()
        silent = now - self._received
        if not self.active or silent <= self.settings.silence_limit:
            self._missed = 0
            return
        # The first check that finds the limit exceeded reports nothing: if this process itself was
        # delayed, an image is already queued and is processed before the next check.
        self._missed += 1
        if self._missed % MISSED_LOG_PERIOD == 2:
            empty = Image()
            empty.header.stamp = self.get_clock().now().to_msg()
            self._refuse(
                empty,
                ErrorCode.CAMERA_SILENT,
                f"no image for {silent:.1f} s (limit {self.settings.silence_limit:.1f} s); "
                f"check the camera, its cable and the topic {self._picture_topic}",
            )


def _arrival(info: dict[str, int]) -> float:
    """Return the time (s, system clock) at which the middleware received a message. Return the
    current time if the middleware does not report the time of reception."""
    return 1e-9 * info["received_timestamp"] or time.time()


def _empty_state(picture: Image, name: str, code: int, sentence: str) -> ObjectState:
    """Return the state of an object without a measurement."""
    state = ObjectState(object_id=name, error_code=code, error_msg=sentence if code else "")
    state.header.stamp = picture.header.stamp
    state.header.frame_id = TABLE
    return state


def _state_of(picture: Image, name: str, observation: Observation) -> ObjectState:
    """Convert an observation to an object state."""
    state = _empty_state(picture, name, CODES[observation.problem], observation.sentence)
    state.visible = observation.visible
    state.hidden_by_arm = not observation.visible and observation.problem is Problem.NONE
    state.at_rest = observation.at_rest
    state.frames_fused = observation.frames_fused
    state.references_used = list(observation.references_used)
    if observation.at_rest_since is not None:
        since = Time(nanoseconds=round(1e9 * observation.at_rest_since))
        state.at_rest_since = since.to_msg()
    if observation.velocity is not None:
        vx, vy, omega = (float(value) for value in observation.velocity)
        state.velocity.linear.x, state.velocity.linear.y = vx, vy
        state.velocity.angular.z = omega
    if observation.pose is not None and observation.covariance is not None:
        state.pose.pose = to_message(observation.pose)
        state.pose.covariance = covariance_to_message(observation.covariance)
    return state


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    cv2.setNumThreads(1)
    return run(CameraPose, arguments)


if __name__ == "__main__":
    sys.exit(main())
