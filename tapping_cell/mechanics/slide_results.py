"""Return types and interface of the sliding models."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class _RestFields(NamedTuple):
    distance: float | Array
    rotation: float | Array
    duration: float | Array


class Rest(_RestFields):
    """End of a slide: ``distance`` along the launch in m, ``rotation`` in rad, ``duration`` in s.

    It unpacks into these three values. ``lateral`` is the drift to the left of the launch in m; it
    is 0 for bodies with isotropic friction.
    """

    lateral: float | Array = 0.0


class Launch(NamedTuple):
    """Initial velocity of a slide: ``speed`` in m/s, ``spin`` in rad/s."""

    speed: float | Array
    spin: float | Array


class Profile(NamedTuple):
    """A slide over time: arrays of shape (shape of the launches..., shape of the times...).

    ``speed`` in m/s and ``spin`` in rad/s are the values at these times; ``distance`` in m and
    ``rotation`` in rad are those covered until then.
    """

    times: Array
    speed: Array
    spin: Array
    distance: Array
    rotation: Array


class SlideModel(Protocol):
    """Interface of a sliding model of one body on one table, in SI units. Twists and displacements
    are (n, 3) in the body's axes at the launch. :class:`~tapping_cell.mechanics.sliding.Sliding`
    documents the methods.
    """

    def rest(self, speed: ArrayLike, spin: ArrayLike, direction: ArrayLike) -> Rest:
        """Compute where and when the slide with these launch velocities ends."""

    def launch(self, distance: ArrayLike, rotation: ArrayLike, direction: ArrayLike) -> Launch:
        """Compute the launch that ends after this displacement."""

    def displace(self, twist: Array) -> Array:
        """Compute the displacements of launches."""

    def twist_for(self, displacement: Array) -> Array:
        """Compute the launches that cause these displacements."""

    def profile(self, speed: Array, spin: Array, direction: Array, times: Array) -> Profile:
        """Compute the motion of launches (n,) at times (k,); results (n, k)."""
