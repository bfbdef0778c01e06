"""Subscriptions that a node polls, so that frequent messages do not wake its executor."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription


class _NeverCalled(CallbackGroup):
    """Group whose subscriptions the executor does not wait for."""

    def can_execute(self, entity: Any) -> bool:
        """Return False: :class:`PolledTopics` takes the messages."""
        return False


class PolledTopics:
    """Subscriptions whose messages wait in the middleware until they are taken.

    For each message, rclpy's executor builds its wait set again; this takes 0.1 to 0.2 ms. A node
    that only stores messages can instead take many messages at once. The depth of a topic's QoS
    profile is the maximum number of messages of this topic that the middleware keeps.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = _NeverCalled()
        self._subscriptions: dict[str, Subscription] = {}

    def add(self, kind: type, topic: str, profile: QoSProfile) -> None:
        """Subscribe to a topic."""
        self._subscriptions[topic] = self._node.create_subscription(
            kind, topic, _ignore, profile, callback_group=self._group, raw=True
        )

    def close(self) -> None:
        """End the subscriptions."""
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def take(self, topics: Iterable[str]) -> Iterator[tuple[str, bytes, int]]:
        """Yield topic, serialised message and time of reception (ns, system clock; 0 if unknown)
        of every waiting message, topic by topic."""
        for topic in topics:
            subscription = self._subscriptions[topic]
            with subscription.handle:
                while taken := subscription.handle.take_message(subscription.msg_type, True):
                    data, info = taken
                    yield topic, data, info["received_timestamp"]


def _ignore(_: object) -> None:
    """Do nothing; rclpy requires a callback, although it is never called."""
