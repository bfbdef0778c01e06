"""Connection to a robot's digital output. Commands go to a service or topic; the state of the
safety guard and the read-back of the output come from topics."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

from rclpy.client import Client
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool, Float64, Float64MultiArray
from std_srvs.srv import SetBool

from tapping_cell.configuration.cell import OutputSection
from tapping_cell.hardware.output_link import Answer, InputLevel
from tapping_cell.nodes.cell_node import COMMAND
from tapping_cell.nodes.drivers.ros_link import RosLink
from tapping_cell.nodes.kept_content import KeptContent

KEPT_REQUESTS = 100
INPUT = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
"""QoS profile of the inputs. A best-effort subscription also receives from reliable publishers. A
lost message is superseded by the next."""
KINDS = {"topic": Bool, "commands": Float64MultiArray, "pulse": Float64}


class KeptShot:
    """Highest shot number so far, stored in a file of the cell's state folder."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "shot.json"
        self._content = KeptContent(self._file)

    def recall(self) -> int:
        """Return the highest shot number that may have been sent.

        Raises ValueError if the file is unreadable.
        """
        found = self._content.recall()
        shot = 0 if found is None else found.get("shot")
        if not isinstance(shot, int) or shot < 0:
            raise ValueError(
                f"{self._file}, which stores the number of the last shot, cannot be read: "
                "make sure that no tap is in progress, then delete the file"
            )
        return shot

    def keep(self, shot: int) -> None:
        """Store the shot number, so that it survives a power loss. Raises OSError."""
        self._content.keep({"shot": shot})


class RosOutputLink(RosLink):
    """See :class:`~tapping_cell.hardware.output_link.OutputLink`."""

    def __init__(self, parent: Node, section: OutputSection) -> None:
        super().__init__(parent, "output")
        self._section = section
        self._guard: InputLevel | None = None
        self._read_back: InputLevel | None = None
        self._last_on = -math.inf
        self._number = 0
        self._futures: dict[int, Any] = {}
        self._client: Client | None = None
        self._publisher: Publisher | None = None
        if section.interface == "service":
            self._client = self._node.create_client(SetBool, section.name)
        else:
            kind = KINDS[section.interface]
            self._publisher = self._node.create_publisher(kind, section.name, COMMAND)
        self._node.create_subscription(Bool, section.guard, self._on_guard, INPUT)
        if section.read_back:
            self._node.create_subscription(Bool, section.read_back, self._on_read_back, INPUT)
        self._start()

    # Connection

    @property
    def name(self) -> str:
        """Name of the service or topic that switches the output."""
        return self._section.name

    @property
    def interface(self) -> str:
        """Interface type of the output."""
        return self._section.interface

    @property
    def times_pulse(self) -> bool:
        """Whether the receiver, not this process, times the pulse."""
        return self._section.interface == "pulse"

    @property
    def reads_back(self) -> bool:
        """Whether a read-back is expected."""
        return bool(self._section.read_back)

    @property
    def other_commanders(self) -> tuple[str, ...]:
        """Other nodes that publish on the output's topic."""
        if self._publisher is None:
            return ()
        return tuple(self._publishers(self.name))

    def sleep(self, duration: float) -> None:
        """Sleep for a duration in s."""
        time.sleep(max(duration, 0.0))

    def stop(self, data: bytes) -> bool:
        """Latch the stop and switch the output off, from any thread."""
        self._stopped = True
        with self._lock:
            self._send(False, 0.0)
        with self._received:
            self._received.notify_all()
        return self._present()

    # Inputs

    @property
    def guard(self) -> InputLevel | None:
        """Last message from the safety guard: whether the guard is closed."""
        with self._received:
            return self._guard

    @property
    def read_back(self) -> InputLevel | None:
        """Last read-back: whether the output is on."""
        with self._received:
            return self._read_back

    @property
    def last_on(self) -> float:
        """Time, in s of the monotonic clock, of the last read-back that reported the output as
        on."""
        with self._received:
            return self._last_on

    def _on_guard(self, message: Bool) -> None:
        with self._received:
            self._guard = InputLevel(message.data, self.now())
            self._received.notify_all()

    def _on_read_back(self, message: Bool) -> None:
        with self._received:
            self._read_back = InputLevel(message.data, self.now())
            if message.data:
                self._last_on = self._read_back.received
            self._received.notify_all()

    # Output

    def switch(self, on: bool) -> int:
        """Switch the output on or off. Return a request number for ``answer``."""
        with self._lock:
            # A stop that arrives now waits for the lock and then switches the output off.
            self._require()
            return self._send(on, 0.0)

    def pulse(self, duration: float) -> int:
        """Send the duration (s) of a pulse that the receiver times; 0 ends a pulse."""
        with self._lock:
            self._require()
            return self._send(duration > 0, duration)

    def answer(self, number: int) -> Answer:
        """Return the outcome of a request."""
        if self._client is None:
            return Answer.UNREPORTED
        future = self._futures.get(number)
        if future is None or not future.done():
            return Answer.PENDING
        return Answer.DONE if future.result().success else Answer.REFUSED

    def _send(self, on: bool, duration: float) -> int:
        self._number += 1
        if self._client is not None:
            self._futures[self._number] = self._client.call_async(SetBool.Request(data=on))
            for old in [n for n in self._futures if n <= self._number - KEPT_REQUESTS]:
                self._client.remove_pending_request(self._futures.pop(old))
        elif self._publisher is not None:
            self._publisher.publish(self._message(on, duration))
        return self._number

    def _message(self, on: bool, duration: float) -> Bool | Float64 | Float64MultiArray:
        if self._section.interface == "topic":
            return Bool(data=on)
        if self._section.interface == "pulse":
            return Float64(data=duration)
        return Float64MultiArray(data=[1.0 if on else 0.0])

    def _present(self) -> bool:
        if self._client is not None:
            return bool(self._client.service_is_ready())
        return self._publisher is not None and self._publisher.get_subscription_count() > 0

    def _absence(self) -> str:
        what = "server of the service" if self._client is not None else "subscriber of the topic"
        return (
            f"there is no {what} {self.name}: start the robot's driver, or "
            "correct tapper.output.name and .interface"
        )
