"""Data of one positioning run for its files, figures and page."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from tapping_cell.report import columns
from tapping_cell.report.words import OUTCOMES, word
from tapping_cell.se2 import Pose

Outline = tuple[tuple[float, float], ...]
Covariance = tuple[
    tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
]

REACHED, NOT_TRULY_REACHED = "reached", "not truly reached"
FAILED, CANCELED, REFUSED, UNFINISHED = "failed", "canceled", "refused", "unfinished"
"""Outcomes of a run; ``unfinished`` means that the end of the run was not recorded."""


def _gain(meaning: str, name: str, unit: str = "", factor: float = 1.0) -> Any:
    return columns.quantity(meaning, f"learnt_{name}{unit}", factor, ".5f", name, math.nan)


def _offset(meaning: str, name: str) -> Any:
    return _gain(meaning, name, "_deg_mm", math.degrees(1e-3))


@dataclass(frozen=True, slots=True)
class Learnt:
    """Estimated properties of the object after a tap: expected values and standard deviations. NaN
    if unknown.
    """

    distance: float = _gain("ratio of measured to modelled distance", "distance")
    distance_deviation: float = _gain("its standard deviation", "distance_deviation")
    rotation: float = _gain("ratio of measured to modelled rotation per distance", "rotation")
    rotation_deviation: float = _gain("its standard deviation", "rotation_deviation")
    direction: float = _gain("error of direction", "direction", "_deg", math.degrees(1.0))
    direction_deviation: float = _gain(
        "its standard deviation", "direction_deviation", "_deg", math.degrees(1.0)
    )
    offset_x: float = _offset(
        "rotation per distance of a tap through the middle in the object's -y direction", "offset_x"
    )
    offset_x_deviation: float = _offset("its standard deviation", "offset_x_deviation")
    offset_y: float = _offset(
        "rotation per distance of a tap through the middle in the object's +x direction", "offset_y"
    )
    offset_y_deviation: float = _offset("its standard deviation", "offset_y_deviation")
    impact_distance: float = _gain("factor of the impact in the distance", "impact_distance")
    impact_distance_deviation: float = _gain("its standard deviation", "impact_distance_deviation")
    slide_distance: float = _gain("factor of the slide in the distance", "slide_distance")
    slide_distance_deviation: float = _gain("its standard deviation", "slide_distance_deviation")
    impact_rotation: float = _gain("part of the impact in the rotation gain", "impact_rotation")
    impact_rotation_deviation: float = _gain("its standard deviation", "impact_rotation_deviation")
    slide_rotation: float = _gain("part of the slide in the rotation gain", "slide_rotation")
    slide_rotation_deviation: float = _gain("its standard deviation", "slide_rotation_deviation")


def _speed(meaning: str, name: str) -> Any:
    return columns.quantity(meaning, f"launch_{name}_mm_s", 1e3, ".3f", name, math.nan)


def _spin(meaning: str, name: str) -> Any:
    return columns.quantity(
        meaning, f"launch_{name}_deg_s", math.degrees(1.0), ".3f", name, math.nan
    )


def _deceleration(meaning: str, name: str) -> Any:
    return columns.quantity(meaning, f"launch_{name}_mm_s2", 1e3, ".2f", name, math.nan)


@dataclass(frozen=True, slots=True)
class Launch:
    """Launch of a tap in the track of its slide, and that of the model; NaN if unknown."""

    poses: float = columns.quantity(
        "number of poses of the slide; 0 if it was not seen", "launch_poses", 1.0, ".0f", "poses", 0
    )
    speed: float = _speed("speed at the launch", "speed")
    speed_deviation: float = _speed("its standard deviation", "speed_deviation")
    spin: float = _spin("spin at the launch", "spin")
    spin_deviation: float = _spin("its standard deviation", "spin_deviation")
    deceleration: float = _deceleration("mean deceleration of the slide", "deceleration")
    deceleration_deviation: float = _deceleration(
        "its standard deviation", "deceleration_deviation"
    )
    model_speed: float = _speed("speed at the launch in the model", "model_speed")
    model_spin: float = _spin("spin at the launch in the model", "model_spin")
    model_deceleration: float = _deceleration(
        "mean deceleration in the model", "model_deceleration"
    )

    @property
    def is_known(self) -> bool:
        """Whether the poses of the slide determine the launch."""
        return self.poses > 0 and math.isfinite(self.speed)


@dataclass(frozen=True, slots=True)
class TapRow:
    """One tap of a run, in m, rad and m/s. Poses are in the frame ``table``, and displacements
    along its axes.

    Each field declares its columns in ``taps.csv``. Times are in s since the start of the run.
    """

    number: int = columns.count("number of the tap in the run", "tap", "number")
    tap_id: int = columns.count("id of the tap", "tap_id", "tap_id")
    method: str = columns.text(
        "planning method that chose the tap", "method", lambda record: str(record.planner)
    )
    outcome: str = columns.text(
        "fired, not fired or unknown", "outcome", lambda record: word(OUTCOMES, int(record.outcome))
    )
    before: Pose = columns.pose("pose for which the tap was planned", "before_", "object_pose")
    commanded: Pose = columns.pose(
        "displacement that was requested from the model",
        "commanded_d",
        lambda record: Pose(float(record.dx), float(record.dy), float(record.dtheta)),
    )
    predicted: Pose = columns.pose("expected pose after the tap", "predicted_", "predicted_pose")
    measured: Pose = columns.pose(
        "measured pose after the tap; nan if the object was not seen again",
        "measured_",
        "measured_pose.pose",
    )
    true_pose: Pose | None = columns.pose("true pose after the tap; nan on hardware", "true_", None)
    strike: Pose = columns.pose("pose of the striker's tip", "strike_", "strike_pose")
    striker_speed: float = columns.quantity(
        "commanded speed of the striker", "striker_speed_mm_s", 1e3, ".2f", "striker_speed"
    )
    contact_angle: float = columns.quantity(
        "angle of incidence at the contact",
        "contact_angle_deg",
        math.degrees(1.0),
        ".3f",
        "contact_angle",
    )
    measured_speed: float = columns.quantity(
        "measured speed of the striker; nan without a speed gate",
        "measured_speed_mm_s",
        1e3,
        ".2f",
        "measured_speed",
        math.nan,
    )
    commanded_at: float = columns.quantity(
        "time of the command", "commanded_at_s", 1.0, ".3f", None, math.nan
    )
    fired_at: float = columns.quantity(
        "time of the release", "fired_at_s", 1.0, ".3f", None, math.nan
    )
    at_rest_at: float = columns.quantity(
        "time at which the object was at rest again", "at_rest_at_s", 1.0, ".3f", None, math.nan
    )
    learnt: Learnt = columns.part("what was learnt about the object", Learnt, "learnt")
    launch: Launch = columns.part("launch in the track of the slide", Launch, "track")
    predicted_covariance: Covariance | None = columns.covariance(
        "covariance of the expected pose", "predicted_", "predicted_covariance"
    )
    reason: str = columns.text(
        "why the tap is not aimed straight at the goal; empty if it is",
        "reason",
        lambda record: str(record.reason),
        "",
    )
    tapper: str = columns.text(
        "tapper that struck; empty in a cell with one tapper",
        "tapper",
        lambda record: str(record.tapper),
        "",
    )
    expected_taps: float = columns.quantity(
        "expected number of taps to the goal, including this tap",
        "expected_taps",
        1.0,
        ".3f",
        "expected_taps",
        math.nan,
    )
    expected_seconds: float = columns.quantity(
        "expected time to the goal from the command of this tap",
        "expected_s",
        1.0,
        ".3f",
        "expected_seconds",
        math.nan,
    )
    object_name: str = columns.text(
        "object that was tapped", "object", lambda record: str(record.object_id), ""
    )
    purpose: str = columns.text(
        "why this object was tapped now; empty with one object", "purpose", None, ""
    )

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
class RunObject:
    """One object of a run. Poses in ``table``, m and rad; None if unknown.

    ``outline``: corners in the object's frame, m. ``goal`` is also None for an object that may only
    be moved out of the way. ``end``: last measured pose; ``end_true``: true pose at the end.
    ``outcome``: state at the end in words; empty if the run has only one object.
    """

    name: str = ""
    outline: Outline = ()
    start: Pose | None = None
    goal: Pose | None = None
    end: Pose | None = None
    end_true: Pose | None = None
    tolerance: tuple[float, float] = (0.0, 0.0)
    taps: int = 0
    outcome: str = ""


@dataclass(frozen=True, slots=True)
class Run:
    """Record of one run from start to end, in m, rad and s. Poses are in the frame ``table``.

    ``objects``: the objects with a goal, and those that may be moved; the first one is ``first``.
    ``seed`` is None on hardware. ``began`` is in s since 1970. ``files`` contains the text of each
    configuration file. ``contacts``: names of the two objects of each true contact; None if
    unknown.
    """

    name: str
    objects: tuple[RunObject, ...]
    taps: tuple[TapRow, ...]
    outcome: str
    wall_time: float
    seed: int | None
    versions: dict[str, str]
    error_code: int
    error_msg: str
    table_size: tuple[float, float]
    planner: str = ""
    began: float = math.nan
    phases: tuple[Phase, ...] = ()
    activities: tuple[Phase, ...] = ()
    """Activities of the devices; empty if the devices were not recorded."""
    errors: tuple[ErrorEvent, ...] = ()
    files: dict[str, str] = field(default_factory=dict)
    contacts: tuple[tuple[str, str], ...] | None = None
    mounts: tuple[tuple[str, Pose], ...] = ()
    """Names of the fixed tappers and their tips at rest; empty in a cell with an arm."""
    note: str = ""
    """Why the files show less than the run had; empty if they show all of it."""

    @property
    def reached(self) -> bool:
        """True if all objects are at their goals by measurement and, if known, by ground truth."""
        return self.outcome == REACHED

    @property
    def first(self) -> RunObject:
        """The object of a run with one object."""
        return self.objects[0]


Poses = list[tuple[float, Pose]]
"""Poses with their times in s, in order of time."""
TIP = "\0tip"
"""Name of the striker's tip among recorded poses; no object has this name."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A camera image with the detections drawn in: time in s since run start, and JPEG bytes."""

    at: float
    jpeg: bytes
