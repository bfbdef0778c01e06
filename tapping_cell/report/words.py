"""Names of the numeric states in the cell's messages, and counts and errors in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tapping_cell.se2 import Pose

PHASES = (
    "idle",
    "waiting for the cell",
    "looking",
    "planning",
    "placing the striker",
    "firing",
    "waiting for rest",
    "reached",
    "failed",
    "canceled",
    "waiting for confirmation",
)
"""Names of the states of ``tapping_cell_msgs/PlanState``, by number."""

OUTCOMES = ("none", "fired", "not fired", "unknown")
"""Names of the outcomes of ``tapping_cell_msgs/TapperState``, by number."""

PROGRESS = ("waiting", "being tapped", "making way", "reached", "not reached")
"""Names of the states of ``tapping_cell_msgs/ObjectProgress``, by number."""


def word(words: tuple[str, ...], number: int) -> str:
    """Return the name of a number; ``unknown`` if it has none, as in another version's messages."""
    return words[number] if 0 <= number < len(words) else "unknown"


def expected_effort(taps: float, seconds: float) -> str:
    """Format the expected effort to a goal, as in "2.2 taps, 5.9 s"; empty if unknown."""
    if not taps > 0.0:
        return ""
    return f"{taps:.1f} taps" + (f", {seconds:.1f} s" if math.isfinite(seconds) else "")


def numbers_in_words(numbers: Sequence[int]) -> str:
    """Return increasing numbers as text; three or more in succession as a range."""
    first, last = numbers[0], numbers[-1]
    if len(numbers) > 2 and last - first == len(numbers) - 1:
        return f"{first} to {last}"
    return ", ".join(map(str, numbers))


def counted(number: int, thing: str) -> str:
    """Format a count, as in "1 tap" and "3 taps"."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def motion(before: Pose, after: Pose, digits: int = 1) -> str:
    """Return the distance and the signed rotation between two poses, as text."""
    if not math.isfinite(before.x + after.x):
        return "not seen"
    turn = math.degrees(before.rotation_to(after))
    return f"{1000 * before.distance_to(after):.{digits}f} mm, {turn:+.{digits}f} deg"


def remaining_error(pose: Pose, goal: Pose) -> str:
    """Return the distance and the angle from a pose to the goal, as text."""
    turn = math.degrees(abs(pose.rotation_to(goal)))
    return f"{1000 * pose.distance_to(goal):.1f} mm and {turn:.1f} deg"
