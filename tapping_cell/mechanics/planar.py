"""Vectors in the plane, arrays of shape (..., 2), and their rotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def unit(angle: ArrayLike) -> Array:
    """Return the unit vectors (..., 2) in the directions ``angle`` (rad)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def cross(a: Array, b: Array) -> Array:
    """Compute the cross products (...,) of vectors (..., 2): positive if b is to the left of a."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def rotate(vector: Array, angle: Array) -> Array:
    """Rotate vectors (..., 2) by ``angle`` (rad)."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def turn(planar: Array, angle: Array) -> Array:
    """Rotate twists or displacements (..., 3) by ``angle`` (rad). The result equals the components
    of these vectors in axes rotated by -angle."""
    return np.concatenate([rotate(planar[..., :2], angle), planar[..., 2:]], axis=-1)


def to_left(vector: Array) -> Array:
    """Rotate vectors (..., 2) by +90 degrees."""
    return np.stack([-vector[..., 1], vector[..., 0]], axis=-1)


def to_right(vector: Array) -> Array:
    """Rotate vectors (..., 2) by -90 degrees."""
    return np.stack([vector[..., 1], -vector[..., 0]], axis=-1)
