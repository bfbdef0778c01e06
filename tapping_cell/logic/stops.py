"""Latch of the emergency stop: which sources asserted the stop, and when an operator may reset it.

True on the topic ``emergency_stop`` stops immediately and latches the stop. False means only that
the publisher no longer asserts its stop; the latch remains until an operator resets it with
``clear_fault``. A message does not identify its publisher, so a reset queries every publisher again
and is refused if any publisher still asserts the stop. A publisher that has vanished, or that does
not repeat its level, cannot be queried, and a restarted node does not know which publishers have
asserted the stop: a person must then inspect the cell and confirm by requesting the reset again
after the refusal. A new stop cancels the confirmation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import Content, StopLevels

TOPIC = "emergency_stop"
SERVICE = "service stop"
RESTART = "a stop before the restart"
CONFIRM_WITHIN_S = 30.0
"""Time, s, after the refusal of a reset within which another request counts as the operator's
confirmation that the cell is safe."""


@dataclass(frozen=True, slots=True)
class ResetRequest:
    """A request to reset the latch, while the publishers are queried for their levels."""

    stops: int
    """Number of stops received before the request."""
    confirms: bool
    """Whether the request is the operator's confirmation, because it was made after a refusal."""


class StopLatch:
    """Stop latch of one device."""

    def __init__(self) -> None:
        self._sources: list[str] = []
        self._asserted = False
        self._publishers_unknown = False
        """Whether a stop of ``emergency_stop`` was latched by an earlier process of this node, so
        that its publishers are not known. Only a reset ends this doubt."""
        self._received = 0
        self._confirm_until = -math.inf

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched."""
        return bool(self._sources)

    @property
    def sources(self) -> tuple[str, ...]:
        """Sources of the stops since the last reset."""
        return tuple(self._sources)

    def advice(self) -> str:
        """Return what a person has to do to clear the stop; empty if no stop is latched."""
        if not self._sources:
            return ""
        if self._asserted:
            return "release the emergency stop, make the cell safe, then clear the stop"
        return "make the cell safe, then clear the stop"

    def content(self) -> Content | None:
        """Return the latched stops as content to be stored for a restart, or None if no stop is
        latched."""
        if not self._sources:
            return None
        return {"sources": list(self._sources), "asserted": self._asserted}

    def recall(self, content: Content | None) -> None:
        """Restore a stop that was latched before a restart. Content that cannot be read counts as a
        stop."""
        if content is None:
            return
        sources = content.get("sources")
        names = [str(name) for name in sources] if isinstance(sources, list) else []
        names = names or [RESTART]
        self._publishers_unknown = TOPIC in names or RESTART in names
        for name in names:
            self._add(name)
        self._asserted = self._asserted or content.get("asserted") is not False

    def receive(self, level: bool) -> bool:
        """Process a level of ``emergency_stop``; return whether the content to be stored has
        changed."""
        changed = level != self._asserted
        self._asserted = level
        if level:
            self._begin_stop()
            changed = self._add(TOPIC) or changed
        return changed and self.stopped

    def press(self, source: str = SERVICE) -> bool:
        """Latch a stop from a source without a level, such as a service call; return whether this
        stop is new."""
        self._begin_stop()
        return self._add(source)

    def begin_reset(self, now: Now) -> ResetRequest:
        """Begin a reset, before the publishers are queried for their levels."""
        return ResetRequest(self._received, now.steady <= self._confirm_until)

    def try_reset(self, request: ResetRequest, levels: StopLevels | None, now: Now) -> str:
        """Reset the latch if the publishers' levels allow this. Return why the latch was not reset,
        or "" if it was reset."""
        if levels is None:
            return "the publishers of emergency_stop could not be determined; clear the stop again"
        if self._received != request.stops:
            return "a stop occurred during clear_fault; " + self.advice()
        if levels.asserted:
            self._asserted = True
            names = ", ".join(levels.publishers) or "an unknown publisher"
            return (
                f"the emergency stop is still held; publishers of emergency_stop: {names}."
                " Release it there, then clear the stop again"
            )
        doubt = self._doubt(levels)
        if doubt and not request.confirms:
            self._confirm_until = now.steady + CONFIRM_WITHIN_S
            return (
                f"{doubt}. Go to the cell and make sure that nobody is in danger; then clear"
                f" the stop again within {CONFIRM_WITHIN_S:.0f} s"
            )
        self._sources.clear()
        self._asserted = self._publishers_unknown = False
        self._confirm_until = -math.inf
        return ""

    def forget_refusal(self) -> None:
        """Cancel the refusal that the next reset would confirm, because it may not have been
        reported."""
        self._confirm_until = -math.inf

    def _doubt(self, levels: StopLevels) -> str:
        """Return why the publishers' levels do not show that the stop is released, or ""."""
        if levels.silent:
            return (
                "it is unknown whether the emergency stop is still pressed, because a publisher"
                " with volatile durability does not repeat its last message"
                f" ({', '.join(levels.silent)})"
            )
        if self._publishers_unknown:
            return (
                "this node was restarted during the emergency stop, so it is unknown whether every"
                " publisher has released it"
            )
        if self._asserted or levels.gone:
            names = ", ".join(levels.gone) or "name unknown"
            return (
                f"the publisher that asserted the emergency stop ({names}) disappeared"
                " without releasing it"
            )
        return ""

    def _begin_stop(self) -> None:
        """Record a new stop, so that a reset under way is refused and an earlier confirmation is
        cancelled."""
        self._received += 1
        self._confirm_until = -math.inf

    def _add(self, source: str) -> bool:
        if source in self._sources:
            return False
        self._sources.append(source)
        return True
