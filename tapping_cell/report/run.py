"""One positioning run, as it is written down, drawn and told."""

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
"""How a run ended. Unfinished: its end was not heard."""


@dataclass(frozen=True, slots=True)
class Learnt:
    """What was known of the object after a tap: expected values and standard deviations.

    distance, rotation: measured over modelled distance, and rotation per distance; direction in
    rad; offset_x, offset_y: rotation per distance (rad/m) of taps through the middle towards -y
    and +x of the object. NaN where nobody said it.
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
    """One tap of a run. Poses in ``table``; displacements in table axes; m, rad, m/s.

    ``true_pose`` is None where nobody knows it (on hardware). ``commanded_at``, ``fired_at`` and
    ``at_rest_at`` in s since the run began; they and ``measured_speed`` are NaN where not known.
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
    """Why it was not a tap straight to the goal; empty where it was, or nobody said it."""
    predicted_covariance: Covariance | None = None
    """Of ``predicted`` in x, y, theta (m, rad); None where not known."""


@dataclass(frozen=True, slots=True)
class Phase:
    """What the planner or the cell did from ``began`` (s since the run began) on."""

    began: float
    name: str


@dataclass(frozen=True, slots=True)
class Trouble:
    """A warning or error of a node: time (s since the start of the run), node, code, message."""

    at: float
    source: str
    code: int
    sentence: str


@dataclass(frozen=True, slots=True)
class Run:
    """One run from start to end, as it is written down. Poses in ``table``; m, rad, s.

    ``goal`` and ``start`` are None where they never were known; ``seed`` where nothing is
    simulated. ``began`` is in s since 1970. ``files`` holds the text of each configuration file.
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
    """What the devices did; empty where they were not recorded."""
    troubles: tuple[Trouble, ...] = ()
    files: dict[str, str] = field(default_factory=dict)

    @property
    def reached(self) -> bool:
        """True where the object is measured to be, and as far as is known truly is, at the goal."""
        return self.outcome == REACHED


@dataclass(frozen=True, slots=True)
class Picture:
    """A camera's picture with what the cell saw drawn in: s since the run began, JPEG bytes."""

    at: float
    jpeg: bytes
