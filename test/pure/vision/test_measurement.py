"""Edges of markers, tested on brute-force images instead of the project's renderer."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import CAMERA, MARKER, POSE, area_sampled_marker

from tapping_cell.se2 import transform_points, wrap_angle
from tapping_cell.vision import CameraModel, CameraPose, MarkerError, ObjectMarker, View
from tapping_cell.vision.markers.detection import (
    UNIT_CORNERS,
    dictionary_name,
    find_markers,
    marker_pattern,
)
from tapping_cell.vision.markers.edges import refine
from tapping_cell.vision.markers.object_pose import fit_marker, object_pose
from tapping_cell.vision.outline.pixels import window_rays

VIEW = View(CAMERA, POSE)
PIXEL = 0.7 / 1150.0


def scene(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return an image, the true pose, and the marker's corners in pixels with noise of 0.5 pixels
    (standard deviation)."""
    random = np.random.default_rng(seed)
    pose = random.uniform([-0.24, -0.17, -np.pi], [0.24, 0.17, np.pi])
    noise = random.normal(0.0, 2.0, (1024, 1280))
    image = area_sampled_marker(VIEW, MARKER, pose, noise)
    corners = VIEW.project(transform_points(pose, UNIT_CORNERS * MARKER.size), MARKER.height)
    return image, pose, corners + random.normal(0.0, 0.5, (4, 2))


def errors(found: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
    """Return the errors in mm and degrees."""
    turn = abs(float(wrap_angle(found[2] - pose[2])))
    return float(np.hypot(*(found - pose)[:2])) * 1e3, np.degrees(turn)


def test_one_frame_reaches_its_stated_accuracy():
    """Check the accuracy stated in the documentation (median and 90 % quantile of 24 scenes), and
    the covariance."""
    off, normalised = [], []
    for seed in range(24):
        image, pose, quad = scene(seed)
        fit = fit_marker(VIEW, refine(image, quad[None], 8), 0, MARKER)
        assert fit is not None
        assert fit.size == pytest.approx(MARKER.size, rel=1e-3)
        off.append(errors(fit.pose, pose))
        error = fit.pose - pose
        error[2] = wrap_angle(error[2])
        normalised.append(error @ np.linalg.solve(fit.covariance, error))
    assert np.all(np.median(off, axis=0) < [0.008, 0.015])
    assert np.all(np.quantile(off, 0.9, axis=0) < [0.02, 0.05])
    # The chi-square value of 24 scenes with 3 degrees of freedom each is between 40 and 115 with a
    # probability of 99.8 %.
    assert 40 / 24 < np.mean(normalised) < 115 / 24


def test_a_half_hidden_edge_is_rejected():
    image, _, quad = scene(3)
    x, y = quad.mean(axis=0).astype(int)
    image[y - 60 : y + 60, x : x + 70] = 120
    assert not refine(image, quad[None], 8).good[0]


def test_the_object_pose_follows_from_its_marker():
    marker = ObjectMarker(MARKER.dictionary, 3, 0.05, 0.012, (0.02, -0.01, 0.7))
    true = np.array([0.1, -0.05, 2.9])
    pose, covariance = object_pose(
        np.array([*transform_points(true, marker.offset[:2]), true[2] + 0.7]),
        np.diag([1e-10, 1e-10, 1e-6]),
        marker,
    )
    assert pose == pytest.approx(true)
    # The uncertainty of the marker's angle adds to the uncertainty of the object's centre.
    assert covariance[0, 0] + covariance[1, 1] == pytest.approx(2e-10 + 1e-6 * (0.02**2 + 0.01**2))


def test_marker_search_offsets_and_orientation():
    image, pose, _ = scene(4)
    true = VIEW.project(transform_points(pose, UNIT_CORNERS * MARKER.size), MARKER.height)
    x0, y0 = (int(v) for v in true.min(axis=0) - 40)
    for region in (None, (x0, y0, x0 + 220, y0 + 220)):
        (found,) = find_markers(image, MARKER.dictionary, region)
        assert found.id == MARKER.id
        assert np.abs(found.corners - true).max() < 2.0


@pytest.mark.parametrize(
    ("name", "official"),
    [
        ("apriltag_36h11", "DICT_APRILTAG_36H11"),
        ("tag36h11", "DICT_APRILTAG_36H11"),
        ("DICT_APRILTAG_25h9", "DICT_APRILTAG_25H9"),
        ("aruco_4x4_50", "DICT_4X4_50"),
        ("5X5_100", "DICT_5X5_100"),
        ("DICT_ARUCO_ORIGINAL", "DICT_ARUCO_ORIGINAL"),
    ],
)
def test_dictionaries_are_selected_by_their_usual_names(name, official):
    assert dictionary_name(name).upper() == official


def test_markers_that_do_not_exist_are_refused():
    with pytest.raises(MarkerError, match="unknown"):
        dictionary_name("apriltag_99h1")
    with pytest.raises(MarkerError, match="0 to 586"):
        marker_pattern("apriltag_36h11", 587)
    with pytest.raises(MarkerError, match="size"):
        ObjectMarker("apriltag_36h11", 1, 0.0, 0.01)


def test_rays_of_a_window_match_the_camera():
    strong = CameraModel(1280, 1024, 800.0, 800.0, 639.5, 511.5, (-0.3, 0.12, 1e-3, -1e-3, -0.02))
    window = window_rays(strong, 900, 700, 1100, 880)
    y, x = np.mgrid[700:880:20, 900:1100:20]
    exact = strong.rays(np.stack([x, y], axis=-1).astype(float))
    assert np.abs(window[::20, ::20] - exact).max() * 800.0 < 1e-5


def test_camera_pose_of_a_tilted_view_is_not_square():
    """The edges are fitted in the plane of the marker, so a tilt of 5 degrees causes no error in
    the measured size."""
    view = View(CAMERA, CameraPose.above((0.06, 0.0, 0.7)))
    pose = np.array([-0.2, 0.1, 0.3])
    image = area_sampled_marker(view, MARKER, pose)
    quad = view.project(transform_points(pose, UNIT_CORNERS * MARKER.size), MARKER.height)
    fit = fit_marker(view, refine(image, quad[None], 8), 0, MARKER)
    assert errors(fit.pose, pose)[0] < 0.005
    assert fit.size == pytest.approx(MARKER.size, rel=3e-4)


@pytest.mark.parametrize("smear", [5.0, 8.5, 11.0, 15.0])
def test_a_motion_blurred_marker_is_accurate_or_reported_as_uncertain(smear):
    """The marker is smeared by ``smear`` pixels, and the search begins up to three pixels away."""
    random = np.random.default_rng(int(smear))
    measured = 0
    for _ in range(4):
        pose = random.uniform([-0.2, -0.15, -np.pi], [0.2, 0.15, np.pi])
        angle = random.uniform(-np.pi, np.pi)
        step = smear * PIXEL * np.array([np.cos(angle), np.sin(angle), 0.0])
        shares = (np.arange(12) + 0.5) / 12 - 0.5
        moments = [area_sampled_marker(VIEW, MARKER, pose + s * step, samples=5) for s in shares]
        noise = random.normal(0.0, 2.0, moments[0].shape)
        image = np.rint(np.clip(np.mean(moments, axis=0) + noise, 0, 255)).astype(np.uint8)
        quad = VIEW.project(transform_points(pose, UNIT_CORNERS * MARKER.size), MARKER.height)
        edges = refine(image, quad[None] + random.uniform(-2.0, 2.0, 2), 10)
        fit = fit_marker(VIEW, edges, 0, MARKER)
        if fit is None:
            continue
        measured += 1
        error = fit.pose - pose
        error[2] = wrap_angle(error[2])
        assert error @ np.linalg.solve(fit.covariance, error) < 25.0
    assert measured == 4 or smear > 10.0
