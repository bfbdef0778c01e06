"""Refusals of planning: numbered reasons with messages that contain the remedy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class RefusalReason(IntEnum):
    """Reason of a refusal. The numbers must not change because messages and logs contain them."""

    GOAL_NOT_FINITE = 1
    GOAL_OFF_TABLE = 2
    GOAL_IN_KEEP_OUT = 3
    GOAL_OUT_OF_REACH = 4
    NO_PATH_TO_GOAL = 5
    OBJECT_POSE_NOT_FINITE = 6
    OBJECT_OFF_TABLE = 7
    NO_STRIKE = 8
    CAMERA_TOO_COARSE = 9
    TOO_MANY_TAPS = 10
    TAP_LEAVES_TABLE = 11
    TAP_LEAVES_VIEW = 12
    PROBE_NEEDED = 13
    NO_CONTACT = 14
    GOAL_OUTSIDE_WORKING_AREA = 15
    GOALS_OVERLAP = 16
    NO_ARRANGEMENT = 17
    TAP_WITHOUT_ROTATION = 18


@dataclass(frozen=True, slots=True)
class Refusal:
    """A tap or a goal that planning refuses.

    ``sentence`` contains the value, the limit and the remedy, in mm and degrees.
    """

    reason: RefusalReason
    sentence: str
