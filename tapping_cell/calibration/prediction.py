"""How well the fitted models predict: the comparisons of sections 3.1.1 and 3.1.2 of the paper.

Four of them, each averaged over a run: displacements calculated from the measured initial
velocities and the other way round (sliding alone), initial velocities from the striker's speed and
the incidence (impact alone), and displacements from these (the whole tap). Errors are calculated
over measured, minus one, of the run's means; rotations and spins are counted in the direction in
which the object turned, so that runs with taps to both sides do not cancel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Launches:
    """Initial velocities (m/s, rad/s) and displacements (m, rad), arrays (n,)."""

    speed: Array
    spin: Array
    distance: Array
    rotation: Array

    def of(self, rows: NDArray[np.intp]) -> Launches:
        """Those of some trials."""
        return Launches(self.speed[rows], self.spin[rows], self.distance[rows], self.rotation[rows])


@dataclass(frozen=True, slots=True)
class RunErrors:
    """Relative errors of one run's means; NaN where it cannot be said.

    ``label`` names the run, ``trials`` counts, the rest as the module describes: ``sliding_*``
    displacements from measured velocities, ``inverse_*`` velocities from measured displacements,
    ``impact_*`` velocities from the striker, ``tap_*`` displacements from the striker.
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
    """The errors of every run, in the order of their first trials.

    ``sliding`` holds velocities calculated from the displacements and displacements calculated from
    the velocities; ``tapping`` both calculated from the striker (NaN where it is not known).
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
    """Mean calculated over mean seen, minus one, of what is known of both."""
    both = np.isfinite(calculated) & np.isfinite(seen)
    if not both.any():
        return math.nan
    mean, wanted = (float(np.mean((sign * values)[both])) for values in (calculated, seen))
    return mean / wanted - 1 if abs(wanted) > 1e-9 else math.nan
