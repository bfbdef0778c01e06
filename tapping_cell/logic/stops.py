"""Stops as levels: who holds one, and when a person may reset.

A True on ``emergency_stop`` stops at once and latches. A False ends the hold of that level but
never releases: a person resets with ``clear_fault``. ROS does not tell whose message arrived, so a
reset asks every publisher anew; what holds, refuses. A publisher that vanished cannot be asked: a
person must look at it, and confirms by asking for the reset a second time.
"""

from __future__ import annotations

from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import Content, StopLevels

TOPIC = "emergency_stop"
SERVICE = "service stop"
RESTART = "a stop before the restart"
CONFIRM_WITHIN_S = 30.0
"""A second request so soon after the refusal that asks for it counts as its confirmation."""


class StopLatch:
    """The stops of one actor."""

    def __init__(self) -> None:
        self._sources: list[str] = []
        self._asserted = False
        self._heard = 0
        self._asked = 0
        self._confirm_until = -1.0

    @property
    def stopped(self) -> bool:
        """True from a stop until its reset."""
        return bool(self._sources)

    @property
    def sources(self) -> tuple[str, ...]:
        """What stopped since the last reset."""
        return tuple(self._sources)

    def advice(self) -> str:
        """What a person has to do; empty when not stopped."""
        if not self._sources:
            return ""
        if self._asserted:
            return "release the emergency stop, make the cell safe, then call clear_fault"
        return "make the cell safe, then call clear_fault"

    def content(self) -> Content:
        """What is kept over a restart."""
        return {"sources": list(self._sources), "asserted": self._asserted}

    def recall(self, content: Content | None) -> None:
        """Find the stop of the life before. One that cannot be read counts as a stop."""
        if content is None:
            return
        sources = content.get("sources")
        names = [str(name) for name in sources] if isinstance(sources, list) else []
        for name in names or [RESTART]:
            self._add(name)
        self._asserted = self._asserted or content.get("asserted") is not False

    def hear(self, level: bool) -> bool:
        """Hear a level of the topic; returns whether it stops anew or changes what is kept."""
        changed = level != self._asserted
        self._asserted = level
        if level:
            self._heard += 1
            changed = self._add(TOPIC) or changed
        return changed and self.stopped

    def press(self, source: str = SERVICE) -> bool:
        """A stop without a level, such as the service's: it latches; returns whether it is new."""
        self._heard += 1
        return self._add(source)

    def begin_reset(self) -> None:
        """A reset is asked for: the publishers are asked for their levels."""
        self._asked = self._heard

    def try_reset(self, levels: StopLevels | None, now: Now) -> str:
        """Reset if the answer of the publishers allows it; returns why not, empty where done."""
        if levels is None:
            return "the publishers of emergency_stop could not be asked; call clear_fault again"
        if self._heard != self._asked:
            return "a stop came while clear_fault was asked for; " + self.advice()
        if levels.asserted:
            self._asserted = True
            names = ", ".join(levels.publishers) or "a publisher that is not known"
            return (
                f"the emergency stop is still held; publishers of emergency_stop: {names}."
                " Release it there, then call clear_fault again"
            )
        if (self._asserted or levels.gone) and now.steady > self._confirm_until:
            self._confirm_until = now.steady + CONFIRM_WITHIN_S
            names = ", ".join(levels.gone) or "not known by name"
            return (
                f"what held the emergency stop ({names}) vanished without releasing it. Go to the"
                " cell and see that nobody is in danger; then call clear_fault again within"
                f" {CONFIRM_WITHIN_S:.0f} s"
            )
        self._sources.clear()
        self._asserted = False
        self._confirm_until = -1.0
        return ""

    def _add(self, source: str) -> bool:
        if source in self._sources:
            return False
        self._sources.append(source)
        return True
