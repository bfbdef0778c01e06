"""Invariant of stops whose release cannot be queried: a person confirms before they are cleared.

A publisher of ``emergency_stop`` that vanishes while it asserts its stop cannot be queried any
more, and a volatile publisher does not repeat its level. In both cases, a node must refuse the
first request to clear its stop. It clears the stop only at a second request that a person made
after the refusal and soon, if no new stop arrived in between.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

CONFIRM_S = 30.0
"""Time, s, after the refusal within which the second request must be made."""
ROUNDING_S = 1e-6
"""Tolerance for the rounding of times on the processes' clocks."""
INSTRUCTION = "clear the stop again within"
"""Part of the message of a refusal that asks a person to confirm."""


@dataclass(frozen=True, slots=True)
class ClearRequest:
    """A person's request to clear the stop of a node. ``received``: time at which the node's
    process received the request, s. ``volatile``: volatile publishers of ``emergency_stop`` at this
    time."""

    node: str
    received: float
    volatile: frozenset[str]


@dataclass(slots=True)
class StopConfirmation:
    """Stops of each node that must be confirmed, and their refusals. Times are in s from the start
    of the run."""

    violate: Callable[[str, str], None]
    _told: dict[int, set[str]] = field(default_factory=dict)
    """For each publisher that asserts its stop, the nodes whose process has received this stop."""
    _vanished: set[int] = field(default_factory=set)
    """Publishers that have vanished while they asserted their stop."""
    _doubtful: set[str] = field(default_factory=set)
    """Nodes with a stop whose publisher has vanished while it asserted this stop."""
    _told_late: set[str] = field(default_factory=set)
    """Nodes that received such a stop only after its publisher had vanished."""
    _refused: dict[str, list[float]] = field(default_factory=dict)
    """For each node, the times of its refusals since the last stop."""
    _latched: set[str] = field(default_factory=set)
    """Nodes that have published that a stop is latched."""
    _cleared: set[str] = field(default_factory=set)
    """Nodes that have published that their stop is cleared, until the answer to the request."""

    def press(self, publisher: int) -> None:
        """Process the beginning of a publisher's stop."""
        self._told[publisher] = set()

    def release(self, publisher: int) -> None:
        """Process the end of a publisher's stop."""
        self._told.pop(publisher, None)

    def vanish(self, publisher: int) -> None:
        """Process that a publisher has vanished while it asserted its stop."""
        self._doubtful |= self._told[publisher]
        self._vanished.add(publisher)

    def needs_confirmation(self, node: str) -> bool:
        """Return whether the stop of a node must be confirmed, because its publisher has
        vanished."""
        return node in self._doubtful or node in self._told_late

    def on_level(self, node: str, level: bool, publisher: int | None) -> None:
        """Process a level that the node's process has received. ``publisher``: the publisher that
        may vanish, None for other publishers."""
        if level:
            self.on_stop(node)
        else:
            # The message does not identify its publisher, and the vanished one was never known.
            self._told_late.discard(node)
        if level and publisher in self._vanished:
            self._told_late.add(node)
        elif level and publisher in self._told:
            self._told[publisher].add(node)

    def on_stop(self, node: str) -> None:
        """Process a stop that the node's process has received: it cancels an earlier refusal."""
        self._refused.pop(node, None)

    def on_process_lost(self, node: str) -> None:
        """Process the end of the node's process, which also forgets its refusals."""
        self._refused.pop(node, None)
        if node in self._told_late:
            self._told_late.discard(node)
            self._doubtful.add(node)

    def on_stop_state(self, node: str, stopped: bool) -> None:
        """Process a stop state that the node has published."""
        if stopped:
            self._latched.add(node)
        elif node in self._latched:
            self._latched.discard(node)
            self._cleared.add(node)

    def on_answer(
        self,
        request: ClearRequest,
        success: bool,
        sentence: str,
        volatile: frozenset[str],
        now: float,
    ) -> bool:
        """Check the answer to a request; return whether the request has cleared the node's stop.
        ``volatile``: publishers that are volatile now."""
        node = request.node
        if not success and INSTRUCTION in sentence:
            self._refused.setdefault(node, []).append(now)
        if node not in self._cleared:
            return False
        # An internal error may have followed after the stop was cleared.
        silent = sorted(volatile & request.volatile)
        waited = min(
            (
                request.received - refused
                for refused in self._refused.pop(node, [])
                if refused <= request.received + ROUNDING_S
            ),
            default=math.inf,
        )
        if (self.needs_confirmation(node) or silent) and waited > CONFIRM_S + ROUNDING_S:
            why = (
                "whose publisher had vanished while it asserted the stop"
                if self.needs_confirmation(node)
                else f"although {', '.join(silent)} does not repeat its level"
            )
            since = "without a refusal" if math.isinf(waited) else f"{waited:.2f} s after a refusal"
            self.violate(
                "cleared without confirmation",
                f"{node} has cleared a stop {why}, at a request made {since}",
            )
        self._cleared.discard(node)
        self._doubtful.discard(node)
        self._told_late.discard(node)
        for told in self._told.values():
            told.discard(node)
        return True
