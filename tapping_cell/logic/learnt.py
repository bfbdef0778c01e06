"""Conversion of what is learnt from taps to messages."""

from __future__ import annotations

import math

from tapping_cell.messages import LearntGains, SlideTrack
from tapping_cell.planning import Gains
from tapping_cell.planning.track import Launched


def to_message(gains: Gains) -> LearntGains:
    """Convert the learnt corrections of one object's model to a message."""
    return LearntGains(
        **gains.as_numbers(), explained=int(gains.taken), unexplained=int(gains.outliers)
    )


def track_message(launched: Launched | None) -> SlideTrack:
    """Convert the launch in a track to a message; without a track, its numbers are NaN."""
    if launched is None:
        nan = math.nan
        launched = Launched(0, nan, nan, nan, (nan, nan, nan), (nan, nan, nan))
    return SlideTrack(
        poses=launched.poses,
        speed=launched.speed,
        spin=launched.spin,
        deceleration=launched.deceleration,
        speed_deviation=launched.deviations[0],
        spin_deviation=launched.deviations[1],
        deceleration_deviation=launched.deviations[2],
        model_speed=launched.model[0],
        model_spin=launched.model[1],
        model_deceleration=launched.model[2],
    )
