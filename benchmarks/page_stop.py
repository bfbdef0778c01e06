"""Latency from STOP on the operator's page to a subscriber of ``emergency_stop`` under attack.

The real node and its separate process for STOP are running. Another process simulates ``CLIENTS``
hostile clients with 200 messages per second each. The hostile clients first send drags, commands
and invalid data to the page, and reconnect when disconnected. Then the hostile clients send
``check`` requests and invalid data to the port of STOP. The latency includes a browser's request
over a new connection, the process, the middleware and the subscription in this process. For
comparison, two other latencies are measured: that of STOP without an attack, and that of a message
that this process publishes itself.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import selectors
import socket
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Bool

from benchmarks.rigs import wait_until
from tapping_cell.cli.graph import Graph, own_domain
from tapping_cell.configuration.cell import load_cell
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.camera.pose_messages import camera_to_message
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.client_node import ClientNode
from tapping_cell.vision import CameraPose

STOPS = 100
PAUSE_S = 0.2
"""Pause between stops, in s."""
CLIENTS = 50
BATCH_PERIOD_S = 0.05
BATCH = 10
"""Number of messages that each client sends per period; it corresponds to 200 messages per
second."""
TIMEOUT_S = 20.0


def measure() -> dict[str, Any]:
    """Return the times (s) from the request to the arrival of the message: without an attack,
    during each attack, and for messages that this process publishes itself."""
    domain = own_domain()
    domain.use()
    page, stop = _free_port(), _free_port()
    with tempfile.TemporaryDirectory() as folder:
        given = {"operator_page": {"port": page, "stop_port": stop, "runs": Path(folder)}}
        with (
            Listener("page_stop_bench") as listener,
            Graph(("operator_page",), given, Path(folder) / "logs") as graph,
        ):
            wait_until(lambda: _press(page, stop), "STOP was not served", graph, TIMEOUT_S, 0.1)
            return {
                "no attack": _stops(listener, page, stop, None),
                "pages": _stops(listener, page, stop, attack_pages),
                "stop port": _stops(listener, page, stop, attack_stop),
                "bare topic": _bare(listener),
                "load": os.getloadavg()[0],
            }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    rows = [
        f"{name}: median {1e3 * row['median']:.1f} ms, p99 {1e3 * row['p99']:.1f} ms, longest"
        f" {1e3 * row['longest']:.1f} ms of {row['stops']}"
        + (f"; {row['sent']:.0f} hostile messages/s" if "sent" in row else "")
        for name, row in report.items()
        if isinstance(row, dict)
    ]
    return [*rows, f"load {report['load']:.1f} on {os.cpu_count()} cores"]


class Listener(ClientNode):
    """Records the arrival of a stop. This node also publishes camera data, so that the page needs
    as much processor time for a drag as in a real cell."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.received = threading.Event()
        self.received_at = 0.0
        self.node.create_subscription(Bool, "emergency_stop", self._receive, LATCHED)
        self.bare = self.node.create_publisher(Bool, "bare", LATCHED)
        self.node.create_subscription(Bool, "bare", self._receive, LATCHED)
        self._info = self.node.create_publisher(CameraInfo, "camera/camera_info", images.PICTURES)
        self._pose = self.node.create_publisher(PoseStamped, "camera/pose", LATCHED)
        self._camera = load_cell().camera
        self.node.create_timer(0.5, self._play_camera)

    def _receive(self, _: Bool) -> None:
        self.received_at = time.monotonic()
        self.received.set()

    def _play_camera(self) -> None:
        self._info.publish(images.to_camera_info(self._camera))
        place = CameraPose.above((0.02, -0.05, 0.7), (0.0, 0.0), 0.1)
        self._pose.publish(PoseStamped(pose=camera_to_message(place)))


def _stops(
    listener: Listener, page: int, stop: int, attack: Callable[..., None] | None
) -> dict[str, float]:
    context = multiprocessing.get_context("spawn")
    sent = context.Value("L", 0)
    hostile = context.Process(target=attack, args=(page, stop, sent), daemon=True)
    if attack is not None:
        hostile.start()
        time.sleep(3.0)
    before, began = sent.value, time.monotonic()
    times = []
    try:
        for _ in range(STOPS):
            time.sleep(PAUSE_S)
            listener.received.clear()
            pressed = time.monotonic()
            if not _press(page, stop) or not listener.received.wait(TIMEOUT_S):
                raise RuntimeError("a STOP request was refused, or no stop was received")
            times.append(listener.received_at - pressed)
    finally:
        rate = (sent.value - before) / (time.monotonic() - began)
        if attack is not None:
            hostile.kill()
            hostile.join()
            time.sleep(1.0)
    return _figures(times) | ({} if attack is None else {"sent": rate})


def _bare(listener: Listener) -> dict[str, float]:
    times = []
    for _ in range(STOPS):
        time.sleep(0.02)
        listener.received.clear()
        began = time.monotonic()
        listener.bare.publish(Bool(data=True))
        listener.received.wait(TIMEOUT_S)
        times.append(listener.received_at - began)
    return _figures(times)


def _figures(times: list[float]) -> dict[str, float]:
    return {
        "stops": len(times),
        "median": float(np.median(times)),
        "p99": float(np.percentile(times, 99)),
        "longest": max(times),
    }


def _press(page: int, stop: int) -> bool:
    """Send one STOP over a new connection, as a browser does."""
    asked = urllib.request.Request(
        f"http://127.0.0.1:{stop}/",
        data=b'{"do": "stop"}',
        headers={"Origin": f"http://127.0.0.1:{page}"},
    )
    try:
        with urllib.request.urlopen(asked, timeout=TIMEOUT_S) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


def attack_pages(page: int, _: int, sent: Any) -> None:
    """Run hostile clients of the page until the process is killed."""
    place = b'{"do":"place","number":%d,"x":%d,"y":0,"angle":9}'
    messages = [place % (number, number % 200 - 100) for number in range(1000)]
    messages += [b'{"do":"goal","x":1e9}', b'{"do":"home"}', b"[" * 500, b"\xff\xfe", b"{}"] * 40
    frames = [_frame(message) for message in messages]
    hello = (
        f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{page}\r\nOrigin: http://127.0.0.1:{page}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    ).encode() + _frame(b'{"do":"hello"}')
    _attack(page, hello, frames, sent)


def attack_stop(page: int, stop: int, sent: Any) -> None:
    """Run hostile clients of the port of STOP until the process is killed."""
    bodies = [b'{"do":"check"}', b'{"do":"check","token":"x"}', b"nonsense", b"[" * 300]
    requests = [
        f"POST / HTTP/1.1\r\nHost: 127.0.0.1:{stop}\r\nOrigin: http://127.0.0.1:{page}\r\n"
        f"Content-Length: {len(body)}\r\n\r\n".encode()
        + body
        for body in bodies
    ]
    _attack(stop, b"", [*requests, b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"], sent)


def _attack(port: int, hello: bytes, messages: list[bytes], sent: Any) -> None:
    """Send batches over every connection and reopen closed connections."""
    chance = random.Random(1)
    lines: list[socket.socket | None] = [None] * CLIENTS
    while True:
        began = time.monotonic()
        for number, line in enumerate(lines):
            try:
                if line is None:
                    line = lines[number] = socket.create_connection(("127.0.0.1", port), 1.0)
                    line.sendall(hello)
                    line.setblocking(False)
                _drain(line)
                line.send(b"".join(chance.choices(messages, k=BATCH)))
                with sent.get_lock():
                    sent.value += BATCH
            except BlockingIOError:
                continue  # the server has stopped reading to protect itself
            except OSError:
                if line is not None:
                    line.close()
                lines[number] = None
        time.sleep(max(0.0, BATCH_PERIOD_S - (time.monotonic() - began)))


def _drain(line: socket.socket) -> None:
    """Read and discard replies; raise ConnectionError if the server has closed the connection."""
    with selectors.DefaultSelector() as ready:
        ready.register(line, selectors.EVENT_READ)
        while ready.select(0):
            if not line.recv(1 << 16):
                raise ConnectionResetError


def _frame(message: bytes) -> bytes:
    """Make a WebSocket text frame with a mask of zeros (RFC 6455, section 5.2)."""
    size = len(message)
    length = bytes([0x80 | size]) if size < 126 else bytes([0xFE]) + size.to_bytes(2, "big")
    return b"\x81" + length + bytes(4) + message


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
