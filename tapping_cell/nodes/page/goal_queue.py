"""Goals that wait for their turn, and goals with names. Pure: the page's node sends them.

A queue moves nothing until a person runs it. It sends the next goal when the last one was reached,
and holds at every other end: what stopped one goal may stop the next.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from tapping_cell.se2 import Pose

MOST_WAITING = 50
MOST_NAMES = 50


@dataclass(frozen=True, slots=True)
class Wanted:
    """A goal in ``table``, with its tolerance in m and rad; 0 for the cell's own."""

    pose: Pose
    tolerance: tuple[float, float] = (0.0, 0.0)


class QueueFull(ValueError):
    """There is no place for one more; the sentence says how many there are."""


class GoalQueue:
    """Goals in their order."""

    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._waiting: dict[int, Wanted] = {}
        self.running = False
        """Whether the next goal follows when the last one was reached."""
        self.held = ""
        """Why the queue does not run any more, where it ended by itself."""

    def rows(self) -> list[tuple[int, Wanted]]:
        """Numbers and goals, in order."""
        return list(self._waiting.items())

    def add(self, goal: Wanted) -> None:
        """Put a goal behind the others. Raises QueueFull."""
        if len(self._waiting) >= MOST_WAITING:
            raise QueueFull(f"{MOST_WAITING} goals wait already; remove one, or run the queue")
        self._waiting[next(self._numbers)] = goal

    def remove(self, number: int) -> bool:
        """Take a goal out; False where none has this number."""
        return self._waiting.pop(number, None) is not None

    def run(self) -> None:
        """Send goals from now on."""
        self.running, self.held = bool(self._waiting), ""

    def hold(self, why: str = "") -> None:
        """Send none until it is run again."""
        if self.running:
            self.running, self.held = False, why

    def ended(self, reached: bool, sentence: str) -> None:
        """A goal of the cell has ended, whoever sent it."""
        if not reached:
            self.hold(f"The queue holds: {sentence}")

    def next(self, busy: bool, blocked: str) -> Wanted | None:
        """The goal to be sent now; it leaves the queue. None while there is none to send."""
        if blocked:
            self.hold(f"The queue holds. {blocked}")
        if not self.running or busy:
            return None
        if not self._waiting:
            self.running = False
            return None
        return self._waiting.pop(next(iter(self._waiting)))


class NamedGoals:
    """Poses in ``table`` by name, as a file keeps them: [m, m, rad]."""

    def __init__(self, content: object = None) -> None:
        """``content``: of ``as_content``; what cannot be read of it is left out."""
        self._poses: dict[str, Pose] = {}
        if isinstance(content, dict):
            for name, values in content.items():
                try:
                    x, y, theta = (float(value) for value in values)
                except (TypeError, ValueError, OverflowError):
                    continue
                self._poses[str(name)] = Pose(x, y, theta)

    def rows(self) -> list[tuple[str, Pose]]:
        """Names and poses, by name."""
        return sorted(self._poses.items(), key=lambda row: row[0].casefold())

    def keep(self, name: str, pose: Pose) -> None:
        """Give a pose a name, in place of what had it. Raises QueueFull."""
        if name not in self._poses and len(self._poses) >= MOST_NAMES:
            raise QueueFull(f"{MOST_NAMES} goals have names already; remove one")
        self._poses[name] = pose

    def forget(self, name: str) -> bool:
        """Remove a name; False where there is none."""
        return self._poses.pop(name, None) is not None

    def as_content(self) -> dict[str, list[float]]:
        """For a file."""
        return {name: list(pose) for name, pose in self._poses.items()}
