"""Result of measuring the object in one frame."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from tapping_cell.se2 import Pose
from tapping_cell.vision.camera import Array


class Problem(enum.Enum):
    """Reason for a missing pose; the observation's sentence explains it with values."""

    NONE = 0
    WRONG_IMAGE = 1
    LATE_FRAME = 2
    FROZEN_FRAME = 3
    DARK = 4
    OVEREXPOSED = 5
    TABLE_UNKNOWN = 6
    REFERENCES_HIDDEN = 7
    CAMERA_MOVED = 8
    CAMERA_MOVED_TOO_FAR = 9
    OBJECT_HIDDEN = 10
    WRONG_MARKER = 11
    DUPLICATE_MARKER = 12
    MIRRORED_MARKER = 13
    MISSHAPEN_MARKER = 14
    DUPLICATE_OBJECT = 15
    MISSHAPEN_OBJECT = 16
    WRONG_OBJECT = 17
    DOT_HIDDEN = 18
    TABLE_CONTRADICTED = 19


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Result of one frame.

    ``pose`` and ``covariance`` (3, 3; m, m, rad) of the object in ``table`` are set if and only if
    ``visible``. While the object is at rest (since ``at_rest_since``, s), they combine
    ``frames_fused`` frames; while it moves at ``velocity`` (m/s, m/s, rad/s), they come from this
    frame only. ``sentence`` explains ``problem``. If there is no problem, ``sentence`` is a warning
    that does not invalidate the pose, or explains without fault why the object is not visible, or
    it is empty.
    """

    stamp: float
    visible: bool = False
    pose: Pose | None = None
    covariance: Array | None = None
    at_rest: bool = False
    at_rest_since: float | None = None
    frames_fused: int = 0
    velocity: Array | None = None
    references_used: tuple[int, ...] = ()
    problem: Problem = Problem.NONE
    sentence: str = ""
