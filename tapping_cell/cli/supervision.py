"""Which node of a running graph is started again after its end, and when the graph gives up."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from tapping_cell.cli.graph import RECORDER, Ended, Graph, NodeDied

MOST_RESTARTS = 3
WINDOW_S = 120.0
"""A node that ends for the fourth time within this is not started again."""
DELAY_S = 1.0
"""From the end of a node to its new start."""
ASIDE = (RECORDER, "operator_page")
"""The cell positions objects without them: their end never ends the others."""


@dataclass(frozen=True, slots=True)
class Incident:
    """Something that happened to a node, for people."""

    node: str
    sentence: str
    """What happened, with the node's last words, and what is done about it."""
    given_up: bool = False


class Supervisor:
    """Starts nodes again that end by themselves. Call :meth:`look` some times a second."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._restarts: dict[str, deque[float]] = {}
        self._due: dict[str, float] = {}
        self.left_alone: dict[str, str] = {}
        """Nodes beside the cell's work that ended too often, and why."""

    def look(self, now: float) -> list[Incident]:
        """What happened since the last time; ``now`` on a steady clock, s.

        Raises:
            NodeDied: a node that the cell cannot work without ended too often.
        """
        incidents = [
            self._ended(ended, now)
            for ended in self._graph.ended()
            if ended.name not in self._due and ended.name not in self.left_alone
        ]
        for name in [name for name, due in self._due.items() if now >= due]:
            del self._due[name]
            self._graph.restart(name)
        return incidents

    def _ended(self, ended: Ended, now: float) -> Incident:
        recent = self._restarts.setdefault(ended.name, deque())
        while recent and now - recent[0] > WINDOW_S:
            recent.popleft()
        if len(recent) < MOST_RESTARTS and not ended.refused:
            recent.append(now)
            self._due[ended.name] = now + DELAY_S
            return Incident(
                ended.name,
                f"{ended.sentence}; it is started again ({len(recent)} of {MOST_RESTARTS})",
            )
        if ended.name not in ASIDE:
            often = "" if ended.refused else f" {MOST_RESTARTS + 1} times in {WINDOW_S:.0f} s"
            raise NodeDied(f"the cell cannot work without {ended.name}:{often} {ended.sentence}")
        self.left_alone[ended.name] = ended.sentence
        return Incident(
            ended.name, f"{ended.sentence}; it is left alone, the cell works without it", True
        )
