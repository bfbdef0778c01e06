"""Maps of reference markers in another frame or at another scale."""

from __future__ import annotations

import numpy as np

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.se2 import compose, inverse, transform_points, wrap_angle
from tapping_cell.vision.camera import Array
from tapping_cell.vision.markers.detection import ReferenceMap, ReferenceMarker


def in_frame(references: ReferenceMap, frame: Array) -> ReferenceMap:
    """The same markers in another frame, whose pose (x, y, theta) in the old one is ``frame``."""
    poses = compose(inverse(frame), _poses(references))
    return with_poses(references, poses, 1.0)


def scaled(references: ReferenceMap, factor: float) -> ReferenceMap:
    """The same map with all lengths multiplied, the markers' sizes as well."""
    poses = _poses(references) * np.array([factor, factor, 1.0])
    return with_poses(references, poses, factor)


def _poses(references: ReferenceMap) -> Array:
    """Poses (M, 3) of the markers."""
    return np.array([[m.x, m.y, m.theta] for m in references.markers])


def with_poses(references: ReferenceMap, poses: Array, factor: float) -> ReferenceMap:
    """The markers at other poses (M, 3), their sizes multiplied."""
    angles = wrap_angle(poses[:, 2])
    return ReferenceMap(
        references.dictionary,
        tuple(
            ReferenceMarker(m.id, m.size * factor, float(x), float(y), float(angle))
            for m, x, y, angle in zip(
                references.markers, poses[:, 0], poses[:, 1], angles, strict=True
            )
        ),
    )


def frame_of_markers(references: ReferenceMap, origin: int, along: int) -> Array:
    """The frame with its origin on one marker and its x axis through another, shape (3,).

    Raises:
        CalibrationRefused: one of them is not in the map.
    """
    places = {m.id: np.array([m.x, m.y]) for m in references.markers}
    for number in (origin, along):
        if number not in places:
            raise CalibrationRefused(f"marker {number} was not seen; seen are {sorted(places)}")
    way = places[along] - places[origin]
    return np.array([*places[origin], np.arctan2(way[1], way[0])])


def frame_of_map(references: ReferenceMap, old: ReferenceMap) -> tuple[Array, float]:
    """The frame in which the markers lie nearest to where ``old`` has them, shape (3,), and the
    root mean square of the distances that remain, in m.

    Raises:
        CalibrationRefused: fewer than two markers are in both.
    """
    before = {m.id: (m.x, m.y) for m in old.markers}
    now = {m.id: (m.x, m.y) for m in references.markers}
    both = sorted(set(before) & set(now))
    if len(both) < 2:
        raise CalibrationRefused(
            f"only the markers {both} are seen of the old table file's {sorted(before)}; two are"
            " needed to keep its frame"
        )
    a, b = np.array([before[i] for i in both]), np.array([now[i] for i in both])
    frame = rigid(a, b)
    left = transform_points(frame, a) - b
    return frame, float(np.sqrt((left**2).sum(axis=1).mean()))


def rigid(a: Array, b: Array) -> Array:
    """The pose that brings points ``a`` (N, 2) nearest to points ``b`` (N, 2)."""
    da, db = a - a.mean(axis=0), b - b.mean(axis=0)
    cross = (da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]).sum()
    angle = float(np.arctan2(cross, (da * db).sum()))
    origin = b.mean(axis=0) - transform_points(np.array([0.0, 0.0, angle]), a.mean(axis=0))
    return np.array([*origin, angle])
