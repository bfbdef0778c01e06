"""Queue of goals, and named goals. This module has no side effects: the page's node sends the
goals.

The queue starts only when a person runs it. From then on, the next goal is sent each time the
current goal has been reached. The queue pauses after any other result, because the cause may also
affect the next goal.
"""

from __future__ import annotations

import itertools

from tapping_cell.nodes.page.requests import RequestedGoal
from tapping_cell.se2 import Pose

MAX_WAITING = 50
MAX_NAMES = 50


class QueueFull(ValueError):
    """The queue or the list of named goals is full. The message states the limit."""


class GoalQueue:
    """Ordered queue of goals."""

    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._waiting: dict[int, RequestedGoal] = {}
        self.running = False
        """Whether the next goal is sent after the current goal was reached."""
        self.held = ""
        """Reason why the queue paused automatically, or an empty text."""

    def rows(self) -> list[tuple[int, RequestedGoal]]:
        """Return the numbers and goals in order."""
        return list(self._waiting.items())

    def add(self, goal: RequestedGoal) -> None:
        """Append a goal. Raises QueueFull."""
        if len(self._waiting) >= MAX_WAITING:
            raise QueueFull(
                f"{MAX_WAITING} goals are already waiting; remove one, or run the queue"
            )
        self._waiting[next(self._numbers)] = goal

    def remove(self, number: int) -> bool:
        """Remove a goal. Return False if no goal has this number."""
        return self._waiting.pop(number, None) is not None

    def run(self) -> None:
        """Start sending goals."""
        self.running, self.held = bool(self._waiting), ""

    def hold(self, why: str = "") -> None:
        """Send no goals until the queue is run again."""
        if self.running:
            self.running, self.held = False, why

    def ended(self, reached: bool, sentence: str) -> None:
        """Process the end of any goal of the cell, regardless of its client."""
        if not reached:
            self.hold(f"The queue is paused: {sentence}")

    def next(self, busy: bool, blocked: str) -> RequestedGoal | None:
        """Remove and return the goal to send now. Return None if no goal is to be sent."""
        if blocked:
            self.hold(f"The queue is paused. {blocked}")
        if not self.running or busy:
            return None
        if not self._waiting:
            self.running = False
            return None
        return self._waiting.pop(next(iter(self._waiting)))


class NamedGoals:
    """Named poses in ``table``, stored in a file as [m, m, rad]."""

    def __init__(self, content: object = None) -> None:
        """``content``: output of ``as_content``. Unreadable entries are ignored."""
        self._poses: dict[str, Pose] = {}
        if isinstance(content, dict):
            for name, values in content.items():
                try:
                    x, y, theta = (float(value) for value in values)
                except (TypeError, ValueError, OverflowError):
                    continue
                self._poses[str(name)] = Pose(x, y, theta)

    def rows(self) -> list[tuple[str, Pose]]:
        """Return names and poses, sorted by name."""
        return sorted(self._poses.items(), key=lambda row: row[0].casefold())

    def keep(self, name: str, pose: Pose) -> None:
        """Store a pose under a name, replacing the previous pose. Raises QueueFull."""
        if name not in self._poses and len(self._poses) >= MAX_NAMES:
            raise QueueFull(f"{MAX_NAMES} goals already have names; remove one")
        self._poses[name] = pose

    def forget(self, name: str) -> bool:
        """Remove a name. Return False if it does not exist."""
        return self._poses.pop(name, None) is not None

    def as_content(self) -> dict[str, list[float]]:
        """Return the content for a file."""
        return {name: list(pose) for name, pose in self._poses.items()}
