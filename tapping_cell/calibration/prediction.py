"""Prediction errors of the fitted models: the comparisons of sections 3.1.1 and 3.1.2 of the paper.

There are four comparisons. For sliding alone, displacements are calculated from the measured
initial velocities, and vice versa. For the impact alone, initial velocities are calculated from the
striker's speed and the incidence. For the whole tap, displacements are calculated from these
calculated velocities. The error of a run is the ratio of the calculated mean to the measured mean,
minus 1. Rotations and spins are positive in the direction in which the object turned, so that taps
that rotate the object in opposite senses do not cancel in the mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import Array


@dataclass(frozen=True, slots=True, eq=False)
class Launches:
    """Initial velocities (m/s, rad/s) and displacements (m, rad), arrays (n,)."""

    speed: Array
    spin: Array
    distance: Array
    rotation: Array

    def of(self, rows: NDArray[np.intp]) -> Launches:
        """Select trials by index."""
        return Launches(self.speed[rows], self.spin[rows], self.distance[rows], self.rotation[rows])


@dataclass(frozen=True, slots=True)
class RunErrors:
    """Relative errors of one run's means; NaN if unknown.

    ``label`` names the run, and ``trials`` is its number of trials. ``sliding_*`` are the errors of
    displacements calculated from measured velocities, ``inverse_*`` those of velocities calculated
    from measured displacements. ``impact_*`` and ``tap_*`` are the errors of velocities and of
    displacements calculated from the striker's speed and the incidence.
    """

    label: str
    trials: int
    sliding_distance: float
    sliding_rotation: float
    inverse_speed: float
    inverse_spin: float
    impact_speed: float
    impact_spin: float
    tap_distance: float
    tap_rotation: float


def run_errors(
    labels: Sequence[str],
    measured: Launches,
    sliding: Launches,
    tapping: Launches,
) -> tuple[RunErrors, ...]:
    """Compute the errors of every run; the runs are in the order of their first trials.

    ``sliding`` contains velocities calculated from the measured displacements, and displacements
    calculated from the measured velocities. ``tapping`` contains velocities and displacements
    calculated from the striker's speed and the incidence (NaN if unknown).
    """
    names = np.array(labels)
    found = []
    for label in dict.fromkeys(labels):
        run = names == label
        turn = np.sign(measured.rotation[run])
        ones = np.ones(turn.shape)
        found.append(
            RunErrors(
                label=label,
                trials=int(run.sum()),
                sliding_distance=_off(sliding.distance[run], measured.distance[run], ones),
                sliding_rotation=_off(sliding.rotation[run], measured.rotation[run], turn),
                inverse_speed=_off(sliding.speed[run], measured.speed[run], ones),
                inverse_spin=_off(sliding.spin[run], measured.spin[run], turn),
                impact_speed=_off(tapping.speed[run], measured.speed[run], ones),
                impact_spin=_off(tapping.spin[run], measured.spin[run], turn),
                tap_distance=_off(tapping.distance[run], measured.distance[run], ones),
                tap_rotation=_off(tapping.rotation[run], measured.rotation[run], turn),
            )
        )
    return tuple(found)


def _off(calculated: Array, seen: Array, sign: Array) -> float:
    """Return the ratio of the calculated to the measured mean, minus 1; pairs with NaN are
    ignored."""
    both = np.isfinite(calculated) & np.isfinite(seen)
    if not both.any():
        return math.nan
    mean, wanted = (float(np.mean((sign * values)[both])) for values in (calculated, seen))
    return mean / wanted - 1 if abs(wanted) > 1e-9 else math.nan
