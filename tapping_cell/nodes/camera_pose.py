"""The seeing node: pictures in, the object's pose on the table with its covariance out."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from numpy.typing import NDArray
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from tapping_cell_msgs.msg import ErrorCode, ObjectState, PlanState

from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.schema import quantity, text
from tapping_cell.nodes import images
from tapping_cell.nodes.cell_node import LATCHED, CellNode, run
from tapping_cell.nodes.conversions import (
    camera_to_message,
    covariance_to_message,
    from_message,
    seconds,
    to_message,
)
from tapping_cell.se2 import Pose
from tapping_cell.vision import (
    CameraError,
    CameraModel,
    Observation,
    PoseTracker,
    Problem,
    annotate,
)

CODES = {
    Problem.NONE: ErrorCode.NONE,
    Problem.WRONG_IMAGE: ErrorCode.IMAGE_INVALID,
    Problem.LATE_FRAME: ErrorCode.STAMP_INVALID,
    Problem.FROZEN_FRAME: ErrorCode.IMAGE_INVALID,
    Problem.DARK: ErrorCode.IMAGE_INVALID,
    Problem.OVEREXPOSED: ErrorCode.IMAGE_INVALID,
    Problem.TABLE_UNKNOWN: ErrorCode.REFERENCES_NOT_SEEN,
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

CAMERA_PERIOD_S = 1.0
"""Between two reports of where the camera is."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of camera_pose."""

    autostart: bool = text("configure and activate without being asked", default=True)
    cell_file: str = text("path of the cell file; empty for the package's own", default="")
    object_file: str = text("path of the object file; empty for the cell file's", default="")
    silence_limit: float = quantity(
        "time without a picture after which the camera counts as silent",
        "s",
        0.1,
        60.0,
        default=1.0,
    )
    annotated_rate: float = quantity(
        "greatest rate of camera/image_annotated, sent only while somebody listens",
        "Hz",
        0.1,
        60.0,
        default=10.0,
    )


class CameraPose(CellNode[Parameters]):
    """See the module's docstring."""

    def __init__(self) -> None:
        super().__init__("camera_pose", Parameters)
        self._cell: Cell | None = None
        self._tracker: PoseTracker | None = None
        self._camera: CameraModel | None = None
        self._camera_problem = ""
        self._goal: Pose | None = None
        self._heard = time.monotonic()
        self._annotated_at = 0.0
        self._camera_told_at = 0.0
        self._frames = 0
        self._busy_seconds = 0.0
        self._last = ObjectState()
        self._pose_publisher = self.create_publisher(PoseWithCovarianceStamped, "object_pose", 10)
        self._state_publisher = self.create_publisher(ObjectState, "object_state", LATCHED)
        self._camera_publisher = self.create_publisher(PoseStamped, "camera/pose", LATCHED)
        self._picture_publisher = self.create_publisher(
            Image, "camera/image_annotated", images.PICTURES
        )
        self.create_subscription(
            CameraInfo, "camera/camera_info", self._on_camera_info, images.PICTURES
        )
        self.create_subscription(Image, "camera/image_raw", self._on_image, images.PICTURES)
        self.create_subscription(PlanState, "plan_state", self._on_plan_state, LATCHED)
        self.create_timer(0.25, self._watch)

    def configure(self) -> None:
        """Read the cell, table and object files."""
        self._cell = load_cell(self.settings.cell_file or None, self.settings.object_file or None)
        self._camera = None

    def cleanup(self) -> None:
        """Forget the track."""
        self._tracker = None

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Pictures seen and what is wrong with them."""
        values: dict[str, object] = {
            "pictures": self._frames,
            "milliseconds a picture": f"{1000 * self._busy_seconds / max(1, self._frames):.2f}",
        }
        if self._last.error_code:
            return DiagnosticStatus.WARN, self._last.error_msg, values
        return DiagnosticStatus.OK, "ok", values

    def _on_plan_state(self, message: PlanState) -> None:
        busy = message.state not in (PlanState.IDLE, PlanState.CANCELED)
        self._goal = from_message(message.goal.pose) if busy else None

    def _on_camera_info(self, message: CameraInfo) -> None:
        if not self.active or self._cell is None:
            return
        try:
            camera = images.from_camera_info(message)
        except CameraError as error:
            self._camera_problem = str(error)
            self._tracker = self._camera = None
            return
        self._camera_problem = ""
        if camera != self._camera:
            self._camera = camera
            self._tracker = PoseTracker(camera, self._cell.references, self._cell.object.seen())

    def _on_image(self, message: Image) -> None:
        self._heard = time.monotonic()
        if not self.active:
            return
        began = time.perf_counter()
        if self._tracker is None:
            if self._camera_problem:
                self._refuse(message, ErrorCode.CAMERA_NOT_CALIBRATED, self._camera_problem)
            return
        try:
            grey = images.to_grey(message)
        except images.ImageRefused as error:
            self._refuse(message, ErrorCode.IMAGE_INVALID, str(error))
            return
        observation = self._tracker.update(grey, seconds(message.header.stamp))
        self._publish(message, observation)
        self._tell_camera(message)
        self._frames += 1
        self._busy_seconds += time.perf_counter() - began
        self._annotate(message, grey, observation)

    def _publish(self, picture: Image, observation: Observation) -> None:
        assert self._cell is not None
        state = self._state(picture, CODES[observation.problem], observation.sentence)
        state.visible = observation.visible
        state.at_rest = observation.at_rest
        state.frames_fused = observation.frames_fused
        state.references_used = list(observation.references_used)
        if observation.at_rest_since is not None:
            since = Time(nanoseconds=round(1e9 * observation.at_rest_since))
            state.at_rest_since = since.to_msg()
        if observation.velocity is not None:
            vx, vy, omega = (float(value) for value in observation.velocity)
            state.velocity = Twist()
            state.velocity.linear.x, state.velocity.linear.y = vx, vy
            state.velocity.angular.z = omega
        if observation.pose is not None and observation.covariance is not None:
            state.pose.pose = to_message(observation.pose)
            state.pose.covariance = covariance_to_message(observation.covariance)
            pose = PoseWithCovarianceStamped(header=state.header, pose=state.pose)
            self._pose_publisher.publish(pose)
        self._state_publisher.publish(state)
        self._last = state

    def _tell_camera(self, picture: Image) -> None:
        """Say where the camera is over the table: what turns a pixel into a place on it."""
        assert self._tracker is not None
        now, view = time.monotonic(), self._tracker.view
        if view is None or now - self._camera_told_at < CAMERA_PERIOD_S:
            return
        self._camera_told_at = now
        message = PoseStamped(pose=camera_to_message(view.pose))
        message.header.stamp = picture.header.stamp
        message.header.frame_id = "table"
        self._camera_publisher.publish(message)

    def _state(self, picture: Image, code: int, sentence: str) -> ObjectState:
        assert self._cell is not None
        state = ObjectState(
            object_id=self._cell.object.name, error_code=code, error_msg=sentence if code else ""
        )
        state.header.stamp = picture.header.stamp
        state.header.frame_id = "table"
        return state

    def _refuse(self, picture: Image, code: int, sentence: str) -> None:
        self._last = self._state(picture, code, sentence)
        self._state_publisher.publish(self._last)

    def _annotate(self, message: Image, grey: NDArray[np.uint8], observation: Observation) -> None:
        now = time.monotonic()
        due = now - self._annotated_at >= 1.0 / self.settings.annotated_rate
        if not due or self._picture_publisher.get_subscription_count() == 0:
            return
        assert self._cell is not None and self._tracker is not None
        self._annotated_at = now
        picture = annotate(
            grey,
            self._tracker.view,
            observation,
            self._cell.outline(),
            self._cell.object.height,
            self._goal,
        )
        annotated = images.to_message(picture, "bgr8")
        annotated.header = message.header
        self._picture_publisher.publish(annotated)

    def _watch(self) -> None:
        """Say so when no picture comes."""
        silent = time.monotonic() - self._heard
        if self.active and silent > self.settings.silence_limit:
            empty = Image()
            empty.header.stamp = self.get_clock().now().to_msg()
            self._refuse(
                empty,
                ErrorCode.CAMERA_SILENT,
                f"no picture for {silent:.1f} s (limit {self.settings.silence_limit:.1f} s); check "
                "the camera, its cable and the topic camera/image_raw",
            )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(CameraPose, arguments)


if __name__ == "__main__":
    sys.exit(main())
