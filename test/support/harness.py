"""Real nodes in one process over real DDS, with devices on real pseudo-terminals."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from tapping_cell_msgs.msg import ObjectState, ObjectStates

from tapping_cell.nodes.cell_node import LATCHED

TIMEOUT_S = 60.0
"""Timeout, long enough for a slow and busy machine. Tests wait for events, not for a fixed time."""


class Bench:
    """A context with the nodes under test and a node that communicates with them. An executor in a
    thread spins all these nodes."""

    def __init__(self) -> None:
        self.probe: Node | None = None
        self.received: dict[str, list[Any]] = {}

    def listen(self, kind: type, topic: str, profile: object = 10) -> list[Any]:
        """Return a list that receives all messages of a topic from now on."""
        messages: list[Any] = self.received.setdefault(topic, [])
        assert self.probe is not None
        self.probe.create_subscription(kind, topic, messages.append, profile)
        return messages

    def listen_own_object(self) -> list[ObjectState]:
        """Return a list that receives the states of the cell's own object from now on."""
        states: list[ObjectState] = self.received.setdefault("own object", [])
        assert self.probe is not None
        self.probe.create_subscription(
            ObjectStates,
            "object_states",
            lambda message: states.append(message.objects[0]),
            LATCHED,
        )
        return states

    def wait(self, condition: Callable[[], object], what: str, patience: float = TIMEOUT_S) -> None:
        """Wait until the condition holds; otherwise fail with ``what`` and the last message of each
        observed topic."""
        deadline = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < deadline, (
                f"waited {patience:.0f} s in vain: {what}; last received: "
                f"{ {topic: messages[-1:] for topic, messages in self.received.items()} }"
            )
            time.sleep(0.01)


@contextmanager
def bench(
    make_nodes: Callable[[], list[Node]],
    parameters: dict[str, dict[str, object]],
    remappings: Sequence[str] = (),
) -> Iterator[Bench]:
    """Run nodes with these parameters, given by node name. The nodes end at the end of the ``with``
    block."""
    made = Bench()
    arguments = ["--ros-args"]
    for rule in remappings:
        arguments += ["-r", rule]
    for node, values in parameters.items():
        for key, value in values.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            arguments += ["-p", f"{node}:{key}:={text}"]
    # Unreferenced objects of an earlier test may still keep its participant and endpoints in
    # existence. A count of subscriptions would then be too high.
    gc.collect()
    # The nodes use the default context, as in production.
    rclpy.init(args=arguments)
    made.probe = Node("probe")
    executor = SingleThreadedExecutor()
    executor.add_node(made.probe)
    nodes = make_nodes()
    for node in nodes:
        executor.add_node(node)
    errors: list[BaseException] = []
    ended = threading.Event()

    def spin() -> None:
        # Shutting the executor down during a callback would raise an exception there, so the loop
        # ends by itself.
        try:
            while not ended.is_set():
                executor.spin_once()
        except ExternalShutdownException:
            return
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield made
    finally:
        ended.set()
        executor.wake()
        thread.join(5.0)
        for node in nodes:
            node.cleanup()
        executor.shutdown()
        for node in (*nodes, made.probe):
            node.destroy_node()
        rclpy.try_shutdown()
    assert not errors, f"a node failed: {errors[0]!r}"
