"""Images between two computers, and goals in a cell of three computers whose clocks differ.

The computers are network namespaces of this machine (``benchmarks.networks``). Images are sent
within one computer and over a link without loss. Goals use a link with 20 ms delay and 1 % packet
loss; camera and vision run on one computer, the drivers on the second, and planner and recorder on
the third.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.networks import Computer, computers, why_not
from tapping_cell.cli.graph import own_domain
from tapping_cell.nodes import MODULES

DEFAULT_COUNT = 10
"""Number of goals."""
PICTURES = 600
"""Number of images per transport. Sending them takes 20 s."""
RATE_HZ = 30.0
SIZE = (1024, 1280)
DELAY_S, LOSS = 0.020, 0.01
PLACES = {
    "vision": ("sim_world", "camera_pose"),
    "drivers": ("scara_arm", "tapper_trigger"),
    "desk": ("tap_planner", "run_recorder"),
}
CLOCKS_S = {"vision": 0.3, "drivers": 0.1, "desk": 0.0}
"""Offset of each computer's clock in the run in which the cell must accept goals, in s."""
REFUSED_S = {
    "vision": {"vision": 2.0, "drivers": 0.0, "desk": 0.0},
    "drivers": {"vision": 0.0, "drivers": 2.0, "desk": 0.0},
}
"""Offsets of the computers' clocks, in s. The name of each entry is the computer whose clock is too
far ahead. A goal must be refused before its first tap, and the refusal must name this computer."""
TIMEOUT_S = 120.0
SETTLE_S = 3.0


def measure(count: int) -> dict[str, Any]:
    """Return the sent and the received images by transport, and the results of the goals."""
    reason = why_not()
    if reason:
        raise OSError(f"this section needs network namespaces: {reason}")
    own = {"ROS_DOMAIN_ID": str(own_domain().number)}
    report: dict[str, Any] = {"pictures": {}, "load": os.getloadavg()[0]}
    for transport in ("raw", "compressed"):
        with computers(("camera", "vision")) as (first, second):
            report["pictures"][f"{transport}, one host"] = _pictures(first, first, transport, own)
            report["pictures"][f"{transport}, clean link"] = _pictures(
                first, second, transport, own
            )
    with tempfile.TemporaryDirectory() as folder, cell(Path(folder), own) as desk:
        report["goals"] = goals(desk, own, count)
    report["refused"] = {}
    for name, clocks in REFUSED_S.items():
        with tempfile.TemporaryDirectory() as folder, cell(Path(folder), own, clocks) as desk:
            (report["refused"][name],) = goals(desk, own, 1)
    return report


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    made = [
        f"pictures {name}: {entry['arrived']} of {entry['sent']} arrived, median "
        f"{entry['median_ms']:.1f} ms"
        for name, entry in report["pictures"].items()
    ]
    ends = report["goals"]
    reached = [end for end in ends if end["error_code"] == 0]
    made.append(
        f"goals over {1000 * DELAY_S:.0f} ms and {100 * LOSS:.0f} % loss, clocks "
        f"{max(CLOCKS_S.values()):.1f} s apart: {len(reached)} of {len(ends)} reached"
    )
    for end in ends:
        made.append(
            f"  {end['taps']} taps, {end['seconds']:.0f} s, truly {end['true_mm']:.2f} mm off "
            f"{end['error_msg']}"
        )
    made += [
        f"goal with the clock of '{name}' {REFUSED_S[name][name]:.1f} s ahead: {end['taps']} taps, "
        f"code {end['error_code']}: {end['error_msg']}"
        for name, end in report["refused"].items()
    ]
    return made


def _pictures(
    source: Computer, sink: Computer, transport: str, own: Mapping[str, str]
) -> dict[str, Any]:
    role = [sys.executable, "-m", "benchmarks.two_computers"]
    reader = sink.start([*role, "reader", transport], own, stdout=subprocess.PIPE)
    writer = source.start([*role, "writer", transport], own)
    try:
        output, _ = reader.communicate(timeout=TIMEOUT_S)
        return dict(json.loads(output))
    finally:
        for process in (reader, writer):
            process.kill()
            process.wait()


@contextlib.contextmanager
def cell(
    folder: Path, own: Mapping[str, str], clocks: Mapping[str, float] | None = None
) -> Iterator[Computer]:
    """Run the simulated cell on three computers and yield the operator's computer.

    ``clocks``: offset of each computer's clock in s, positive if the clock is ahead.
    """
    environment = {**own, "HOME": str(folder), "OPENBLAS_NUM_THREADS": "1"}
    shifts = CLOCKS_S if clocks is None else clocks
    started = []
    with computers(tuple(PLACES), DELAY_S, LOSS) as made, contextlib.ExitStack() as stack:
        try:
            for computer in made:
                for name in PLACES[computer.name]:
                    words = [sys.executable, "-m", "benchmarks.shifted_clock"]
                    words += [str(shifts[computer.name]), MODULES[name], "--ros-args"]
                    if name == "scara_arm":
                        words += ["-p", "home_on_activate:=true"]
                    if name == "run_recorder":
                        words += ["-p", f"folder:={folder / 'runs'}", "-p", "pictures:=false"]
                    log = stack.enter_context((folder / f"{name}.log").open("w"))
                    started.append(
                        computer.start(words, environment, stdout=log, stderr=subprocess.STDOUT)
                    )
            yield made[-1]
        finally:
            for process in started:
                process.terminate()
            for process in started:
                try:
                    process.wait(5.0)
                except subprocess.TimeoutExpired:
                    process.kill()


def goals(desk: Computer, own: Mapping[str, str], count: int) -> list[dict[str, Any]]:
    """Send goals one after the other from ``desk`` and return the true result of each goal."""
    words = [sys.executable, "-m", "benchmarks.two_computers", "goals", str(count)]
    client = desk.start(words, own, stdout=subprocess.PIPE)
    try:
        output, _ = client.communicate(timeout=TIMEOUT_S * (count + 1))
    finally:
        client.kill()
        client.wait()
    return [json.loads(line) for line in output.splitlines()]


# The following code runs on the simulated computers.


def _write(transport: str) -> None:
    import numpy as np
    import rclpy
    from sensor_msgs.msg import CameraInfo

    from tapping_cell.nodes.camera import images
    from tapping_cell.nodes.camera.picture_publisher import PicturePublisher
    from tapping_cell.nodes.cell_node import choose_transport

    choose_transport(pictures=True)
    rclpy.init()
    node = rclpy.create_node("writer")
    publisher = PicturePublisher(node, 95)
    noise = np.random.default_rng(1).normal(128, 2, SIZE).astype(np.uint8)
    while not publisher.subscribers():
        time.sleep(0.05)
    time.sleep(SETTLE_S)
    due = time.monotonic()
    for number in range(PICTURES):
        picture = images.to_message(np.roll(noise, number), "mono8")
        picture.header.frame_id = str(number)
        picture.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(picture, CameraInfo())
        due += 1.0 / RATE_HZ
        time.sleep(max(0.0, due - time.monotonic()))
    # Keep running, so that lost data can be sent again. The reader ends earlier.
    time.sleep(TIMEOUT_S)


def _read(transport: str) -> None:
    import rclpy
    from sensor_msgs.msg import CompressedImage, Image

    from tapping_cell.nodes.camera import images
    from tapping_cell.nodes.cell_node import choose_transport

    choose_transport(pictures=True)
    rclpy.init()
    node = rclpy.create_node("reader")
    delays: list[float] = []

    def on_message(message: Image | CompressedImage) -> None:
        now = node.get_clock().now().nanoseconds
        stamp = message.header.stamp
        delays.append(1e-6 * (now - stamp.sec * 1_000_000_000 - stamp.nanosec))

    if transport == "raw":
        node.create_subscription(Image, images.RAW, on_message, images.PICTURES)
    else:
        node.create_subscription(
            CompressedImage, images.COMPRESSED, on_message, images.COMPRESSED_PICTURES
        )
    last, received = time.monotonic(), 0
    while not delays or time.monotonic() - last < SETTLE_S:
        rclpy.spin_once(node, timeout_sec=0.1)
        if len(delays) != received:
            last, received = time.monotonic(), len(delays)
    median = sorted(delays)[len(delays) // 2]
    print(json.dumps({"sent": PICTURES, "arrived": len(delays), "median_ms": median}))


def _send_goals(count: int) -> None:
    import random

    from tapping_cell.nodes.clients.goal_client import Finished, GoalClient
    from tapping_cell.se2 import Pose

    chance = random.Random(5)
    with GoalClient("goal") as client:
        for _ in range(count):
            # Wait for a device that was lost because of high load: it reconnects automatically.
            deadline = time.monotonic() + TIMEOUT_S / 2
            while client.missing() and time.monotonic() < deadline:
                time.sleep(0.2)
            goal = Pose(chance.uniform(-0.08, 0.08), chance.uniform(-0.06, 0.06), 0.0)
            goal = Pose(goal.x, goal.y, chance.uniform(-0.5, 0.5))
            began = time.monotonic()
            client.send(goal)
            end = next((event for event in client.events() if isinstance(event, Finished)), None)
            assert end is not None
            true = client.settled_truth(3.0)
            print(
                json.dumps(
                    {
                        "error_code": end.error_code,
                        "error_msg": end.error_msg,
                        "taps": end.taps,
                        "seconds": time.monotonic() - began,
                        "true_mm": 1e3 * goal.distance_to(true) if true else None,
                        "true_rad": abs(goal.rotation_to(true)) if true else None,
                    }
                ),
                flush=True,
            )


if __name__ == "__main__":
    role, argument = sys.argv[1:]
    {
        "writer": _write,
        "reader": _read,
        "goals": lambda text: _send_goals(int(text)),
    }[role](argument)
