"""Faults of the camera and of the table that occurred in recorded image sequences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, MARKER, REFERENCES, renderer

from tapping_cell.vision import PoseTracker, Problem

HOME = np.array([0.1, 0.05, 0.4])
FRAME = 1.0 / 30.0


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    scene = renderer()
    return [scene.render(HOME) for _ in range(6)]


def copied(image: np.ndarray, corners: np.ndarray, x: int, y: int) -> np.ndarray:
    """Return the image with a copy of the patch around these corners (4, 2) at (x, y)."""
    low, high = corners.min(axis=0).astype(int) - 12, corners.max(axis=0).astype(int) + 12
    patch = image[low[1] : high[1], low[0] : high[0]]
    twice = image.copy()
    twice[y : y + patch.shape[0], x : x + patch.shape[1]] = patch
    return twice


@pytest.mark.parametrize("buffers", [1, 2, 4])
def test_a_camera_that_repeats_its_buffers_is_frozen(pictures, buffers):
    tracker = PoseTracker(CAMERA, REFERENCES, MARKER)
    for number in range(6):
        assert tracker.update(pictures[number], number * FRAME).visible
    for number in range(6, 14):
        seen = tracker.update(pictures[6 - buffers + number % buffers], number * FRAME)
        assert seen.problem is Problem.FROZEN_FRAME


@pytest.mark.parametrize("noise", [0.0, 2.5, 4.0])
def test_a_dark_image_is_reported_as_dark_at_any_noise_level(noise):
    random = np.random.default_rng(1)
    dark = np.clip(8.0 + noise * random.standard_normal((1024, 1280)), 0, 255).astype(np.uint8)
    seen = PoseTracker(CAMERA, REFERENCES, MARKER).update(dark, 0.0)
    assert seen.problem is Problem.DARK


def test_errors_found_by_a_search_are_reported_for_every_frame_until_the_next(pictures):
    tracker = PoseTracker(CAMERA, REFERENCES, MARKER)
    tracker.update(pictures[0], 0.0)
    corners = tracker.view.project(HOME[:2] + 0.03 * np.array([[-1, -1], [1, 1]]), 0.012)
    problems = []
    for number in range(1, 40):
        twice = copied(pictures[number % 6], corners, 250, 650)
        twice[0, 0] = number  # makes the image different from all earlier ones
        problems.append(tracker.update(twice, number * FRAME).problem)
    first = problems.index(Problem.DUPLICATE_MARKER)
    assert first <= 30
    assert set(problems[first:]) == {Problem.DUPLICATE_MARKER}


def test_a_mirrored_image_is_reported_from_the_first_frame(pictures):
    tracker = PoseTracker(CAMERA, REFERENCES, MARKER)
    seen = tracker.update(np.ascontiguousarray(pictures[0][:, ::-1]), 0.0)
    assert seen.problem is Problem.MIRRORED_MARKER


def test_markers_that_are_all_turned_by_180_degrees_are_named(pictures):
    turned = [replace(marker, theta=marker.theta + np.pi) for marker in REFERENCES.markers]
    tracker = PoseTracker(CAMERA, replace(REFERENCES, markers=tuple(turned)), MARKER)
    seen = tracker.update(pictures[0], 0.0)
    assert seen.problem is Problem.TABLE_CONTRADICTED
    assert "turned by 180 degrees against the table file" in seen.sentence


def test_a_copy_of_a_reference_marker_is_reported_and_not_used(pictures):
    tracker = PoseTracker(CAMERA, REFERENCES, MARKER)
    tracker.update(pictures[0], 0.0)
    corners = tracker.view.project(tracker.table.points[0])
    for number in range(1, 40):
        twice = copied(pictures[number % 6], corners, 250, 650)
        twice[0, 0] = number
        seen = tracker.update(twice, number * FRAME)
        assert seen.visible
        assert np.hypot(seen.pose.x - HOME[0], seen.pose.y - HOME[1]) < 5e-5
    name = REFERENCES.markers[0].id
    assert f"reference marker {name} is seen more than once" in seen.sentence
