"""Stopping rule: the conditions for declaring that the object is at the goal.

An observation has an error, so an object just outside the tolerance can be measured inside it. The
cell stops only if the probability that the true pose is within the tolerance is at least
``CONFIDENCE``. A lower bound of this probability is used: the integral of the observation's normal
distribution over the circle of the position tolerance, minus the probability that the rotation is
outside its tolerance (Bonferroni's bound, which does not assume independence). For an observation
at the edge of the tolerance the probability is about one half. In this case a longer observation
may confirm the goal; if it does not, the object is tapped again.

Plans are made for a stopping box. On each axis, its half width is the tolerance minus ``MARGIN``
standard deviations of a long observation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

CONFIDENCE = 0.999
"""Minimum probability of being within the tolerance for stopping."""

MARGIN = 3.090232306167813
"""Quantile of the standard normal distribution for the probability ``CONFIDENCE``."""

LONG_OBSERVATION = 9
"""Number of observations that are fused in a long observation. An observation takes much less time
than a tap. At a tolerance of 0.1 mm and 0.1 degrees, 9 observations in place of 4 save 0.25 taps a
run."""

WORTH_OBSERVING = 0.02
"""Minimum probability of being within the tolerance for which a longer observation is worth its
time."""

SMALLEST_SHARE = 0.25
"""Smallest box as a share of the tolerance; a smaller box would need too many taps."""

_REACH = 6.0
"""Number of standard deviations beyond which a normal distribution is neglected."""

_NODES, _ROUND_NODES = 241, 41
"""Numbers of quadrature nodes for any position covariance and for an isotropic one. An isotropic
covariance needs fewer nodes: the integration can then run at a right angle to the residual, where
the integrand changes slowly. Both numbers give an accuracy of 1e-8 (tested)."""


class StoppingBox(NamedTuple):
    """Half widths of the box, distance (m) and rotation (rad), and whether the camera is accurate
    enough for it."""

    distance: float
    rotation: float
    camera_suffices: bool


class Arrival(NamedTuple):
    """Result of the stopping rule for measured residuals; each array has the shape (...,).

    probability: lower bound of the probability of being within the tolerance. done: the object is
    at its goal. doubtful: a longer observation may confirm the goal, or has.
    """

    probability: Array
    done: NDArray[np.bool_]
    doubtful: NDArray[np.bool_]


def stopping_share(relative_noise: float) -> float:
    """Return the share of the tolerance, in [0, 1], within which an observation of one axis
    confirms the goal.

    ``relative_noise``: standard deviation of the observation as a share of the tolerance.
    """
    return max(0.0, 1.0 - MARGIN * relative_noise)


def stopping_box(
    tolerance_position: float,
    tolerance_angle: float,
    position_noise: float,
    angle_noise: float,
    share: float | None = None,
) -> StoppingBox:
    """Compute the box for a tolerance and the standard deviations of a measured pose (m, rad).

    A ``share`` set by the user is used unchanged. Otherwise, if the share of an axis is below
    ``SMALLEST_SHARE``, that limit is used and ``camera_suffices`` is False.
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


def arrival(
    residual: ArrayLike,
    covariance: ArrayLike,
    tolerance_position: float,
    tolerance_angle: float,
    share: float | None = None,
) -> Arrival:
    """Apply the stopping rule. The arguments are those of ``inside_probability``.

    With a ``share`` set by the user, the probability is 1 in the box of this share of the tolerance
    and 0 outside it.
    """
    if share is None:
        probability = inside_probability(residual, covariance, tolerance_position, tolerance_angle)
    else:
        left = np.asarray(residual, dtype=float)
        near = np.hypot(left[..., 0], left[..., 1]) <= share * tolerance_position
        probability = (near & (np.abs(left[..., 2]) <= share * tolerance_angle)).astype(float)
    return Arrival(probability, probability >= CONFIDENCE, probability >= WORTH_OBSERVING)


def inside_probability(
    residual: ArrayLike, covariance: ArrayLike, tolerance_position: float, tolerance_angle: float
) -> Array:
    """Compute a lower bound of the probability that the true residual is within the tolerance,
    (...,).

    Args:
        residual: measured dx, dy (m) and rotation (rad), (..., 3).
        covariance: covariance of that measurement, (..., 3, 3), m and rad.
        tolerance_position: radius of the circle, m.
        tolerance_angle: half width, rad.
    """
    left, spread = np.asarray(residual, dtype=float), np.asarray(covariance, dtype=float)
    shape = np.broadcast_shapes(left.shape[:-1], spread.shape[:-2])
    variance, axes = np.linalg.eigh(spread[..., :2, :2])
    deviation = np.sqrt(np.maximum(variance, (1e-9 * tolerance_position) ** 2))
    turn = np.sqrt(np.maximum(spread[..., 2, 2], (1e-9 * tolerance_angle) ** 2))
    beyond = np.hypot(left[..., 0], left[..., 1]) - tolerance_position
    near = beyond <= _REACH * deviation[..., 1]
    near &= np.abs(left[..., 2]) - tolerance_angle <= _REACH * turn
    near = np.broadcast_to(near, shape)
    probability = np.zeros(shape)
    if np.any(near):
        left = np.broadcast_to(left, (*shape, 3))[near]
        axes = np.broadcast_to(axes, (*shape, 2, 2))[near]
        deviation = np.broadcast_to(deviation, (*shape, 2))[near]
        turn = np.broadcast_to(turn, shape)[near]
        inside = _inside_circle(left, axes, deviation, tolerance_position)
        outside = scipy.special.ndtr((left[:, 2] - tolerance_angle) / turn)
        outside += scipy.special.ndtr((-left[:, 2] - tolerance_angle) / turn)
        probability[near] = np.clip(inside - outside, 0.0, 1.0)
    return probability


def _inside_circle(left: Array, axes: Array, deviation: Array, radius: float) -> Array:
    """Compute the probability (n,) of being in the circle about the origin, for normal
    distributions with means ``left`` (n, 3), principal axes (n, 2, 2) and standard deviations (n,
    2) in ascending order."""
    centre = np.einsum("nij,ni->nj", axes, left[:, :2])
    nodes = _NODES
    if np.all(deviation[:, 1] <= deviation[:, 0] * (1.0 + 1e-9)):
        nodes = _ROUND_NODES
        centre = np.stack([np.zeros(len(left)), np.hypot(left[:, 0], left[:, 1])], axis=-1)
    # Integrate over the relevant part of the diameter. The integration variable is an angle,
    # because the integrand is then smooth at the ends.
    first, width = centre[:, :1], deviation[:, :1]
    low = np.maximum(first - _REACH * width, -radius)
    high = np.maximum(np.minimum(first + _REACH * width, radius), low)
    angle = np.linspace(0.0, math.pi, nodes)
    along = (low + high) / 2 + (high - low) / 2 * np.cos(angle)
    half = np.sqrt(np.maximum(radius**2 - along**2, 0.0))
    middle, across = centre[:, 1:], deviation[:, 1:]
    inner = scipy.special.ndtr((half - middle) / across) - scipy.special.ndtr(
        (-half - middle) / across
    )
    density = np.exp(-0.5 * ((along - first) / width) ** 2) / (math.sqrt(2.0 * math.pi) * width)
    step = (high - low) / 2 * np.sin(angle) * (angle[1] - angle[0])
    return np.asarray((inner * density * step).sum(axis=-1))
