"""What taps taught about the object, as the cell's messages carry it."""

from __future__ import annotations

from tapping_cell.messages import LearntGains
from tapping_cell.planning import Gains


def to_message(gains: Gains) -> LearntGains:
    """The message of one object's gains."""
    return LearntGains(
        **gains.as_numbers(), explained=int(gains.taken), unexplained=int(gains.outliers)
    )
