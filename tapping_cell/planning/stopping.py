"""Honest stopping: how much smaller than the tolerance the box must be in which the cell stops.

The camera's error can make an object just outside the tolerance look inside. If measured values
are spread evenly over a box of half width b and the camera's error is normal with deviation s, the
share of stops whose true value lies outside the tolerance a is

    (s / b) * integral of Q(u) du from (a - b) / s to infinity,  Q(u) = 1 - Phi(u),

and the integral is phi(u) - u Q(u). The box is the largest one that keeps this share at or below
``FALSE_STOPS`` on each axis. For a camera of a tenth of the tolerance it is 0.87 of the tolerance.
Measured values crowd in the middle of the box rather than spread evenly, so fewer stops are false.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

from scipy.optimize import brentq
from scipy.special import ndtr

FALSE_STOPS = 0.005
"""Share of false stops on one axis, for values spread evenly over the box."""

SMALLEST_SHARE = 0.25
"""A smaller box than this share of the tolerance would cost endless taps."""


class StoppingBox(NamedTuple):
    """Half widths of the box: distance in m, rotation in rad; and whether the camera allows it."""

    distance: float
    rotation: float
    camera_suffices: bool


@functools.lru_cache(maxsize=4096)
def stopping_share(relative_noise: float) -> float:
    """Largest honest share of the tolerance for a camera noise given as a share of the tolerance.

    Returns a number in [0, 1]; 0 where no box is honest.
    """
    if relative_noise <= 0.0:
        return 1.0

    def excess(share: float) -> float:
        u = (1.0 - share) / relative_noise
        tail = math.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi) - u * float(ndtr(-u))
        return relative_noise / share * tail - FALSE_STOPS

    smallest = 1e-3
    if excess(smallest) > 0.0:
        return 0.0
    if excess(1.0) <= 0.0:
        return 1.0
    return float(brentq(excess, smallest, 1.0, xtol=1e-9))


def stopping_box(
    tolerance_position: float,
    tolerance_angle: float,
    position_noise: float,
    angle_noise: float,
    share: float | None = None,
) -> StoppingBox:
    """The box for a tolerance (m, rad) and one standard deviation of the measured pose (m, rad).

    A ``share`` given by the user is taken as it is. Otherwise each axis has its own honest share;
    below ``SMALLEST_SHARE`` that share is used and ``camera_suffices`` is False.
    """
    if share is not None:
        return StoppingBox(share * tolerance_position, share * tolerance_angle, True)
    position_share = stopping_share(position_noise / tolerance_position)
    angle_share = stopping_share(angle_noise / tolerance_angle)
    return StoppingBox(
        max(position_share, SMALLEST_SHARE) * tolerance_position,
        max(angle_share, SMALLEST_SHARE) * tolerance_angle,
        min(position_share, angle_share) >= SMALLEST_SHARE,
    )
