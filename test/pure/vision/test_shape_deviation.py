"""Detection of a lifted or tilted object, and of a table that differs from its file. The markers
are exact squares in space that are projected point by point."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA as SCENE_CAMERA
from scenes import MARKER as SCENE_MARKER
from scenes import REFERENCES as SCENE_REFERENCES
from scenes import renderer

from tapping_cell.vision import (
    CameraModel,
    CameraPose,
    ObjectMarker,
    PoseTracker,
    ReferenceMap,
    View,
)
from tapping_cell.vision.markers.detection import UNIT_CORNERS, ReferenceMarker
from tapping_cell.vision.markers.edges import BINS, MarkerEdges
from tapping_cell.vision.markers.object_pose import fit_marker, object_pose
from tapping_cell.vision.markers.shape_deviation import ShapeWarnings, shape_deviation
from tapping_cell.vision.table.tracker import TableState, TableTracker

CAMERA = CameraModel(1280, 1024, 1150.0, 1150.0, 639.5, 511.5, (-0.12, 0.08, 0.0004, -0.0003))
VIEW = View(CAMERA, CameraPose.above((0.01, -0.02, 0.7), aim=(0.03, 0.01), spin=0.1))
PLACES = [(x, y) for x in (-0.3, 0.0, 0.3) for y in (-0.22, 0.0, 0.22) if (x, y) != (0.0, 0.0)]
MARKER = ObjectMarker("APRILTAG_36h11", 1, 0.05, 0.012, offset=(0.004, -0.003, 0.4))
NOISE = 0.02
"""Standard deviation of a row's edge in pixels."""


def edges_of(corners: np.ndarray, random: np.random.Generator, bloom: float = 0.0) -> MarkerEdges:
    """Return the edges of squares in space, with the corners (M, 4, 3), in the image of VIEW. The
    squares are enlarged by ``bloom`` pixels."""
    share = (np.arange(BINS) + 0.5) / BINS
    ahead = np.roll(corners, -1, axis=1)
    sides = corners[:, :, None] + share[:, None] * (ahead - corners)[:, :, None]
    pixels = VIEW.project(corners)
    along = np.roll(pixels, -1, axis=1) - pixels
    normal = np.stack([along[..., 1], -along[..., 0]], -1)
    normal /= np.linalg.norm(along, axis=2)[..., None]
    weights = np.full(sides.shape[:3], 60.0 / BINS)
    off = bloom + random.standard_normal(weights.shape) * NOISE / np.sqrt(weights)
    points = VIEW.project(sides) + off[..., None] * normal[:, :, None]
    level = np.zeros(len(corners))
    spread = np.full(len(corners), NOISE)
    return MarkerEdges(
        points, weights, pixels, spread, level, level, level, np.ones(len(corners), dtype=bool)
    )


def object_corners(pose: np.ndarray, lift: float, tilt: float) -> np.ndarray:
    """Return the corners (4, 3) of the marker of an object at ``pose``, tilted about the x axis
    through its centre by ``tilt`` rad, and lifted by ``lift`` m."""
    cos, sin = math.cos(MARKER.offset[2]), math.sin(MARKER.offset[2])
    flat = UNIT_CORNERS * MARKER.size @ np.array([[cos, sin], [-sin, cos]]) + MARKER.offset[:2]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    out = np.array([flat[:, 0], flat[:, 1] * math.cos(tilt), flat[:, 1] * math.sin(tilt)])
    turned = np.array([cos * out[0] - sin * out[1], sin * out[0] + cos * out[1], out[2]])
    return (turned + np.array([[pose[0]], [pose[1]], [MARKER.height + lift]])).T


def judged(pose: np.ndarray, lift: float, tilt: float, seed: int) -> tuple:
    """Return the deviation of the shape and the error of the measured pose (3,). If no square fits
    the edges, return None and zeros."""
    edges = edges_of(object_corners(pose, lift, tilt)[None], np.random.default_rng(seed))
    fit = fit_marker(VIEW, edges, 0, MARKER)
    if fit is None:
        return None, np.zeros(3)
    shape = shape_deviation(VIEW, edges, 0, MARKER, fit, 0.0)
    measured, _ = object_pose(fit.pose, fit.covariance, MARKER)
    error = measured - pose
    error[2] = math.remainder(error[2], 2.0 * math.pi)
    return shape, error


@pytest.mark.parametrize("lift", [0.002, 0.005, 0.012, -0.004])
@pytest.mark.parametrize("tilt", [0.0, 0.03, -0.08])
def test_a_lifted_or_tilted_object_is_flagged_and_its_covariance_covers_the_error(lift, tilt):
    for trial in range(10):
        random = np.random.default_rng(trial)
        pose = random.uniform([-0.25, -0.15, -3.0], [0.25, 0.15, 3.0])
        shape, error = judged(pose, lift, tilt, trial)
        if shape is None:
            continue
        assert not shape.negligible
        sigma = np.sqrt(np.diag(shape.covariance))
        assert np.hypot(error[0], error[1]) < 3.0 * np.hypot(sigma[0], sigma[1]) + 3e-4
        assert abs(error[2]) < 3.0 * sigma[2] + 2e-3


def test_the_height_tolerance_covers_a_small_lift():
    """Measure an object that is half a millimetre lower than its file states, with and without a
    tolerance of this size."""
    pose, lift = np.array([0.21, -0.12, 0.4]), 0.0005
    image, covariances = renderer().render(pose), []
    for tolerance in (0.0, lift):
        lifted = replace(SCENE_MARKER, height=SCENE_MARKER.height - lift)
        marker = replace(lifted, height_tolerance=tolerance)
        seen = PoseTracker(SCENE_CAMERA, SCENE_REFERENCES, marker).update(image, 0.0)
        assert seen.pose is not None and seen.covariance is not None
        error = np.array([*seen.pose]) - pose
        covariances.append(seen.covariance)
    added = covariances[1] - covariances[0]
    assert not added[2].any() and not added[:, 2].any()
    # The added standard deviation is the error, in its direction.
    assert added[:2, :2] == pytest.approx(np.outer(error[:2], error[:2]), rel=0.15)
    assert error @ np.linalg.solve(covariances[0], error) > 100.0
    assert error @ np.linalg.solve(covariances[1], error) < 5.0


def test_a_flat_object_is_not_flagged():
    for trial in range(40):
        random = np.random.default_rng(trial)
        pose = random.uniform([-0.25, -0.15, -3.0], [0.25, 0.15, 3.0])
        shape, _ = judged(pose, 0.0, 0.0, trial)
        assert shape.negligible
        assert not shape.covariance.any()


def test_a_deviation_of_all_markers_is_not_a_size_error():
    edges = edges_of(object_corners(np.zeros(3), 0.0, 0.0)[None], np.random.default_rng(1), 0.4)
    fit = fit_marker(VIEW, edges, 0, MARKER)
    assert fit is not None
    assert not shape_deviation(VIEW, edges, 0, MARKER, fit, 0.0).negligible
    assert shape_deviation(VIEW, edges, 0, MARKER, fit, 0.4).negligible


def test_the_warning_text_is_unchanged_while_the_shape_deviation_persists():
    pose, warnings = np.array([0.2, 0.1, 0.3]), ShapeWarnings(MARKER)
    sentences = {warnings.sentence(judged(pose, 0.005, 0.0, seed)[0], 0.7) for seed in range(10)}
    (sentence,) = sentences
    assert (
        "by +0.7 % from 50.0 mm" in sentence
        and "lifted (by 5 mm if this is the only cause)" in sentence
    )
    assert warnings.sentence(judged(pose, 0.0, 0.0, 1)[0], 0.7) == ""


# -- the table


def references(places=PLACES, size=0.04) -> ReferenceMap:
    markers = [ReferenceMarker(10 + i, size, x, y) for i, (x, y) in enumerate(places)]
    return ReferenceMap("APRILTAG_36h11", tuple(markers))


def reference_edges(table: ReferenceMap, seed: int, moved=(), bloom=0.0) -> MarkerEdges:
    """Return the edges of the table's markers. ``moved`` contains the moved markers as pairs: the
    marker's row in ``table.corners()``, and its shift (x, y) in m."""
    flat = table.corners()
    for row, shift in moved:
        flat[row] += shift
    corners = np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)
    return edges_of(corners, np.random.default_rng(seed), bloom)


def off(tracker: TableTracker) -> float:
    """Return the largest error, in m, of the tracker's view at three places of the table."""
    assert tracker.pose is not None
    points = np.array([[0.1, 0.05], [-0.15, 0.1], [0.05, -0.1]])
    seen = View(CAMERA, tracker.pose).on_plane(VIEW.project(points, 0.012), 0.012)
    return float(np.linalg.norm(seen - points, axis=1).max())


@pytest.mark.parametrize("row", range(8))
@pytest.mark.parametrize("shift", [(0.004, -0.003), (0.05, 0.0), (-0.1, 0.08)])
def test_the_one_marker_displaced_from_the_file_is_named(row, shift):
    table = references()
    tracker = TableTracker(CAMERA, table)
    state = tracker.update(reference_edges(table, row, [(row, shift)]), np.arange(8))
    assert state is TableState.STEADY
    assert tracker.displaced == (10 + row,)
    assert off(tracker) < 3e-5


@pytest.mark.parametrize("bloom", [-0.5, 0.5])
@pytest.mark.parametrize("places", [PLACES[:3], PLACES[::3], PLACES])
def test_marker_sides_all_displaced_outwards_do_not_move_the_table(bloom, places):
    table = references(places)
    tracker = TableTracker(CAMERA, table)
    tracker.update(reference_edges(table, 3, bloom=bloom), np.arange(len(places)))
    sharp = TableTracker(CAMERA, table)
    sharp.update(reference_edges(table, 3), np.arange(len(places)))
    assert tracker.bloom == pytest.approx(bloom, abs=0.05)
    assert off(tracker) == pytest.approx(off(sharp), abs=1e-4)


@pytest.mark.parametrize("size", [0.03, 0.05])
@pytest.mark.parametrize("count", [2, 4, 8])
def test_a_file_with_wrong_sizes_is_reported(size, count):
    board = references(PLACES[:count], size)
    tracker = TableTracker(CAMERA, board)
    edges = reference_edges(references(PLACES[:count]), 1)
    assert tracker.update(edges, np.arange(count)) is TableState.CONTRADICTED


def test_a_marker_moved_by_hand_is_excluded_until_it_is_back():
    table = references()
    tracker = TableTracker(CAMERA, table)
    moved = [(3, (0.0003, 0.0002))]
    for frame in range(20):
        tracker.update(reference_edges(table, frame), np.arange(8))
    for frame in range(20, 40):
        state = tracker.update(reference_edges(table, frame, moved), np.arange(8))
        assert state is TableState.STEADY
        assert off(tracker) < 3e-5
    assert tracker.displaced == (13,)
    for frame in range(40, 50):
        tracker.update(reference_edges(table, frame), np.arange(8))
    assert tracker.displaced == ()


def test_many_markers_displaced_one_by_one_indicate_a_moved_camera():
    table = references()
    tracker = TableTracker(CAMERA, table)
    for frame in range(20):
        tracker.update(reference_edges(table, frame), np.arange(8))
    moved = [(row, (0.0006, 0.0)) for row in (0, 3, 6)]
    states = set()
    for frame in range(20, 40):
        states.add(tracker.update(reference_edges(table, frame, moved), np.arange(8)))
    assert TableState.MOVED in states


@pytest.mark.parametrize("shift", [(0.002, 0.0), (-0.005, 0.0), (0.0, 0.005), (0.003, -0.004)])
def test_one_of_two_markers_moved_does_not_indicate_a_moved_camera(shift):
    table = references([(-0.3, 0.0), (0.3, 0.0)])
    tracker = TableTracker(CAMERA, table)
    for frame in range(20):
        tracker.update(reference_edges(table, frame), np.arange(2))
    for frame in range(20, 30):
        moved = reference_edges(table, frame, [(0, shift)])
        state = tracker.update(moved, np.arange(2))
        assert frame < 22 or state is TableState.CONTRADICTED
    assert tracker.apart
    for frame in range(30, 40):
        state = tracker.update(reference_edges(table, frame), np.arange(2))
    assert state is TableState.STEADY and off(tracker) < 1e-3
