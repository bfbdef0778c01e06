"""Supervision of a running graph: which nodes are restarted, and when the graph is shut down."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from tapping_cell.cli.graph import (
    IMAGES,
    IMAGES_DELAY_S,
    RECORDER,
    Ended,
    Graph,
    NodeDied,
)
from tapping_cell.nodes.service_manager import Notifications

MAX_RESTARTS = 3
WINDOW_S = 120.0
"""Time window in s. A node that ends for the fourth time within this window is not restarted."""
DELAY_S = 1.0
"""Delay in s between the end of a node and its restart, except for the nodes in ``IMAGES``."""
HUNG_S = 20.0
"""Time in s without a report of a node's loop, after which the node is killed and restarted. A node
reports every second."""
STEP_S = 1.0
"""Longest time in s that counts as silence between two checks. While this process or the computer
was suspended, the nodes could not report either."""
ASIDE = (RECORDER, "operator_page")
"""Nodes that the cell does not need for positioning. If one of these nodes ends, all other nodes
continue."""


@dataclass(frozen=True, slots=True)
class Incident:
    """Event of a node, to be reported to the user."""

    node: str
    sentence: str
    """The event, the node's last output, and how the supervisor reacts."""
    given_up: bool = False


class Supervisor:
    """Restart nodes that end unexpectedly or whose loop hangs. Call :meth:`check` several times per
    second."""

    def __init__(self, graph: Graph, notifications: Notifications | None = None) -> None:
        self._graph = graph
        self._notifications = notifications
        self._silence: dict[int, float] = {}
        """Time since the last report of each process that has reported, s."""
        self._checked = 0.0
        self._hung: set[str] = set()
        self._restarts: dict[str, deque[float]] = {}
        self._due: dict[str, float] = {}
        self.left_alone: dict[str, str] = {}
        """Optional nodes that are no longer restarted, with the reasons."""

    def check(self, now: float) -> list[Incident]:
        """Return the events since the last call. ``now`` is a monotonic time in s.

        Raises:
            NodeDied: a required node ended too often, or rejected its parameters or files.
        """
        self._kill_hung(now)
        incidents = [
            self._ended(ended, now)
            for ended in self._graph.ended()
            if ended.name not in self._due and ended.name not in self.left_alone
        ]
        for name in [name for name, due in self._due.items() if now >= due]:
            del self._due[name]
            self._graph.restart(name)
        return incidents

    def _kill_hung(self, now: float) -> None:
        """Kill the nodes whose loop has not run for HUNG_S."""
        if self._notifications is None:
            return
        passed, self._checked = min(now - self._checked, STEP_S), now
        alive = self._notifications.alive()
        for name, process in self._graph.process_ids.items():
            if process in alive:
                self._silence[process] = 0.0
            elif process in self._silence:
                self._silence[process] += passed
                if self._silence[process] > HUNG_S:
                    del self._silence[process]
                    self._hung.add(name)
                    self._graph.kill(name)

    def _ended(self, ended: Ended, now: float) -> Incident:
        sentence = ended.sentence
        if ended.name in self._hung:
            self._hung.discard(ended.name)
            sentence = f"the node {ended.name} did not respond for {HUNG_S:.0f} s and was killed"
        recent = self._restarts.setdefault(ended.name, deque())
        while recent and now - recent[0] > WINDOW_S:
            recent.popleft()
        if len(recent) < MAX_RESTARTS and not ended.refused:
            recent.append(now)
            self._due[ended.name] = now + (IMAGES_DELAY_S if ended.name in IMAGES else DELAY_S)
            return Incident(
                ended.name,
                f"{sentence}; it is restarted (restart {len(recent)} of at most"
                f" {MAX_RESTARTS} in {WINDOW_S:.0f} s)",
            )
        if ended.name not in ASIDE:
            often = (
                ""
                if ended.refused
                else f", which ended {MAX_RESTARTS + 1} times in {WINDOW_S:.0f} s"
            )
            raise NodeDied(f"the cell cannot work without {ended.name}{often}: {sentence}")
        self.left_alone[ended.name] = sentence
        return Incident(
            ended.name,
            f"{sentence}; it is not restarted, because the cell works without it",
            True,
        )
