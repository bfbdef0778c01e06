"""Data of one positioning run for its files, figures and page."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from tapping_cell.se2 import Pose

Outline = tuple[tuple[float, float], ...]
Covariance = tuple[
    tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
]

REACHED, NOT_TRULY_REACHED = "reached", "not truly reached"
FAILED, CANCELED, REFUSED, UNFINISHED = "failed", "canceled", "refused", "unfinished"
"""Outcomes of a run; ``unfinished`` means that the end of the run was not recorded."""


@dataclass(frozen=True, slots=True)
class Learnt:
    """Estimated properties of the object after a tap: expected values and standard deviations.

    ``distance`` is the ratio of measured to modelled distance, and ``rotation`` the ratio of
    measured to modelled rotation per distance. ``direction`` is in rad. ``offset_x`` is the
    rotation per distance (rad/m) caused by a tap through the middle of the object in the object's
    -y direction, and ``offset_y`` the one caused by such a tap in the object's +x direction.
    Unknown values are NaN.
    """

    distance: float = math.nan
    distance_deviation: float = math.nan
    rotation: float = math.nan
    rotation_deviation: float = math.nan
    direction: float = math.nan
    direction_deviation: float = math.nan
    offset_x: float = math.nan
    offset_x_deviation: float = math.nan
    offset_y: float = math.nan
    offset_y_deviation: float = math.nan


@dataclass(frozen=True, slots=True)
class TapRow:
    """One tap of a run, in m, rad and m/s. Poses are in the frame ``table``, and displacements
    along its axes.

    ``measured`` is NaN if the object was not seen after the tap, because the goal ended before.
    ``true_pose`` is None if unknown (on hardware). ``commanded_at``, ``fired_at`` and
    ``at_rest_at`` are in s since the start of the run. These times and ``measured_speed`` are NaN
    if unknown.
    """

    number: int
    tap_id: int
    method: str
    before: Pose
    commanded: Pose
    predicted: Pose
    measured: Pose
    true_pose: Pose | None
    strike: Pose
    striker_speed: float
    contact_angle: float
    outcome: str
    measured_speed: float = math.nan
    commanded_at: float = math.nan
    fired_at: float = math.nan
    at_rest_at: float = math.nan
    learnt: Learnt = field(default_factory=Learnt)
    reason: str = ""
    """Reason why the tap was not aimed straight at the goal; empty if it was aimed straight at the
    goal, or if the reason is unknown."""
    predicted_covariance: Covariance | None = None
    """Covariance of ``predicted`` in x, y, theta (m, rad); None if unknown."""
    tapper: str = ""
    """Name of the tapper that struck; empty in a cell with one tapper."""
    expected_taps: float = math.nan
    """Expected number of taps to the goal, including this tap; NaN if unknown."""
    expected_seconds: float = math.nan
    """Expected time to the goal from the command of this tap, in s; NaN if unknown."""

    @property
    def seen(self) -> bool:
        """Whether the object was seen after the tap."""
        return math.isfinite(self.measured.x)


@dataclass(frozen=True, slots=True)
class Phase:
    """State of the planner or activity of the cell, starting at ``began`` (s since run start)."""

    began: float
    name: str


@dataclass(frozen=True, slots=True)
class ErrorEvent:
    """A warning or error of a node: time (s since the start of the run), node, code, message."""

    at: float
    source: str
    code: int
    sentence: str


@dataclass(frozen=True, slots=True)
class Run:
    """Record of one run from start to end, in m, rad and s. Poses are in the frame ``table``.

    ``goal`` and ``start`` are None if unknown; ``seed`` is None on hardware. ``began`` is in s
    since 1970. ``files`` contains the text of each configuration file.
    """

    name: str
    goal: Pose | None
    start: Pose | None
    tolerance: tuple[float, float]
    taps: tuple[TapRow, ...]
    final_measured: Pose | None
    final_true: Pose | None
    outcome: str
    wall_time: float
    seed: int | None
    versions: dict[str, str]
    error_code: int
    error_msg: str
    outline: Outline
    table_size: tuple[float, float]
    planner: str = ""
    object_name: str = ""
    began: float = math.nan
    phases: tuple[Phase, ...] = ()
    activities: tuple[Phase, ...] = ()
    """Activities of the devices; empty if the devices were not recorded."""
    errors: tuple[ErrorEvent, ...] = ()
    files: dict[str, str] = field(default_factory=dict)
    note: str = ""
    """Why the files show less than the run had; empty if they show all of it."""

    @property
    def reached(self) -> bool:
        """True if the object is at the goal by measurement and, if known, by ground truth."""
        return self.outcome == REACHED


@dataclass(frozen=True, slots=True)
class Picture:
    """A camera image with the detections drawn in: time in s since run start, and JPEG bytes."""

    at: float
    jpeg: bytes
