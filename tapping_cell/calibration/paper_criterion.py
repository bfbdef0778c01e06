"""Fit of friction and torque factor by the paper's criterion (section 3.1.2), for comparison.

In each run, the differences between the measured initial velocities and the velocities calculated
from the displacements are averaged over the trials. The criterion is the sum of the squares of
these averages. Spins are positive in the direction of the rotation and multiplied by the support's
radius, so that all differences are speeds. Averaging cancels the noise of single trials but ignores
how accurate each trial is, so this fit is less accurate than that of ``object_fit``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from tapping_cell.calibration.prediction import Launches
from tapping_cell.calibration.slide_curves import TORQUE_FACTORS, SlideCurves
from tapping_cell.mechanics import Body
from tapping_cell.se2 import Array


class PaperFit(NamedTuple):
    """Friction and torque factor by the paper's criterion; ``rms`` is the root mean square of the
    averaged differences, in m/s."""

    friction: float
    torque_factor: float
    rms: float


def paper_fit(
    measured: Launches,
    labels: Sequence[str],
    body: Body,
    gravity: float,
    start: tuple[float, float],
) -> PaperFit:
    """Fit friction and torque factor; ``start`` contains their initial values."""
    curves = SlideCurves(body, gravity)
    names = np.array(labels)
    runs = [names == label for label in dict.fromkeys(labels)]
    turn = np.sign(measured.rotation)

    def differences(x: Array) -> Array:
        friction = math.exp(x[0])
        speed, spin = curves.launch(measured.distance, measured.rotation, friction, float(x[1]))
        along = measured.speed - speed
        around = body.support_radius * turn * (measured.spin - spin)
        return np.array([float(np.mean(part[run])) for part in (along, around) for run in runs])

    low = [math.log(0.003), math.log(TORQUE_FACTORS[0])]
    high = [math.log(5.0), math.log(TORQUE_FACTORS[1])]
    found = least_squares(
        differences, [math.log(value) for value in start], bounds=(low, high), diff_step=1e-3
    )
    return PaperFit(
        math.exp(found.x[0]), math.exp(found.x[1]), math.sqrt(float(np.mean(found.fun**2)))
    )
