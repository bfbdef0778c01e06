"""What the sliding models return."""

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
    """A slide's end: ``distance`` along the launch in m, ``rotation`` in rad, ``duration`` in s.

    It unpacks into these three. ``lateral`` is the drift to the left of the launch in m: 0 for
    bodies whose friction is the same in all directions.
    """

    lateral: float | Array = 0.0


class Launch(NamedTuple):
    """Velocity with which a slide begins: ``speed`` in m/s, ``spin`` in rad/s."""

    speed: float | Array
    spin: float | Array


class Profile(NamedTuple):
    """A slide in time: arrays of shape (shape of the launches..., shape of the times...).

    ``speed`` in m/s and ``spin`` in rad/s at the times, ``distance`` in m and ``rotation`` in rad
    covered until then.
    """

    times: Array
    speed: Array
    spin: Array
    distance: Array
    rotation: Array


class SlideModel(Protocol):
    """One body on one table, in SI units; :class:`~tapping_cell.mechanics.sliding.Sliding`
    documents the methods. Twists and displacements are (n, 3) in the body's axes at the launch.
    """

    def rest(self, speed: ArrayLike, spin: ArrayLike, direction: ArrayLike) -> Rest:
        """Where a launch ends."""

    def launch(self, distance: ArrayLike, rotation: ArrayLike, direction: ArrayLike) -> Launch:
        """The launch that ends there."""

    def displace(self, twist: Array) -> Array:
        """Displacements of launches."""

    def twist_for(self, displacement: Array) -> Array:
        """Launches of displacements."""

    def profile(self, speed: Array, spin: Array, direction: Array, times: Array) -> Profile:
        """Launches (n,) in time (k,); results (n, k)."""
