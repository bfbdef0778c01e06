"""Return types of the sliding models."""

from __future__ import annotations

from typing import NamedTuple

from tapping_cell.mechanics.planar import Array


class _RestFields(NamedTuple):
    distance: float | Array
    rotation: float | Array
    duration: float | Array


class Rest(_RestFields):
    """End of a slide: ``distance`` along the launch in m, ``rotation`` in rad, ``duration`` in s.

    The result unpacks into these three values. ``lateral`` is the drift to the left of the launch
    in m; it is 0 for bodies with isotropic friction.
    """

    lateral: float | Array = 0.0


class Launch(NamedTuple):
    """Initial velocity of a slide: ``speed`` in m/s, ``spin`` in rad/s."""

    speed: float | Array
    spin: float | Array


class Profile(NamedTuple):
    """A slide over time: arrays of shape (shape of the launches..., shape of the times...).

    ``speed`` in m/s and ``spin`` in rad/s are the values at these times; ``distance`` in m and
    ``rotation`` in rad are those covered from the launch until these times.
    """

    times: Array
    speed: Array
    spin: Array
    distance: Array
    rotation: Array
