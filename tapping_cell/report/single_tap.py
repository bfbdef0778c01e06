"""Data of the report on single-tap experiments, in mm, degrees and percent.

Velocities are in mm/s and degrees/s. Arrays have one entry per trial unless stated otherwise.
Unknown values are NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A row of the table of values; ``low`` and ``high`` are NaN if the value was not fitted."""

    name: str
    old: float
    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Displacements (mm, degrees) and initial velocities (mm/s, degrees/s)."""

    distance: Array
    rotation: Array
    speed: Array
    spin: Array


@dataclass(frozen=True, slots=True, eq=False)
class ProfileView:
    """One trial over time (ms from the impact): measured poses and predicted curves.

    ``seen_time``, ``seen_distance`` and ``seen_rotation`` (n,) are samples of the track.
    ``seen_speed`` and ``seen_spin`` are finite differences at the midpoints ``rate_time``, without
    the step that contains the impact. ``curve_*`` (k,) are predicted from the displacement, and
    ``plain_*`` are the same curves with a torque factor of 1.
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
    """Errors of a run's means in percent, as (translation, rotation) for four predictions."""

    label: str
    trials: int
    sliding: tuple[float, float]
    inverse: tuple[float, float]
    impact: tuple[float, float]
    tap: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class SingleTapReport:
    """All data of the page and the figures.

    ``labels`` are the runs of the trials. ``by_sliding`` contains displacements calculated from
    measured velocities, and velocities calculated from measured displacements. ``by_tapping``
    contains displacements and velocities calculated from the striker's motion. ``own_friction`` is
    each trial's friction divided by the friction fitted to all trials.
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
