"""Common base of the links to a robot's own ROS driver: a node, a thread, a latched stop.

A link has its own node and thread. Therefore the age of received messages does not depend on the
load of the driver's node, and a blocking driver call can wait for messages.
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
    """Link whose topics stay open as long as the instance exists, so that ``open`` also finds a
    peer that started after the link.

    A subclass creates its topics and services on ``_node``, then calls ``_start``. The subclass
    notifies the condition ``_received`` when a message arrives. ``_lock`` serialises commands and
    stops.
    """

    def __init__(self, parent: Node, suffix: str) -> None:
        self._received = threading.Condition()
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
        """Name of the peer: a controller, service or topic."""

    @property
    def is_open(self) -> bool:
        """Whether the peer was present at the last ``open``."""
        return self._open

    def now(self) -> float:
        """Return the time of the monotonic clock, in s."""
        return time.monotonic()

    def open(self, timeout: float) -> None:
        """Wait until the peer is ready to receive commands.

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
        """Stop using the peer. The topics stay open."""
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
        """Clear the latch of ``stop``."""
        self._stopped = False

    def wait(self, duration: float) -> None:
        """Wait up to ``duration`` s for a new message.

        Raises HardwareFault: STOPPED, DISCONNECTED.
        """
        self._require()
        with self._received:
            self._received.wait(max(duration, 0.0))
        self._require()

    @abstractmethod
    def _present(self) -> bool:
        """Return whether the peer is present."""

    @abstractmethod
    def _absence(self) -> str:
        """Return the error message for an absent peer."""

    def _found(self) -> None:  # noqa: B027 - most links have nothing to do
        """Discard the data received so far. Called when the peer has been found."""

    def _before_destruction(self) -> None:  # noqa: B027
        """Destroy resources that the node does not destroy itself."""

    def _start(self) -> None:
        self._thread.start()

    def _publishers(self, topic: str) -> list[str]:
        """Return the other nodes that publish on a topic."""
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
