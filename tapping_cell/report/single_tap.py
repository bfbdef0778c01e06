"""Data of the report on single-tap experiments, in mm, degrees and percent.

Velocities are in mm/s and degrees/s. Arrays have one entry per trial unless stated otherwise.
Unknown values are NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tapping_cell.se2 import Array


@dataclass(frozen=True, slots=True)
class Parameter:
    """A row of the table of values. ``low`` and ``high`` are the limits of the 95 % interval, or
    NaN if the value was not fitted."""

    name: str
    old: float
    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Displacement (mm, degrees) and initial velocity (mm/s, degrees/s) of every trial."""

    distance: Array
    rotation: Array
    speed: Array
    spin: Array


@dataclass(frozen=True, slots=True, eq=False)
class ProfileView:
    """One trial over time (ms from the impact): measured poses and predicted curves.

    ``seen_time``, ``seen_distance`` and ``seen_rotation`` (n,) are the poses measured by the
    camera. ``seen_speed`` and ``seen_spin`` are the velocities between successive poses, at the
    times ``rate_time``. The interval that contains the impact is left out. ``curve_*`` (k,) are
    predicted from the trial's displacement with the fitted torque factor, and ``plain_*`` with a
    torque factor of 1.
    """

    title: str
    seen_time: Array
    seen_distance: Array
    seen_rotation: Array
    rate_time: Array
    seen_speed: Array
    seen_spin: Array
    curve_time: Array
    curve_distance: Array
    curve_rotation: Array
    curve_speed: Array
    curve_spin: Array
    plain_time: Array
    plain_speed: Array
    plain_spin: Array


@dataclass(frozen=True, slots=True)
class RunError:
    """Prediction errors of the means of one run in percent, each as (translation, rotation).

    ``sliding``: displacement from the measured velocity. ``inverse``: velocity from the measured
    displacement. ``impact``: velocity from the striker's motion. ``tap``: displacement from the
    striker's motion.
    """

    label: str
    trials: int
    sliding: tuple[float, float]
    inverse: tuple[float, float]
    impact: tuple[float, float]
    tap: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class SingleTapReport:
    """All data of the page and the figures.

    ``labels`` contains the name of each trial's run. ``by_sliding`` contains displacements
    calculated from measured velocities, and velocities calculated from measured displacements.
    ``by_tapping`` contains displacements and velocities calculated from the striker's motion.
    ``own_friction`` is each trial's friction divided by the friction fitted to all trials.
    """

    title: str
    made: str
    inputs: tuple[str, ...]
    labels: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    measured: Motions
    by_sliding: Motions
    by_tapping: Motions
    own_friction: Array
    profiles: tuple[ProfileView, ...]
    runs: tuple[RunError, ...]
    tapper: tuple[str, ...]
    sentences: tuple[str, ...]
    left_out: tuple[str, ...]
    facts: Mapping[str, str]
