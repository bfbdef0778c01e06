"""Virtual time with events at given times."""

from __future__ import annotations

from collections.abc import Callable


class EventClock:
    """A time, in s, that passes only in :meth:`sleep`, and the actions that are due meanwhile."""

    def __init__(self, time: float) -> None:
        self.time = time
        self.events: list[tuple[float, Callable[[], object]]] = []

    def sleep(self, duration: float) -> None:
        """Let time pass, and run the actions that become due."""
        end = self.time + duration
        while self.events and self.events[0][0] <= end:
            self.time, action = self.events.pop(0)
            action()
        self.time = max(end, self.time)
        assert self.time < 1e4, "a call does not end"

    def after(self, duration: float, action: Callable[[], object]) -> None:
        """Run an action ``duration`` s from now."""
        self.events.append((self.time + duration, action))
        self.events.sort(key=lambda event: event[0])
