"""Markers as in photographs: small, seen obliquely, or detected with one corner wrong by several
pixels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tapping_cell.vision.markers.detection import Effort, find_markers, marker_pattern
from tapping_cell.vision.markers.initial_corners import better_corners
from tapping_cell.vision.markers.measurement import measure
from tapping_cell.vision.markers.search import Detections
from tapping_cell.vision.table.tracker import side_noise

FINE = 12
"""Samples per pixel in each direction."""


def picture(
    pattern: np.ndarray, corners: np.ndarray, noise: float = 2.0, seed: int = 0, blur: float = 0.6
) -> np.ndarray:
    """Return an area-sampled image of 160 x 120 pixels of a printed pattern, with a margin of one
    module, on grey."""
    sheet = np.kron(np.pad(pattern, 1, constant_values=True), np.ones((30, 30))) * 150.0 + 40.0
    begin, end = 30.0 - 0.5, 30.0 * (pattern.shape[0] + 1) - 0.5
    source = np.array([[begin, begin], [end, begin], [end, end], [begin, end]], dtype=np.float32)
    target = ((corners + 0.5) * FINE - 0.5).astype(np.float32)
    matrix = cv2.getPerspectiveTransform(source, target)
    fine = np.full((120 * FINE, 160 * FINE), 110.0, dtype=np.float32)
    size = fine.shape[::-1]
    cv2.warpPerspective(
        sheet.astype(np.float32), matrix, size, fine, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT
    )
    soft = cv2.GaussianBlur(fine, (0, 0), blur * FINE)
    grey = soft.reshape(120, FINE, 160, FINE).mean(axis=(1, 3))
    grey = grey + np.random.default_rng(seed).normal(0.0, noise, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def square(side: float, turn: float, middle: tuple[float, float] = (78.3, 61.7)) -> np.ndarray:
    angle = turn + np.radians([225.0, 315.0, 45.0, 135.0])
    return np.asarray(middle) + side / np.sqrt(2.0) * np.stack(
        [np.cos(angle), np.sin(angle)], axis=-1
    )


@pytest.mark.parametrize("name", ["APRILTAG_36h11", "4X4_50", "ARUCO_ORIGINAL", "APRILTAG_16h5"])
def test_markers_with_3_pixels_per_module_reach_their_stated_accuracy(name):
    normalised, errors = [], []
    for seed in range(6):
        random = np.random.default_rng(seed)
        pattern = marker_pattern(name, seed)
        side = random.uniform(3.0, 4.0) * pattern.shape[0]
        corners = square(side, random.uniform(0.0, 2.0 * np.pi))
        image = picture(pattern, corners, seed=seed)
        edges, right = measure(
            image, (corners + random.normal(0, 0.3, (4, 2)))[None], [pattern], True
        )
        assert right.all()
        shift = edges.corners[0].mean(axis=0) - corners.mean(axis=0)
        errors.append(np.linalg.norm(shift))
        # The positions of the four sides have independent noise. In x and in y, the centre of the
        # marker therefore has half the variance of a side.
        normalised.append(shift @ shift / (0.5 * side_noise(edges, 1.0)[0] ** 2))
    assert np.max(errors) < 0.1
    assert np.mean(normalised) < 3.5


def test_modules_of_less_than_two_pixels_are_found_in_the_enlarged_image():
    found = {effort: 0 for effort in Effort}
    for seed in range(8):
        pattern = marker_pattern("APRILTAG_36h11", seed)
        corners = square(1.9 * 8, 0.3 * seed)
        for effort in Effort:
            seen = find_markers(
                picture(pattern, corners, seed=seed, blur=0.5),
                "APRILTAG_36h11",
                (20, 10, 150, 110),
                effort,
            )
            right = [d for d in seen if d.id == seed]
            found[effort] += len(right)
            assert len(seen) == len(right) <= 1
            if right:
                assert np.abs(right[0].corners - corners).max() < 1.5
    assert found[Effort.ENLARGED] >= 4
    assert found[Effort.ENLARGED] > found[Effort.THOROUGH]


def test_a_corner_that_the_search_found_elsewhere():
    """One corner of a searched quadrilateral is wrong by four pixels, as if glare had interrupted
    the outline. This corner must be corrected."""
    pattern = marker_pattern("ARUCO_ORIGINAL", 11)
    corners = square(34.0, 0.1)
    image = picture(pattern, corners)
    off = corners.copy()
    off[2] += [-3.5, -2.5]
    better = better_corners(image, off, pattern.shape[0])
    assert np.abs(better - corners).max() < 0.6
    edges, right = measure(image, off[None], [pattern], True)
    assert right.all()
    assert np.abs(edges.corners[0] - corners).max() < 0.1
    nothing = np.full_like(image, 100)
    assert np.abs(better_corners(nothing, off, 7) - off).max() < 34.0 * 0.3
    assert not measure(nothing, off[None], [pattern], True)[1].any()


def test_an_oblique_marker():
    """The modules are ten pixels long and four pixels wide."""
    pattern = marker_pattern("4X4_50", 3)
    corners = np.array([[50.2, 45.4], [108.7, 43.1], [117.3, 69.2], [43.6, 71.9]])
    image = picture(pattern, corners)
    edges, right = measure(image, (corners + 0.4)[None], [pattern], True)
    assert right.all()
    assert np.abs(edges.corners[0] - corners).max() < 0.15


def test_searches_of_one_image_are_combined():
    """A second search of the same image adds to the detections of the first search. If an id is
    then found at two places, these are two markers with the same id."""
    here, beside = square(20.0, 0.0), square(20.0, 0.0) + 0.4
    elsewhere = square(20.0, 0.0, (40.0, 40.0))
    first = Detections({1: here, 2: here, 3: here}, (7,))
    both = first.and_more(Detections({1: beside, 2: elsewhere, 4: elsewhere, 7: here}, (3,)))
    assert both.repeated == (2, 3, 7)
    assert both.single.keys() == {1, 4}
    assert both.single[1] is here
