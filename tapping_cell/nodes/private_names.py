"""Private services and topics (``~/NAME``) of the cell's nodes, by the nodes' present names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.client import Client
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger
from tapping_cell_msgs.srv import Jog

STATE_TOPICS = {
    "scara_arm": "arm_state",
    "tapper_trigger": "tapper_state",
    "tap_planner": "plan_state",
    "sim_world": "true_states",
}
"""Topic that only the node of this role publishes."""
KINDS = {"jog": Jog}
"""Services that are not triggers."""
PERIOD_S = 1.0
"""Period at which the names of the nodes are looked up, s."""


class PrivateNames:
    """Clients and subscriptions that follow the nodes of a cell when these are renamed.

    A node is recognised by the state that it alone publishes. While it does not run, its default
    name is used.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._clients: dict[tuple[str, str], Client] = {}
        self._topics: list[_Topic] = []
        node.create_timer(PERIOD_S, self._follow)

    def client(self, role: str, service: str) -> Client:
        """Return the client of the service ``~/SERVICE`` of the node with this role."""
        name, made = self._name(role, service), self._clients.get((role, service))
        if made is None or made.srv_name != name:
            if made is not None:
                self._node.destroy_client(made)
            made = self._clients[role, service] = self._node.create_client(
                KINDS.get(service, Trigger), name
            )
        return made

    def subscribe(
        self,
        kind: type,
        role: str,
        topic: str,
        process: Callable[[Any], None],
        profile: QoSProfile,
    ) -> None:
        """Subscribe to the topic ``~/TOPIC`` of the node with this role."""
        followed = _Topic(kind, role, topic, process, profile)
        self._topics.append(followed)
        self._resubscribe(followed)

    def _follow(self) -> None:
        for role, service in tuple(self._clients):
            self.client(role, service)
        for followed in self._topics:
            self._resubscribe(followed)

    def _resubscribe(self, followed: _Topic) -> None:
        name, made = self._name(followed.role, followed.topic), followed.subscription
        if made is None or made.topic_name != name:
            if made is not None:
                self._node.destroy_subscription(made)
            followed.subscription = self._node.create_subscription(
                followed.kind, name, followed.process, followed.profile
            )

    def _name(self, role: str, private: str) -> str:
        """Return the full name of ``~/PRIVATE`` of the node with this role."""
        infos = self._node.get_publishers_info_by_topic(STATE_TOPICS[role])
        owners = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos}
        if len(owners) == 1:
            name = f"{owners.pop()}/{private}"
            if self._node.count_services(name) or self._node.count_publishers(name):
                return name
        return self._node.resolve_topic_name(f"{role}/{private}")


@dataclass(slots=True)
class _Topic:
    """A subscription that follows a node."""

    kind: type
    role: str
    topic: str
    process: Callable[[Any], None]
    profile: QoSProfile
    subscription: Subscription | None = None
