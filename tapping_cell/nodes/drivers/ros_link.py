"""What every way to a robot's own ROS driver has: a node, a thread, a latched stop.

The node and the thread are its own, so that the age of what is heard does not depend on what else
the driver's node does, and so that a driver's blocking call can wait for it.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from tapping_cell.hardware.faults import FaultReason, HardwareFault

POLL_S = 0.05


class RosLink(ABC):
    """A link whose topics are open as long as the object: who comes later is found at the next
    ``open``.

    A subclass makes its topics and services on ``_node``, then calls ``_start``. It notifies
    ``_heard`` of news; ``_lock`` keeps what is sent and a stop apart.
    """

    def __init__(self, parent: Node, suffix: str) -> None:
        self._heard = threading.Condition()
        self._lock = threading.Lock()
        self._open = False
        self._stopped = False
        self._node = Node(
            f"{parent.get_name()}_{suffix}",
            namespace=parent.get_namespace(),
            context=parent.context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._executor = SingleThreadedExecutor(context=parent.context)
        self._executor.add_node(self._node)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._spin, name=self._node.get_name(), daemon=True)

    @property
    @abstractmethod
    def name(self) -> str:
        """Of what the link leads to."""

    @property
    def is_open(self) -> bool:
        """Whether the other side was there at the last ``open``."""
        return self._open

    def now(self) -> float:
        """The steady clock, s."""
        return time.monotonic()

    def open(self, timeout: float) -> None:
        """Wait until the other side takes what is sent.

        Raises HardwareFault: PORT_MISSING, STOPPED.
        """
        self._open = False
        deadline = self.now() + timeout
        while not self._present():
            if self._stopped:
                raise self._stop_fault()
            if self.now() >= deadline:
                raise HardwareFault(FaultReason.PORT_MISSING, self._absence())
            time.sleep(POLL_S)
        self._found()
        self._open = True

    def close(self) -> None:
        """Use the other side no more; the topics stay open."""
        self._open = False

    def destroy(self) -> None:
        """Close the topics and end the thread."""
        self.close()
        self._ended.set()
        self._executor.wake()
        self._thread.join(5.0)
        self._executor.shutdown()
        self._before_destruction()
        self._node.destroy_node()

    def release(self) -> None:
        """End the latch of ``stop``."""
        self._stopped = False

    def wait(self, duration: float) -> None:
        """Wait for news, for up to ``duration`` s.

        Raises HardwareFault: STOPPED, DISCONNECTED.
        """
        self._require()
        with self._heard:
            self._heard.wait(max(duration, 0.0))
        self._require()

    @abstractmethod
    def _present(self) -> bool:
        """Whether the other side is there."""

    @abstractmethod
    def _absence(self) -> str:
        """What is said where it is not."""

    def _found(self) -> None:  # noqa: B027 - most links have nothing to do
        """It is there: forget what was heard before."""

    def _before_destruction(self) -> None:  # noqa: B027
        """Destroy what the node does not destroy with itself."""

    def _start(self) -> None:
        self._thread.start()

    def _publishers(self, topic: str) -> list[str]:
        """Other nodes that publish on a topic."""
        own = self._node.get_name(), self._node.get_namespace()
        return sorted(
            f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            for info in self._node.get_publishers_info_by_topic(topic)
            if (info.node_name, info.node_namespace) != own
        )

    def _require(self) -> None:
        if self._stopped:
            raise self._stop_fault()
        if not self._open:
            raise HardwareFault(
                FaultReason.DISCONNECTED, f"{self.name} is not connected: connect first"
            )

    def _stop_fault(self) -> HardwareFault:
        return HardwareFault(
            FaultReason.STOPPED, f"{self.name} was stopped: make the cell safe, clear the fault"
        )

    def _spin(self) -> None:
        try:
            while not self._ended.is_set():
                self._executor.spin_once(timeout_sec=0.5)
        except ExternalShutdownException:
            return
