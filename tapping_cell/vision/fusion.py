"""Fuse repeated measurements of one pose: robust mean and its covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.se2 import wrap_angle
from tapping_cell.vision.camera import Array

_HUBER = 3.0
"""Mahalanobis distance beyond which a frame gets less weight. With 3 degrees of freedom, 2.9 % of
the inlier frames exceed it."""


def fuse(poses: ArrayLike, covariances: ArrayLike) -> tuple[Array, Array]:
    """Return the robust mean (3,) of poses (N, 3; m, m, rad) with covariances (N, 3, 3), and the
    covariance (3, 3) of this mean.

    Uses Huber's weights on the Mahalanobis distance, starting from the median. The errors of the
    poses are assumed to be independent.
    """
    information = np.linalg.inv(np.asarray(covariances, dtype=float))
    return fuse_information(np.asarray(poses, dtype=float), information)


def fuse_information(p: Array, information: Array) -> tuple[Array, Array]:
    """Fuse poses (N, 3) as :func:`fuse` does, from the inverses (N, 3, 3) of their covariances."""
    relative = pose_difference(p, p[0])
    mean = _median(relative)
    pulls = np.matmul(information, relative[..., None])[..., 0]
    rows = information.reshape(-1, 9)
    before: Array | None = None
    for _ in range(4):
        error = relative - mean
        square = (np.matmul(information, error[..., None])[..., 0] * error).sum(axis=1)
        weight = np.minimum(1.0, _HUBER / np.sqrt(np.maximum(square, 1e-24)))
        if before is not None and (weight == before).all():
            break
        total = (weight @ rows).reshape(3, 3)
        mean = np.linalg.solve(total, weight @ pulls)
        before = weight
    fused = p[0] + mean
    fused[2] = wrap_angle(fused[2])
    return fused, np.linalg.inv(total)


def pose_difference(first: Array, second: Array) -> Array:
    """Return the differences (..., 3) of poses (..., 3), with the angle wrapped."""
    difference = first - second
    difference[..., 2] = wrap_angle(difference[..., 2])
    return difference


def _median(rows: Array) -> Array:
    """Median (3,) of each column of (N, 3); ten times as fast as numpy's median for a few rows."""
    ordered, half = np.sort(rows, axis=0), len(rows) // 2
    return np.asarray(ordered[half] if len(rows) % 2 else (ordered[half - 1] + ordered[half]) / 2)
