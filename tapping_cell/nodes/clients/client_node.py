"""Common base of the clients of a running cell: a node with its own context and thread."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

DISCOVERY_S = 1.0
"""Time in s within which a client discovers the nodes of a running cell."""

Self = TypeVar("Self", bound="ClientNode")
T = TypeVar("T")


class ClientNode:
    """Node that is spun in a thread while its context manager is active."""

    def __init__(self, name: str, namespace: str = "") -> None:
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node(name, namespace=namespace, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._began = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._spin, name=name, daemon=True)

    def __enter__(self: Self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        # The thread ends first, because rclpy's shutdown does not wait for a running callback.
        self._ended.set()
        self._thread.join(2.0)
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        try:
            while not self._ended.is_set():
                self._executor.spin_once(timeout_sec=0.1)
        except ExternalShutdownException:
            return

    def is_alone(self) -> bool:
        """Return whether no other node was discovered, although there was time for it."""
        if time.monotonic() < self._began + DISCOVERY_S:
            return False
        found = self.node.get_node_names_and_namespaces()
        own = (self.node.get_name(), self.node.get_namespace())
        return all(each == own or each[0].startswith("_") for each in found)

    def no_answer(self) -> str:
        """Return the message for a user whose cell does not answer."""
        domain, namespace = self.node.context.get_domain_id(), self.node.get_namespace()
        return (
            f"no cell answers in ROS domain {domain}, namespace '{namespace}': start one with"
            " python -m tapping_cell up, or choose the cell with ROS_DOMAIN_ID and --namespace"
        )

    def in_executor(self, function: Callable[[], T], patience: float = 5.0) -> T:
        """Call a function in the executor's thread and return its result.

        Raises:
            TimeoutError: the executor did not run the function in time.
        """
        found: queue.Queue[T] = queue.Queue()
        self._executor.create_task(lambda: found.put(function()))
        try:
            return found.get(timeout=patience)
        except queue.Empty:
            raise TimeoutError(
                f"this program's ROS thread did not respond within {patience:.0f} s"
            ) from None

    def result_of(self, start: Callable[[], Future], patience: float) -> Any:
        """Start a call in the executor's thread and return its result.

        Another thread must not start a call: the response could arrive before rclpy has registered
        the request, and would be lost.

        Raises:
            TimeoutError: there was no response in time.
        """
        answers: queue.Queue[Any] = queue.Queue()
        self._executor.create_task(
            lambda: start().add_done_callback(lambda done: answers.put(done.result()))
        )
        try:
            return answers.get(timeout=patience)
        except queue.Empty:
            raise TimeoutError(f"there was no response within {patience:.0f} s") from None

    def keeper(self, attribute: str) -> Callable[[Any], None]:
        """Return a subscription callback that stores the last message in an attribute."""
        return lambda message: setattr(self, attribute, message)
