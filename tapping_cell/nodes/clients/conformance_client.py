"""Client that connects the stage of a conformance check to one running node."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rclpy.client import Client
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from tapping_cell import messages
from tapping_cell.configuration.cell import Cell
from tapping_cell.conformance.stage import STRANGER, Duty, Stage, Steps
from tapping_cell.logic.clock import Now
from tapping_cell.nodes.authority import contest
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.clients.client_node import ClientNode
from tapping_cell.nodes.message_conversion import from_ros, ros_class, to_ros

NAME = "conformance"
STEP_S = 0.005
DISCOVERY_S = 1.5
"""Time after which all nodes of the domain are discovered."""
STATES = {
    "arm_state": messages.ArmState,
    "tapper_state": messages.TapperState,
    "object_states": messages.ObjectStates,
    "plan_state": messages.PlanState,
    "emergency_stop": messages.Bool,
}
COMMANDS = {"tap_command": messages.TapCommand, "goal_pose": messages.PoseStamped}
TYPES: Mapping[str, Any] = {**STATES, **COMMANDS}


class NotAlone(RuntimeError):
    """Other nodes publish what the checks must publish. The message names the topics, the nodes and
    the remedy."""


class ConformanceClient(ClientNode):
    """Plays all nodes of a cell but one. Use as a context manager."""

    def __init__(
        self,
        node: str,
        cell: Cell,
        plays: Sequence[str],
        listens: Sequence[str],
        namespace: str = "",
    ) -> None:
        super().__init__(NAME, namespace)
        self.stage = Stage(cell, self)
        self._tested = node
        self._stranger: Node | None = None
        self._clients: dict[str, Client] = {}
        topics = [*plays, *(("emergency_stop",) if plays else ())]
        self._publishers = {topic: _publisher(self.node, topic) for topic in topics}
        self._strangers: dict[str, Publisher] = {}
        for topic in listens:
            self.node.create_subscription(
                ros_class(TYPES[topic].ROS_TYPE), topic, self._receiver(topic), _quality(topic, 100)
            )
        if "arm_state" in plays:
            kind = ros_class("tapping_cell_msgs/srv/HoldStill")
            self.node.create_service(kind, "hold_still", self._hold_still)

    def check_alone(self) -> None:
        """Raise :class:`NotAlone` if other nodes publish what this client publishes."""
        time.sleep(DISCOVERY_S)
        topics = self._publishers.keys() - {"emergency_stop"}
        shared = list(filter(None, (contest(self.node, topic) for topic in sorted(topics))))
        if shared:
            raise NotAlone(
                f"{'; '.join(shared)}. The checks play all nodes but {self._tested}: run only this"
                " node (and sim_world) in this ROS domain"
            )

    def check(self, begin: Callable[[Stage], Steps], duty: Duty) -> str:
        """Check one duty; return what was found wrong, or ''."""
        return self.stage.check(begin, duty, lambda: time.sleep(STEP_S))

    # Link of the stage

    def now(self) -> Now:
        """Return the present time."""
        return Now(time.monotonic(), self.node.get_clock().now().nanoseconds)

    def publish(self, topic: str, message: Any, stranger: bool) -> None:
        """Publish a message. ``stranger``: as a further node."""
        if stranger and topic not in self._strangers:
            namespace = self.node.get_namespace()
            self._stranger = Node(STRANGER, context=self._context, namespace=namespace)
            self._strangers[topic] = _publisher(self._stranger, topic)
        publishers = self._strangers if stranger else self._publishers
        publishers[topic].publish(to_ros(message))

    def dismiss_stranger(self) -> None:
        """Remove the further node."""
        self._strangers.clear()
        if self._stranger is not None:
            self._stranger.destroy_node()
            self._stranger = None

    def call(self, service: str, request: Any, on_answer: Callable[[Any], None]) -> None:
        """Call a service of the node under test; ``~/`` stands for its name."""
        name = service.replace("~", self._tested)
        kind = type(request).ROS_TYPE.partition(".")[0]
        if name not in self._clients:
            self._clients[name] = self.node.create_client(ros_class(kind), name)
        client, made = self._clients[name], to_ros(request)
        response = getattr(messages, kind.rpartition("/")[2]).Response
        self._executor.create_task(
            lambda: client.call_async(made).add_done_callback(
                lambda done: on_answer(from_ros(done.result(), response))
            )
        )

    def _receiver(self, topic: str) -> Callable[[Any], None]:
        return lambda message: self.stage.receive(topic, from_ros(message, TYPES[topic]))

    def _hold_still(self, request: Any, response: Any) -> Any:
        asked = from_ros(request, messages.HoldStill.Request)
        return to_ros(self.stage.hold_still(asked))


def _publisher(node: Node, topic: str) -> Publisher:
    return node.create_publisher(ros_class(TYPES[topic].ROS_TYPE), topic, _quality(topic))


def _quality(topic: str, depth: int = 1) -> QoSProfile:
    profile = LATCHED if topic in STATES else COMMAND
    return QoSProfile(
        depth=max(depth, profile.depth),
        reliability=profile.reliability,
        durability=profile.durability,
    )
