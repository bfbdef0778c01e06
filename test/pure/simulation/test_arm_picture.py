"""The simulated image shows the arm at its true position, hiding what is below it."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.configuration.cell import load_cell
from tapping_cell.se2 import Pose
from tapping_cell.simulation.arm_picture import arm_solids
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.truth import CameraTruth
from tapping_cell.vision import PoseTracker

CELL = load_cell()
ANGLES = np.linspace(-math.pi, math.pi, 96, endpoint=False)
OUTLINE = CELL.object.body().boundary(ANGLES)
SCENE = make_renderer(CELL, CameraTruth(noise=0.0), OUTLINE, 1)
NOISY = make_renderer(CELL, CameraTruth(), OUTLINE, 1)
TRUE = (-0.04, 0.02, 0.35)
AIM = Pose(-0.04, 0.02, 0.5) @ Pose(-0.07, 0.0, 0.0)


def reaching() -> np.ndarray:
    """Return joints with which the tip is next to the object."""
    tip = CELL.arm_base.inverse() @ AIM
    solution = CELL.file.arm.geometry().inverse((tip.x, tip.y, 0.006, tip.theta))
    assert solution.joints is not None
    return np.asarray(solution.joints)


def solids(joints):
    return arm_solids(CELL.file.arm, CELL.file.tapper, CELL.arm_base, joints)


def changed(parts) -> np.ndarray:
    """Return the pixels (rows, columns) that the given parts of the arm change."""
    with_arm = SCENE.render(TRUE, occluders=parts)
    return np.asarray(with_arm != SCENE.render(TRUE))


def test_the_striker_is_where_the_tip_is() -> None:
    """The tool is drawn behind the tip, and the table in front of the tip is free."""
    striker, tool, *_ = solids(reaching())
    seen = changed([striker, tool])
    for along, covered in ((-0.05, True), (0.012, False)):
        place = AIM @ Pose(along, 0.0, 0.0)
        column, row = np.round(SCENE.view.project(np.array([[place.x, place.y]]), 0.006)[0])
        assert bool(seen[int(row), int(column)]) is covered


def test_the_parked_arm_occludes_nothing_that_the_camera_needs() -> None:
    seen = changed(solids(CELL.file.arm.park))
    places = [(marker.x, marker.y) for marker in CELL.references.markers]
    places += [(0.2 * x, 0.15 * y) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    for column, row in np.round(SCENE.view.project(np.array(places), 0.0)).astype(int):
        assert not seen[row - 20 : row + 20, column - 20 : column + 20].any()


def test_an_occluded_object_is_rejected_and_found_again() -> None:
    tracker = PoseTracker(CELL.camera, CELL.references, CELL.object.seen())
    park, over = np.array(CELL.file.arm.park), reaching()
    accepted = []
    for k in range(60):
        share = min(k / 20.0, 1.0, (60 - k) / 20.0)
        image = NOISY.render(TRUE, occluders=solids(park + share * (over - park)))
        seen = tracker.update(image, k / 30.0)
        accepted.append(seen.covariance is not None)
        if seen.covariance is not None:
            assert math.dist(seen.pose[:2], TRUE[:2]) < 3e-4
    assert accepted[2] and accepted[-1]
    assert not any(accepted[22:38])
