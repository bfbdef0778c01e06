"""Processor load of each node in the running graph, and time of camera_pose per image.

The benchmark starts the simulated cell as processes with a stationary object. For several seconds
the benchmark records the processor times of the processes and the ages of the object_state stamps.
Afterwards, the benchmark sends several kinds of images to camera_pose alone. The latency is the
time from the call that publishes an image to the arrival of its object_state here, including the
transport in both directions. The node's own processing time is the value that it publishes in
/diagnostics.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from tapping_cell_msgs.msg import ObjectState

from benchmarks.rigs import cpu_seconds, simulated_graph, wait_for_rest, wait_until
from tapping_cell.cli.graph import SIMULATED, Graph, own_domain
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.client_node import ClientNode
from tapping_cell.se2 import Pose
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.truth import CameraTruth

DEFAULT_COUNT = 10
"""Duration of the measurement, in s."""
RATE = 30.0
PICTURES = 60
"""Number of different images; they are published repeatedly."""
WARM_UP_S = 4.0
MARKED, PLAIN = "aluminium_disk.yaml", "plain_disk_with_dot.yaml"


@dataclass(frozen=True, slots=True)
class Case:
    """Parameters of the images for the node."""

    name: str
    object_file: str = MARKED
    moving: bool = False
    encoding: str = "mono8"
    annotated: bool = False


CASES = (
    Case("at rest"),
    Case("at rest, annotated picture received", annotated=True),
    *(
        Case(f"at rest, {encoding}", encoding=encoding)
        for encoding in ("bgr8", "bgra8", "mono16", "yuv422", "bayer_rggb8")
    ),
    Case("moving", moving=True),
    Case("outline, at rest", PLAIN),
    Case("outline, moving", PLAIN, moving=True),
)


def measure(seconds: int) -> dict[str, Any]:
    """Return the load of each node as a share of a core, rate and age of object_state, and the time
    per image (ms)."""
    domain = own_domain()
    domain.use()
    with simulated_graph(SIMULATED) as graph:
        report = _watch(graph, seconds)
    return report | {"pictures": [_measure_case(case, seconds) for case in CASES]}


def _watch(graph: Graph, seconds: int) -> dict[str, Any]:
    ages: list[float] = []
    values: dict[str, str] = {}

    def on_state(message: ObjectState) -> None:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        ages.append(time.time() - stamp)

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith("camera_pose"):
                values.update({entry.key: entry.value for entry in status.values})

    wait_for_rest(graph)
    with ClientNode("node_benchmark") as client:
        subscribe = client.node.create_subscription
        subscribe(ObjectState, "object_state", on_state, LATCHED)
        subscribe(DiagnosticArray, "/diagnostics", on_diagnostics, 10)
        # The first message is an old one that the publisher has kept.
        wait_until(lambda: ages, "object_state was not received", graph)
        ages.clear()
        before = {name: cpu_seconds(pid) for name, pid in graph.process_ids.items()}
        begin = time.monotonic()
        time.sleep(seconds)
        took = time.monotonic() - begin
        after = {name: cpu_seconds(pid) for name, pid in graph.process_ids.items()}
    return {
        "cores": {name: (after[name] - before[name]) / took for name in before},
        "rate_hz": len(ages) / took,
        "age_ms": statistics.median(ages) * 1e3,
        "picture_ms": float(values.get("milliseconds a picture", "nan")),
        "load": os.getloadavg()[0],
    }


def _measure_case(case: Case, seconds: float) -> dict[str, Any]:
    path = shared_folder() / "objects" / case.object_file
    shown = _pictures(case, path)
    parameters = {"camera_pose": {"object_file": path}}
    with (
        tempfile.TemporaryDirectory() as folder,
        Graph(("camera_pose",), parameters, Path(folder)) as graph,
        _Player(case, shown) as player,
    ):
        player.play(WARM_UP_S, graph)
        (pid,) = graph.process_ids.values()
        before, begin = cpu_seconds(pid), time.monotonic()
        player.play(seconds, graph)
        took = time.monotonic() - begin
        return player.report(seconds) | {
            "case": case.name,
            "cores": (cpu_seconds(pid) - before) / took,
            "load": os.getloadavg()[0],
        }


def _pictures(case: Case, path: Path) -> list[Image]:
    cell = load_cell(None, path)
    renderer = make_renderer(cell, CameraTruth(), cell.outline(), 1)
    made = []
    for number in range(PICTURES):
        # The object moves once around a circle in two seconds, at 0.3 m/s. The motion blur
        # lasts a fifth of the frame period.
        turns = np.array([number, number + 0.2]) / PICTURES if case.moving else np.full(2, 0.1)
        start, end = (
            Pose(0.1 * np.cos(angle), 0.1 * np.sin(angle), angle) for angle in 2 * np.pi * turns
        )
        picture = _encoded(renderer.render(start, end), case.encoding)
        made.append(images.to_message(picture, case.encoding))
    return made


def _encoded(grey: NDArray[np.uint8], encoding: str) -> NDArray[np.uint8]:
    """Convert a grey image to an encoding. A Bayer image of a grey scene is the grey image
    itself."""
    if encoding in ("bgr8", "bgra8"):
        return np.repeat(grey[..., None], len(encoding) - 1, axis=2)
    empty = {"mono16": 0, "yuv422": 128}.get(encoding)
    # The grey value is the second of two bytes: the high byte of a little-endian number, or Y in
    # UYVY.
    return grey if empty is None else np.stack([np.full_like(grey, empty), grey], axis=-1)


class _Player(ClientNode):
    """Publishes images at the camera's rate and receives the results."""

    def __init__(self, case: Case, shown: list[Image]) -> None:
        super().__init__("camera_player")
        self._shown = shown
        self._info = images.to_camera_info(load_cell().camera)
        self._late: list[float] = []
        self._inside: tuple[int, float] = (0, 0.0)
        self._inside_before = self._inside
        create = self.node.create_publisher
        self._pictures = create(Image, "camera/image_raw", images.PICTURES)
        self._infos = create(CameraInfo, "camera/camera_info", images.PICTURES)
        self.node.create_subscription(ObjectState, "object_state", self._on_state, LATCHED)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        if case.annotated:
            topic = "camera/image_annotated"
            self.node.create_subscription(Image, topic, lambda _: None, images.PICTURES)

    def play(self, seconds: float, graph: Graph) -> None:
        """Publish for ``seconds`` and discard earlier measurements."""
        topics = (self._pictures, self._infos)
        wait_until(
            lambda: all(topic.get_subscription_count() for topic in topics),
            "camera_pose did not become ready",
            graph,
        )
        self._late.clear()
        self._inside_before = self._inside
        begin = time.monotonic()
        for number in range(round(seconds * RATE)):
            picture = self._shown[number % len(self._shown)]
            stamp = self.node.get_clock().now().to_msg()
            picture.header.stamp = self._info.header.stamp = stamp
            self._infos.publish(self._info)
            self._pictures.publish(picture)
            time.sleep(max(0.0, begin + (number + 1) / RATE - time.monotonic()))

    def report(self, seconds: float) -> dict[str, Any]:
        """Return the rate and the latency of the results."""
        (pictures, busy), (pictures_0, busy_0) = self._inside, self._inside_before
        late = 1e3 * np.array(self._late)
        return {
            "rate_hz": len(late) / seconds,
            "latency_ms": statistics.median(late.tolist()),
            "latency_p95_ms": float(np.percentile(late, 95)),
            "inside_ms": (busy - busy_0) / max(1, pictures - pictures_0),
        }

    def _on_state(self, message: ObjectState) -> None:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        if message.visible:
            self._late.append(1e-9 * self.node.get_clock().now().nanoseconds - stamp)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {entry.key: entry.value for entry in status.values}
            if "milliseconds a picture" in values:
                pictures = int(values["pictures"])
                self._inside = (pictures, pictures * float(values["milliseconds a picture"]))


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = [f"{name:<16}{100 * share:5.1f} % of a core" for name, share in report["cores"].items()]
    text.append(
        f"object_state at {report['rate_hz']:.1f} Hz, {report['age_ms']:.1f} ms after the middle "
        f"of the exposure; camera_pose takes {report['picture_ms']:.2f} ms a picture "
        f"(load {report['load']:.1f})"
    )
    return [*text, "camera_pose alone:", *_case_lines(report["pictures"])]


def _case_lines(report: list[dict[str, Any]]) -> list[str]:
    return [
        f"{entry['case']:<34}{100 * entry['cores']:5.1f} % of a core at {entry['rate_hz']:.1f} Hz; "
        f"result after {entry['latency_ms']:.1f} ms (p95 {entry['latency_p95_ms']:.1f}), with "
        f"{entry['inside_ms']:.1f} ms in the node (load {entry['load']:.1f})"
        for entry in report
    ]
