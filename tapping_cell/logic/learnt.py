"""Conversion of the learnt corrections of an object's model to a message."""

from __future__ import annotations

from tapping_cell.messages import LearntGains
from tapping_cell.planning import Gains


def to_message(gains: Gains) -> LearntGains:
    """Convert the learnt corrections of one object's model to a message."""
    return LearntGains(
        **gains.as_numbers(), explained=int(gains.taken), unexplained=int(gains.outliers)
    )
