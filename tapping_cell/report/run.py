"""One positioning run, as it is written down and drawn."""

from __future__ import annotations

from dataclasses import dataclass

from tapping_cell.se2 import Pose

Outline = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class TapRow:
    """One tap of a run. Poses in ``table``; displacements in table axes; m, rad, m/s.

    ``true_pose`` is None where nobody knows it (on hardware).
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


@dataclass(frozen=True, slots=True)
class Run:
    """One run from start to end, as it is written down. Poses in ``table``; m, rad, s."""

    goal: Pose
    start: Pose
    tolerance: tuple[float, float]
    taps: tuple[TapRow, ...]
    final_measured: Pose | None
    final_true: Pose | None
    reached: bool
    wall_time: float
    seed: int
    versions: dict[str, str]
    error_code: int
    error_msg: str
    outline: Outline
    table_size: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Failure:
    """A run that ended before it had a result. ``wall_time`` in s."""

    wall_time: float
    seed: int
    versions: dict[str, str]
    error_code: int
    error_msg: str
