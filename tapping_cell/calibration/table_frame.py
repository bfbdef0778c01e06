"""Conversion of maps of reference markers to another frame or scale."""

from __future__ import annotations

import numpy as np

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.se2 import Array, compose, inverse, transform_points, wrap_angle
from tapping_cell.vision.markers.detection import ReferenceMap, ReferenceMarker


def in_frame(references: ReferenceMap, frame: Array) -> ReferenceMap:
    """Transform the markers to a new frame. ``frame`` is the pose (x, y, theta) of the new frame in
    the old one."""
    poses = compose(inverse(frame), _poses(references))
    return with_poses(references, poses, 1.0)


def scaled(references: ReferenceMap, factor: float) -> ReferenceMap:
    """Scale all lengths of the map, including the markers' sizes."""
    poses = _poses(references) * np.array([factor, factor, 1.0])
    return with_poses(references, poses, factor)


def _poses(references: ReferenceMap) -> Array:
    """Return the poses (M, 3) of the markers."""
    return np.array([[m.x, m.y, m.theta] for m in references.markers])


def with_poses(references: ReferenceMap, poses: Array, factor: float) -> ReferenceMap:
    """Return the markers with other poses (M, 3) and with sizes multiplied by ``factor``."""
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
    """Return the frame (3,) with its origin on one marker and its x axis through another marker.

    Raises:
        CalibrationRefused: one of the two markers is not in the map.
    """
    places = {m.id: np.array([m.x, m.y]) for m in references.markers}
    for number in (origin, along):
        if number not in places:
            raise CalibrationRefused(
                f"marker {number} was not seen; the markers seen are {sorted(places)}"
            )
    way = places[along] - places[origin]
    return np.array([*places[origin], np.arctan2(way[1], way[0])])


def frame_of_map(references: ReferenceMap, old: ReferenceMap) -> tuple[Array, float]:
    """Fit the frame (3,) in which the markers are closest to their positions in ``old``.

    The second value is the root mean square of the remaining distances, in m.

    Raises:
        CalibrationRefused: the maps have fewer than two markers in common.
    """
    before = {m.id: (m.x, m.y) for m in old.markers}
    now = {m.id: (m.x, m.y) for m in references.markers}
    both = sorted(set(before) & set(now))
    if len(both) < 2:
        raise CalibrationRefused(
            f"of the old table file's markers {sorted(before)}, only {both} are seen; two are"
            " needed to keep the file's frame"
        )
    a, b = np.array([before[i] for i in both]), np.array([now[i] for i in both])
    frame = rigid(a, b)
    left = transform_points(frame, a) - b
    return frame, float(np.sqrt((left**2).sum(axis=1).mean()))


def rigid(a: Array, b: Array) -> Array:
    """Fit the rigid transform from points ``a`` (N, 2) to points ``b`` (N, 2) by least squares."""
    da, db = a - a.mean(axis=0), b - b.mean(axis=0)
    cross = (da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]).sum()
    angle = float(np.arctan2(cross, (da * db).sum()))
    origin = b.mean(axis=0) - transform_points(np.array([0.0, 0.0, angle]), a.mean(axis=0))
    return np.array([*origin, angle])
