"""Model of topics and services between nodes, with the delays and duplicates of DDS."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from lab.virtual_cell.scheduler import Scheduler
from tapping_cell.logic.host import ONE_PUBLISHER, ONE_SERVER

SERVICE_TIMEOUT_S = 1.0
"""Default timeout of a service call."""

STRANGER = "somebody_else"
"""Name of a program that is not part of the cell."""
STRANGER_S = 1.0
"""Time for which that program remains after its last message, s."""
LINGERS_S = 3.0
"""Minimum time for which a node that was killed remains in the graph, s: the lease of the Fast DDS
profile without the period of its announcements."""
STANDS_IN = {"program": "tap_planner"}
"""Programs whose messages stand for those of a node of the cell."""

Deliver = Callable[[str, Any], None]
"""Callback with the topic and the message."""
Handle = Callable[[Any, Callable[[Any], None]], None]
"""Callback with the request and a function that sends the answer."""


@dataclass(slots=True)
class Quality:
    """Quality of service of a topic. ``latched``: whether its durability is transient local.
    ``depth``: queue depth of a subscription; older messages are lost."""

    latched: bool = False
    depth: int = 10


@dataclass(slots=True)
class LinkFaults:
    """Active faults of the network. Delays are in s."""

    usual_delay: tuple[float, float] = (0.0003, 0.002)
    duplicates: float = 0.0
    """Fraction of messages that arrive twice."""
    slow: dict[tuple[str, str], float] = field(default_factory=dict)
    """Additional delay in s, by (topic, subscriber) or by (service, ``request`` or ``answer``)."""


@dataclass(slots=True, eq=False)
class _Link:
    """Connection of a topic to one subscriber. It preserves the order of the messages."""

    subscriber: str
    deliver: Deliver
    free_at: float = 0.0


class Network:
    """Transport of all messages between nodes. Publishers are identified by their nodes' names."""

    def __init__(
        self, scheduler: Scheduler, rng: np.random.Generator, qualities: dict[str, Quality]
    ) -> None:
        self.faults = LinkFaults()
        self.history: dict[str, deque[Any]] = {}
        """Last messages of each topic, for replays."""
        self.on_publish: Callable[[str, str, Any], None] = lambda node, topic, message: None
        """Called for every message that a node publishes."""
        self.on_call: Callable[[str, Any], None] = lambda service, request: None
        """Called when a service is called."""
        self.on_answer: Callable[[str, str, Any, Any], None] = lambda *_: None
        """Called with node, service, request and response when a node answers."""
        self._scheduler = scheduler
        self._rng = rng
        self._qualities = qualities
        self._links: dict[str, list[_Link]] = {}
        self._last: dict[str, dict[str, Any]] = {}
        self._volatile: dict[str, set[str]] = {}
        """Volatile publishers of each latched topic."""
        self._servers: dict[str, dict[str, Handle]] = {}
        self._publishers: dict[str, dict[str, float]] = {topic: {} for topic in ONE_PUBLISHER}
        """Time of the last message of each publisher of these topics."""
        self._killed: dict[str, float] = {}
        """Time at which a node was killed that has not published again."""

    def subscribe(self, node: str, topic: str, deliver: Deliver) -> None:
        """Subscribe to a topic; latched messages are sent immediately."""
        link = _Link(node, deliver)
        self._links.setdefault(topic, []).append(link)
        if self._quality(topic).latched:
            for message in self._last.get(topic, {}).values():
                self._send(link, topic, message)

    def publish(
        self, node: str, topic: str, message: Any, only: str = "", volatile: bool = False
    ) -> None:
        """Send a message to all subscribers of the topic. ``only``: the one node that receives the
        message; the message is lost for all other nodes, as can happen with best-effort delivery.
        ``volatile``: whether the publisher is volatile although the topic is latched.

        A stranger sends nothing on a topic that no node of the cell publishes at the time: without
        SROS 2, a node that is alone is the one that the others trust."""
        publishers = self._publishers.get(topic)
        if node == STRANGER and publishers is not None and publishers.keys() <= {STRANGER}:
            return
        self.on_publish(node, topic, message)
        self.history.setdefault(topic, deque(maxlen=20)).append(message)
        self._killed.pop(node, None)
        if topic in self._publishers:
            self._publishers[topic][STANDS_IN.get(node, node)] = self._scheduler.now
        if volatile:
            self._volatile.setdefault(topic, set()).add(node)
        elif self._quality(topic).latched:
            self._last.setdefault(topic, {})[node] = message
        for link in self._links.get(topic, ()):
            if only in ("", link.subscriber):
                self._send(link, topic, message)

    def depth(self, topic: str) -> int:
        """Return the queue depth of a topic's subscriptions."""
        return self._quality(topic).depth

    def end_delay(self, topic: str, towards: str) -> None:
        """End the additional delay of a link."""
        self.faults.slow.pop((topic, towards), None)

    def latched(self, topic: str) -> dict[str, Any]:
        """Return the last latched message of each publisher that is still present, by name."""
        return dict(self._last.get(topic, {}))

    def volatile(self, topic: str) -> frozenset[str]:
        """Return the volatile publishers of a latched topic that are still present."""
        return frozenset(self._volatile.get(topic, ()))

    def serve(self, node: str, service: str, handle: Handle) -> None:
        """Offer a service: ``handle(request, answer)``. If several nodes offer the same service,
        each of them receives every request, and the first answer counts."""
        self._servers.setdefault(service, {})[node] = handle

    def conflict(self) -> str:
        """Return which topics several nodes publish and whether several nodes offer
        ``hold_still``."""
        now = self._scheduler.now
        for node in [name for name, at in self._killed.items() if now > at + LINGERS_S]:
            self._forget_publisher(node)
        gone = now - STRANGER_S
        contested = [(topic, found) for topic, found in self._publishers.items() if len(found) > 1]
        providers = {
            topic: [name for name, last in found.items() if name != STRANGER or last > gone]
            for topic, found in contested
        }
        providers |= {service: list(self._servers.get(service, ())) for service in ONE_SERVER}
        return "; ".join(
            f"{name} of {', '.join(nodes)}" for name, nodes in providers.items() if len(nodes) > 1
        )

    def impostor(self, service: str) -> str:
        """Return a sentence if the server of a service is not the node that publishes the topic
        that belongs to it."""
        strange = self._servers.get(service, {}).keys() - self._publishers[ONE_SERVER[service]]
        return f"{service} of {', '.join(sorted(strange))}" if strange else ""

    def call(
        self,
        service: str,
        request: Any,
        on_answer: Callable[[Any | None], None],
        timeout: float = SERVICE_TIMEOUT_S,
    ) -> None:
        """Call a service; ``on_answer`` receives None if no answer arrives within ``timeout`` s."""
        answered = False
        self.on_call(service, request)

        def finish(response: Any | None) -> None:
            nonlocal answered
            if not answered:
                answered = True
                on_answer(response)

        def answer(node: str, response: Any) -> None:
            self.on_answer(node, service, request, response)
            self._scheduler.after(self._delay(service, "answer"), lambda: finish(response))

        def arrive() -> None:
            for node, handle in self._servers.get(service, {}).items():
                handle(request, partial(answer, node))

        self._scheduler.after(self._delay(service, "request"), arrive)
        self._scheduler.after(timeout, lambda: finish(None))

    def leave(self, node: str, killed: bool = False) -> None:
        """Remove a node with its subscriptions, services and latched messages. A node that was
        killed counts as a publisher for some more time."""
        for topic, links in self._links.items():
            self._links[topic] = [link for link in links if link.subscriber != node]
        for kept in self._last.values():
            kept.pop(node, None)
        for publishers in self._volatile.values():
            publishers.discard(node)
        for servers in self._servers.values():
            servers.pop(node, None)
        if killed:
            self._killed[node] = self._scheduler.now
        else:
            self._forget_publisher(node)

    def _forget_publisher(self, node: str) -> None:
        self._killed.pop(node, None)
        for found in self._publishers.values():
            found.pop(node, None)

    def _quality(self, topic: str) -> Quality:
        return self._qualities.get(topic, Quality())

    def _delay(self, topic: str, towards: str) -> float:
        low, high = self.faults.usual_delay
        return low + (high - low) * self._rng.random() + self.faults.slow.get((topic, towards), 0.0)

    def _send(self, link: _Link, topic: str, message: Any) -> None:
        times = 2 if self._rng.random() < self.faults.duplicates else 1
        for _ in range(times):
            due = max(self._scheduler.now + self._delay(topic, link.subscriber), link.free_at)
            link.free_at = due
            self._scheduler.at(due, lambda: self._arrive(link, topic, message))

    def _arrive(self, link: _Link, topic: str, message: Any) -> None:
        if link in self._links.get(topic, ()):
            link.deliver(topic, message)
