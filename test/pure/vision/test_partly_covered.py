"""A dark or bright object beside the marker must not be mistaken for the marker's edge."""

from __future__ import annotations

import math

import numpy as np
from scenes import MARKER, renderer

from tapping_cell.se2 import transform_points
from tapping_cell.simulation.rendered_camera import Occluder
from tapping_cell.vision.markers.detection import UNIT_CORNERS, marker_pattern
from tapping_cell.vision.markers.edges import refine
from tapping_cell.vision.markers.object_pose import fit_marker
from tapping_cell.vision.markers.search import patterns_agree


def test_a_plate_along_a_side_gives_an_exact_pose_or_a_covariance_that_says_so():
    """Plates at any grey level, whose edge is within 5 mm of one or two sides. The limit of the
    squared error is that of chi-square with 3 degrees of freedom at p = 0.001."""
    scene = renderer()
    random = np.random.default_rng(3)
    pattern = [marker_pattern(MARKER.dictionary, MARKER.id)]
    read = 0
    for number in range(60):
        if number % 20 == 0:
            true = random.uniform([-0.2, -0.15, -3.0], [0.2, 0.15, 3.0])
        x = random.uniform(0.020, 0.027)
        y = random.uniform(0.020, 0.027) if number % 2 else -0.2
        plate = np.array([[x, y], [0.1, y], [0.1, 0.2], [x, 0.2]])
        turn = true[2] + random.normal(0.0, 0.02) + random.integers(4) * math.pi / 2.0
        corners = transform_points(np.array([true[0], true[1], turn]), plate)
        height = random.uniform(0.013, 0.04)
        cover = Occluder(np.column_stack([corners, np.full(4, height)]), random.uniform(20, 160))
        image = scene.render(true, occluders=[cover])
        square = transform_points(true, UNIT_CORNERS * MARKER.size)
        quad = scene.view.project(square, MARKER.height)
        edges = refine(image, quad[None], 8)
        if not patterns_agree(image, edges, pattern)[0]:
            continue
        read += 1
        fit = fit_marker(scene.view, edges, 0, MARKER)
        if fit is None:
            continue
        off = fit.pose - true
        assert off @ np.linalg.solve(fit.covariance, off) < 16.27
    assert read > 30
