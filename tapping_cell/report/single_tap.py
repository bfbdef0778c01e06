"""What the report of single-tap experiments is made of: plain numbers in mm, degrees and percent.

Velocities are in mm/s and degrees/s. Arrays have one entry a trial unless they say otherwise; NaN
where something is not known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A row of the table of values; low and high are NaN where it was not fitted."""

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
    """One trial in time (ms from the impact): poses as seen, and curves as predicted.

    ``seen_*`` (n,) are samples of the track, ``rate_time`` the middles between them, but for
    the step across the impact, with the velocities that their differences give; ``curve_*`` (k,)
    the prediction from the displacement, ``plain_*`` the same with a torque factor of 1.
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
    """Errors of a run's means in percent: (translation, rotation) of four predictions."""

    label: str
    trials: int
    sliding: tuple[float, float]
    inverse: tuple[float, float]
    impact: tuple[float, float]
    tap: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class SingleTapReport:
    """Everything that the page and the figures show.

    ``labels`` names each trial's run. ``by_sliding`` holds displacements calculated from measured
    velocities and velocities calculated from measured displacements; ``by_tapping`` both calculated
    from the striker. ``own_friction`` is each trial's own friction over that of all.
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
