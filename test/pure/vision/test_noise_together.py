"""Correlated noise, caused by smoothing or compression in the camera: its effect on the
covariance."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import CAMERA, MARKER, POSE, area_sampled_marker

from tapping_cell.se2 import transform_points, wrap_angle
from tapping_cell.vision import View
from tapping_cell.vision.markers.detection import UNIT_CORNERS
from tapping_cell.vision.markers.edges import refine
from tapping_cell.vision.markers.object_pose import fit_marker

VIEW = View(CAMERA, POSE)
PLACE = np.array([0.04, -0.03, 0.5])
DRAWS = 40


def smoothed(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def compressed(image: np.ndarray) -> np.ndarray:
    _, data = cv2.imencode(
        ".jpg", np.clip(np.rint(image), 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 80]
    )
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE).astype(float)


@pytest.mark.parametrize("camera", [smoothed, compressed])
def test_the_covariance_covers_the_error_for_any_camera_noise_processing(camera):
    """The mean normalised squared error must not exceed 3. The covariance of the edges is too large
    for smoothed noise, because the levels of black and white are less noisy than assumed."""
    clean = area_sampled_marker(VIEW, MARKER, PLACE, samples=20).astype(float)
    clean = cv2.GaussianBlur(clean, (0, 0), 0.8)
    x, y = VIEW.project(PLACE[:2], MARKER.height).astype(int)
    window = slice(y - 80, y + 80), slice(x - 80, x + 80)
    quad = VIEW.project(transform_points(PLACE, UNIT_CORNERS * MARKER.size), MARKER.height)
    random, image, normalised = np.random.default_rng(8), clean.astype(np.uint8), []
    for _ in range(DRAWS):
        noisy = camera(clean[window] + random.normal(0.0, 4.0, (160, 160)))
        image[window] = np.clip(np.rint(noisy), 0, 255)
        fit = fit_marker(VIEW, refine(image, quad[None], 8), 0, MARKER)
        assert fit is not None
        error = fit.pose - PLACE
        error[2] = wrap_angle(error[2])
        normalised.append(error @ np.linalg.solve(fit.covariance, error))
    # The mean is a chi-square value with 120 degrees of freedom, divided by 40. The asserted bound
    # is at four standard deviations.
    assert np.mean(normalised) < 4.5


@pytest.mark.parametrize(("block", "least", "most"), [(1, 0.8, 1.2), (4, 2.0, 4.0)])
def test_correlated_rows_carry_less_information(block, least, most):
    """``spread`` grows if the noise of neighbouring rows is correlated. In this test, the noise is
    constant in blocks of rows."""
    clean = area_sampled_marker(VIEW, MARKER, PLACE, samples=20).astype(float)
    x, y = VIEW.project(PLACE[:2], MARKER.height).astype(int)
    window = slice(y - 80, y + 80), slice(x - 80, x + 80)
    quad = VIEW.project(transform_points(PLACE, UNIT_CORNERS * MARKER.size), MARKER.height)
    random, image, spreads = np.random.default_rng(9), clean.astype(np.uint8), []
    for size in (1, block):
        found = []
        for _ in range(DRAWS):
            noise = random.normal(0.0, 4.0, (160 // size, 160 // size))
            noisy = clean[window] + np.kron(noise, np.ones((size, size)))
            image[window] = np.clip(np.rint(noisy), 0, 255)
            found.append(float(refine(image, quad[None], 8).spread[0]))
        spreads.append(np.median(found))
    assert least < spreads[1] / spreads[0] < most
