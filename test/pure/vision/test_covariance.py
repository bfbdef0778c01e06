"""The covariance is compared with the errors for many random calibrations. The corners are
projected; no images are rendered."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scenes import CAMERA, MARKER, REFERENCES, renderer

from tapping_cell.se2 import transform_points
from tapping_cell.vision import CameraModel, CameraPose, PoseTracker, ReferenceMap, View
from tapping_cell.vision.markers.edges import BINS, MarkerEdges
from tapping_cell.vision.table.systematic_error import lens_shifts
from tapping_cell.vision.table.tracker import TableState, TableTracker

ROW = 0.05
"""Standard deviation of the edge position in one row of pixels, in pixels. Each side of a marker
has 60 rows."""
HEIGHT = 0.012
TRIALS = 40


def erroneous_camera(random: np.random.Generator, scale: float) -> CameraModel:
    """Return a calibration with errors typical of OpenCV's calibration, times ``scale``."""
    n = scale * random.standard_normal(8)
    usual = np.array([0.0015, 0.004, 1.2e-4, 1.2e-4, 0.0])
    d = np.array(CAMERA.distortion) + usual * np.append(n[4:], 0.0)
    return dataclasses.replace(
        CAMERA,
        fx=CAMERA.fx + 0.5 * n[0],
        fy=CAMERA.fy + 0.5 * n[1],
        cx=CAMERA.cx + 0.7 * n[2],
        cy=CAMERA.cy + 0.7 * n[3],
        distortion=tuple(d),
    )


def erroneous_map(random: np.random.Generator, misprint: float) -> ReferenceMap:
    """Return a table file whose marker positions are wrong by ``misprint`` m, as if the markers had
    been printed inaccurately."""
    return ReferenceMap(
        REFERENCES.dictionary,
        tuple(
            dataclasses.replace(
                m,
                x=m.x + misprint * random.standard_normal(),
                y=m.y + misprint * random.standard_normal(),
                theta=m.theta + 0.5 * misprint / 0.028 * random.standard_normal(),
            )
            for m in REFERENCES.markers
        ),
    )


def noisy_edges(view: View, random: np.random.Generator) -> MarkerEdges:
    """Return the sides of the reference markers as the true camera sees them, with the noise of the
    rows."""
    corners = REFERENCES.corners()
    share = (np.arange(BINS) + 0.5) / BINS
    start, end = corners[:, :, None], np.roll(corners, -1, axis=1)[:, :, None]
    points = view.project(start + share[:, None] * (end - start))
    pixels = view.project(corners)
    side = np.roll(pixels, -1, axis=1) - pixels
    normal = np.stack([side[..., 1], -side[..., 0]], -1) / np.linalg.norm(side, axis=2)[..., None]
    weights = np.full(points.shape[:3], 60.0 / BINS)
    noise = random.standard_normal(weights.shape) * ROW / np.sqrt(weights)
    count = len(corners)
    level, good = np.zeros(count), np.ones(count, dtype=bool)
    points = points + noise[..., None] * normal[:, :, None]
    return MarkerEdges(points, weights, pixels, np.full(count, ROW), level, level, level, good)


@pytest.mark.parametrize(("lens", "misprint"), [(0.0, 0.0), (0.3, 0.0), (0.0, 3e-5), (1.0, 1e-4)])
def test_the_normalised_error_follows_chi_square(lens, misprint):
    """Compare the normalised errors of an object's pose with the chi-square distribution, for exact
    and for inexact camera and table files."""
    normalised = []
    for trial in range(TRIALS):
        random = np.random.default_rng([trial, 5])
        place = (*random.uniform(-0.05, 0.05, 2), 0.7)
        view = View(CAMERA, CameraPose.above(place, spin=random.uniform(-0.1, 0.1)))
        tracker = TableTracker(erroneous_camera(random, lens), erroneous_map(random, misprint))
        state = tracker.update(noisy_edges(view, random), np.arange(len(REFERENCES.markers)))
        assert state is TableState.STEADY and tracker.pose is not None
        true = random.uniform([-0.25, -0.17, -np.pi], [0.25, 0.17, np.pi])
        # Represent the marker of an object by four points, and compute where these points are
        # measured if the inexact files are used.
        arms = 0.02 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
        points = transform_points(true, arms)
        erroneous = View(tracker.camera, tracker.pose)
        shift = erroneous.on_plane(view.project(points, HEIGHT), HEIGHT) - points
        arm = points - points.mean(axis=0)
        turn = (arm[:, 0] * shift[:, 1] - arm[:, 1] * shift[:, 0]).sum() / (arm**2).sum()
        error = np.array([*shift.mean(axis=0), turn])
        # The object's marker is misplaced as much as the reference markers.
        error[:2] += misprint * random.standard_normal(2)
        likely, covariance = tracker.judge(transform_points(true + error, arms), HEIGHT)
        error -= likely
        normalised.append(error @ np.linalg.solve(covariance, error))
    # The bound is three standard deviations of the mean of chi-square values with 3 degrees of
    # freedom. `python -m benchmarks --section vision-covariance` measures it with more trials.
    assert abs(np.mean(normalised) - 3.0) < 3.0 * np.sqrt(6.0 / TRIALS)
    assert np.mean(np.array(normalised) < 7.815) > 0.85


def test_a_cell_of_a_tenth_of_the_size_is_measured_alike():
    """The same image with files scaled by 0.1 must give the same pose, scaled by 0.1."""
    pose = np.array([0.21, -0.12, 0.4])
    image = renderer().render(pose)
    camera = erroneous_camera(np.random.default_rng(3), 3.0)
    found = []
    for scale in (1.0, 0.1):
        markers = tuple(
            dataclasses.replace(m, x=scale * m.x, y=scale * m.y, size=scale * m.size)
            for m in REFERENCES.markers
        )
        marker = dataclasses.replace(MARKER, size=scale * MARKER.size, height=scale * MARKER.height)
        tracker = PoseTracker(camera, ReferenceMap(REFERENCES.dictionary, markers), marker)
        seen = tracker.update(image, 0.0)
        assert seen.pose is not None
        found.append(np.array([seen.pose.x / scale, seen.pose.y / scale, seen.pose.theta]))
    assert np.abs(found[1] - found[0])[:2].max() < 5e-6
    assert abs(found[1][2] - found[0][2]) < 5e-5


def test_the_effects_of_lens_errors_are_those_of_changed_lenses():
    """Compare the changes of direction with those of cameras whose lenses differ slightly. They are
    finite even for a point beyond the circle at which the lens model folds back."""
    view = View(dataclasses.replace(CAMERA, deviations=(1.0,) * 8), CameraPose.above((0, 0, 0.7)))
    random = np.random.default_rng(6)
    points, step = random.uniform([-0.3, -0.2], [0.3, 0.2], (20, 2)), 1e-6
    rays, shifts = lens_shifts(view, points, HEIGHT)
    changed = dataclasses.replace(CAMERA, cx=CAMERA.cx + step)
    assert shifts[..., 2] * step == pytest.approx(
        CAMERA.rays(View(changed, view.pose).project(points, HEIGHT)) - rays, abs=1e-12
    )
    k1, *others = CAMERA.distortion
    changed = dataclasses.replace(CAMERA, distortion=(k1 + step, *others))
    assert shifts[..., 4] * step == pytest.approx(
        CAMERA.rays(View(changed, view.pose).project(points, HEIGHT)) - rays, abs=1e-10
    )
    folding = CameraModel(640, 512, 500.0, 500.0, 319.5, 255.5, (-0.2, 0.0, 0.0, 0.0, 0.0))
    far = np.array([[1.05, 0.9]])
    assert np.isnan(folding.rays([-320.0, -256.0])).all()
    assert np.isfinite(lens_shifts(View(folding, view.pose), far, 0.0)[1]).all()


def test_a_measured_map_may_be_scaled_and_rotated_as_a_whole():
    """If the map was measured with a given deviation, the covariance of a pose must include the
    effect of a linear deformation of the whole map. The expected covariance is that of the errors
    of many randomly deformed maps."""
    deviation, place = 3e-5, np.array([0.2, -0.1])
    points = place + 0.02 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    judged = []
    for references in (REFERENCES, dataclasses.replace(REFERENCES, deviation=deviation)):
        random = np.random.default_rng(4)
        view = View(CAMERA, CameraPose.above((0.01, 0.02, 0.7)))
        tracker = TableTracker(CAMERA, references)
        tracker.update(noisy_edges(view, random), np.arange(len(REFERENCES.markers)))
        judged.append(tracker.judge(points, HEIGHT)[1])
    middles = REFERENCES.corners().mean(axis=1)
    middle = middles.mean(axis=0)
    random = np.random.default_rng(5)
    deformed = random.standard_normal((20000, 2, 2))
    # Scale the deformation so that the markers move by the deviation in x and in y (root mean
    # square).
    moved = np.einsum("kij,mj->kmi", deformed, middles - middle)
    deformed *= deviation / np.sqrt((moved**2).mean())
    turn = 0.5 * (deformed[:, 1, 0] - deformed[:, 0, 1])
    errors = np.column_stack([deformed @ (place - middle), turn])
    expected = errors.T @ errors / len(errors)
    scale = np.sqrt(np.diag(expected))
    gap = (judged[1] - judged[0] - expected) / np.outer(scale, scale)
    assert np.abs(gap).max() < 0.05
