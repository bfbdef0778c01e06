"""Camera node: publishes the images of a device, video file or folder, and their calibration."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from sensor_msgs.msg import CameraInfo

from tapping_cell.configuration.schema import quantity, text
from tapping_cell.configuration.table import load_camera_model
from tapping_cell.hardware.camera_source import (
    CameraSettings,
    CameraSourceError,
    Device,
    Frame,
    Playback,
    SourceEnded,
    open_source,
)
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.camera.picture_publisher import PicturePublisher
from tapping_cell.nodes.cell_node import CellNode, NotReady, run
from tapping_cell.nodes.cell_parameters import CellParameters
from tapping_cell.nodes.worker import Worker

SUBSCRIBER_WAIT_S = 5.0
"""Time for which a file or folder waits for a subscriber before its first image."""
REOPEN_PERIOD_S = 1.0
"""Period between two attempts to reopen a lost source."""


@dataclass(frozen=True, slots=True)
class Parameters(CellParameters):
    """Parameters of overhead_camera."""

    camera_info_file: str = text(
        "path of the camera calibration; if empty, the file named in the cell file", default=""
    )
    source: str = text(
        "image source: a device such as /dev/video0, a video file or a folder of images",
        default="/dev/video0",
    )
    frame_rate: float = quantity("frames per second", "Hz", 0.1, 240.0, default=30.0)
    exposure: float = quantity(
        "exposure time; 0 leaves it to the device", "s", 0.0, 1.0, default=0.0
    )
    loop: bool = text(
        "repeat a video file or folder from its beginning when it ends", default=False
    )
    compressed_quality: int = quantity(
        "JPEG quality of camera/image_raw/compressed", "", 50, 100, default=95
    )


class OverheadCamera(CellNode[Parameters]):
    """See the module's docstring."""

    def __init__(self) -> None:
        super().__init__("overhead_camera", Parameters)
        self._source: Device | Playback | None = None
        self._worker: Worker | None = None
        self._settings: CameraSettings | None = None
        self._info = CameraInfo()
        self._frames = 0
        self._problem = ""
        self._warning = ""
        self._ended = False
        self._away = False
        self._publisher = PicturePublisher(self, self.settings.compressed_quality)

    def configure(self) -> None:
        """Read the calibration and open the source."""
        given = self.settings.camera_info_file
        if given:
            camera = load_camera_model(Path(given).expanduser())
        else:
            camera = self.settings.load_cell().camera
        self._info = images.to_camera_info(camera)
        self._ended = False
        self._settings = CameraSettings(
            width=camera.width,
            height=camera.height,
            rate=self.settings.frame_rate,
            exposure=self.settings.exposure,
            loop=self.settings.loop,
        )
        try:
            self._source = self._open()
        except CameraSourceError as error:
            raise NotReady(str(error)) from error

    def activate(self) -> None:
        """Start to publish images."""
        self._worker = Worker("camera", self._take, 0.0)
        self._worker.start()

    def deactivate(self) -> None:
        """Stop publishing images."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.close()

    def cleanup(self) -> None:
        """Release the source."""
        self.deactivate()
        if self._source is not None:
            self._source.close()
        self._source = None

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Report the number of published images and any error of the source."""
        values: dict[str, object] = {"hardware_id": self.settings.source, "pictures": self._frames}
        failure = None if self._worker is None else self._worker.error
        if failure is not None:
            return DiagnosticStatus.ERROR, f"the camera's thread failed: {failure!r}", values
        if self._problem:
            return DiagnosticStatus.ERROR, self._problem, values
        if self._warning:
            return DiagnosticStatus.WARN, self._warning, values
        return DiagnosticStatus.OK, "ok", values

    def _open(self) -> Device | Playback:
        assert self._settings is not None
        if not self.settings.source.strip():
            raise CameraSourceError(
                "the parameter source is empty; give a device such as /dev/video0, a file or a "
                "folder"
            )
        return open_source(str(Path(self.settings.source).expanduser()), self._settings)

    def _take(self) -> None:
        """Publish one image or try to reopen the source. Runs in the worker's thread."""
        if self._ended:
            time.sleep(0.1)
            return
        try:
            if self._source is None:
                self._source = self._open()
            if self._frames == 0 and isinstance(self._source, Playback):
                self._pause(SUBSCRIBER_WAIT_S, self._publisher.subscribers)
            frame = self._source.read()
        except SourceEnded as error:
            self._ended = True
            self._log_problem(str(error))
            return
        except CameraSourceError as error:
            self._log_problem(str(error))
            if self._source is not None:
                self._source.close()
            self._source, self._away = None, True
            self._pause(REOPEN_PERIOD_S)
            return
        if self._away:
            self.get_logger().info(f"{self.settings.source} delivers images again")
            self._away = False
        self._send(frame)

    def _send(self, frame: Frame) -> None:
        assert self._settings is not None
        picture, wanted = frame.picture, self._settings
        if picture.shape != (wanted.height, wanted.width):
            self._log_problem(
                f"the image is {picture.shape[1]} x {picture.shape[0]} pixels but the "
                f"calibration is for {wanted.width} x {wanted.height}, so it is not published; "
                "calibrate at "
                "the image size, or set the camera to the calibrated size"
            )
            return
        self._problem = ""
        if frame.sentence and frame.sentence != self._warning:
            self._warning = frame.sentence
            self.get_logger().warning(frame.sentence)
        age = time.monotonic() - frame.captured
        stamp = self.get_clock().now() - Duration(seconds=age + self.settings.exposure / 2)
        message = images.to_message(picture, "mono8")
        message.header.frame_id = images.OPTICAL_FRAME
        message.header.stamp = stamp.to_msg()
        try:
            self._publisher.publish(message, self._info)
        except RuntimeError:  # rclpy's RCLError, which has no public name
            if self.context.ok():
                raise
            return  # the process is shutting down
        self._frames += 1

    def _log_problem(self, sentence: str) -> None:
        """Log a problem, unless it is the same as the last logged problem."""
        if sentence != self._problem:
            self.get_logger().error(sentence)
        self._problem = sentence

    def _pause(self, period: float, done: Callable[[], int] = lambda: 0) -> None:
        """Wait for a period in s, or until the node is destroyed or ``done`` returns a nonzero
        value."""
        end = time.monotonic() + period
        while time.monotonic() < end and self._worker is not None and not done():
            time.sleep(0.05)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(OverheadCamera, arguments)


if __name__ == "__main__":
    sys.exit(main())
