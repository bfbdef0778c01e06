"""Words for the numbers in the cell's messages."""

from __future__ import annotations

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
"""States of ``tapping_cell_msgs/PlanState``, by number."""

OUTCOMES = ("none", "fired", "not fired", "unknown")
"""Outcomes of ``tapping_cell_msgs/TapperState``, by number."""


def word(words: tuple[str, ...], number: int) -> str:
    """The word of a number; ``unknown`` where there is none, as in messages of another version."""
    return words[number] if 0 <= number < len(words) else "unknown"
