"""Objects without a marker are found and measured with a correct covariance, or refused with a
message."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import CAMERA, POSE, REFERENCES, between

from tapping_cell.se2 import inverse, transform_points, wrap_angle
from tapping_cell.simulation.rendered_camera import Occluder, SceneRenderer, SceneSettings
from tapping_cell.vision import (
    CameraPose,
    Dot,
    ObjectOutline,
    Observation,
    OutlineError,
    PoseTracker,
    Problem,
    View,
)
from tapping_cell.vision.outline.fit import fit_again, fit_outline
from tapping_cell.vision.outline.search import find_outlines, stands_out

DISK = ObjectOutline(0.012, False, radius=0.048, dot=Dot(0.006, (0.03, 0.0), True))
FOUR = ObjectOutline(
    0.02, True, vertices=((-0.04, -0.03), (0.05, -0.03), (0.02, 0.05), (-0.03, 0.03))
)
SIDES = ((-0.04, -0.04), (0.04, -0.04), (0.04, 0.04), (-0.04, 0.04))
SQUARE = ObjectOutline(0.012, False, vertices=SIDES, dot=Dot(0.005, (0.02, 0.02), True))
HOME = np.array([0.1, 0.05, 0.4])
FRAME = 1.0 / 30.0


def scene(outline: ObjectOutline, pose: CameraPose = POSE, seed: int = 0, **more) -> SceneRenderer:
    points = outline.points(720)
    return SceneRenderer(CAMERA, pose, REFERENCES, points, outline, SceneSettings(**more), seed)


class Film:
    """Passes frames at 30 Hz to a tracker."""

    def __init__(self, outline: ObjectOutline) -> None:
        self.tracker = PoseTracker(CAMERA, REFERENCES, outline)
        self.time = 10.0

    def show(self, image: np.ndarray) -> Observation:
        self.time += FRAME
        return self.tracker.update(image, self.time)

    def rest(self, shown: SceneRenderer, frames: int, pose: np.ndarray = HOME) -> Observation:
        for _ in range(frames):
            seen = self.show(shown.render(pose))
        return seen


def error(seen: Observation, pose: np.ndarray) -> np.ndarray:
    """Return the errors x, y in m and theta in rad."""
    assert seen.pose is not None, seen.sentence
    d = np.array(seen.pose) - pose
    d[2] = wrap_angle(d[2])
    return d


@given(count=st.integers(3, 9), size=st.floats(0.02, 0.1), turn=st.floats(0.0, 6.0))
def test_a_regular_polygon_has_as_many_symmetries_as_sides(count, size, turn):
    angle = turn + np.arange(count) * 2.0 * math.pi / count
    corners = tuple((size * math.cos(a), size * math.sin(a)) for a in angle)
    dot = Dot(0.002, (0.3 * size, 0.0), True) if size > 0.06 else None
    if dot is None:
        with pytest.raises(OutlineError, match="its angle cannot be determined"):
            ObjectOutline(0.01, True, vertices=corners)
        return
    outline = ObjectOutline(0.01, True, vertices=corners, dot=dot)
    if count <= 6:
        wanted = np.arange(count) * 2.0 * math.pi / count
        assert np.allclose(outline.turns(), wanted, atol=0.01)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"radius": 0.05}, "any turn"),
        ({"vertices": SIDES}, "90 deg"),
        ({"vertices": [(-0.05, -0.03), (0.05, -0.03), (0.05, 0.03), (-0.05, 0.03)]}, "180 deg"),
        ({"radius": 0.05, "dot": Dot(0.005, (0.003, 0.0), True)}, "farther from the centre"),
        ({"radius": 0.05, "dot": Dot(0.005, (0.045, 0.0), True)}, "of the rim"),
        ({"radius": 0.05, "dot": Dot(0.001, (0.03, 0.0), True)}, "to be seen"),
        ({"vertices": [(0.0, 0.0), (0.05, 0.0)]}, "3 corners"),
        ({"vertices": [(0.0, 0.0), (0.0, 0.05), (0.05, 0.0)]}, "counter-clockwise"),
        ({}, "either a disk"),
    ],
)
def test_an_outline_that_determines_no_angle_is_refused(given, words):
    with pytest.raises(OutlineError, match=words):
        ObjectOutline(0.01, False, **given)


def brute_force(
    view: View, outline: ObjectOutline, pose: np.ndarray, samples: int = 6
) -> np.ndarray:
    """Render top, wall and table by rays through each sub-pixel, independently of the renderer."""
    seen = view.project(transform_points(pose, outline.points(90)), outline.height)
    x0, y0 = np.floor(seen.min(axis=0)).astype(int) - 14
    x1, y1 = np.ceil(seen.max(axis=0)).astype(int) + 15
    inside = (np.arange(samples) + 0.5) / samples - 0.5
    xs = (np.arange(x0, x1)[:, None] + inside).ravel()
    ys = (np.arange(y0, y1)[:, None] + inside).ravel()
    # Rays are computed at every sixth pixel and interpolated by splines. This is exact enough,
    # because the rays vary smoothly over the image.
    grid_x, grid_y = np.arange(x0 - 6, x1 + 12, 6.0), np.arange(y0 - 6, y1 + 12, 6.0)
    nodes = view.camera.rays(np.stack(np.meshgrid(grid_x, grid_y), axis=-1))
    rays = np.moveaxis(between(grid_y, grid_x, nodes, ys, xs), 0, -1)
    top, *below = (
        transform_points(inverse(pose), view.rays_on_plane(rays, share * outline.height))
        for share in (1.0, 0.75, 0.5, 0.25, 0.0)
    )
    value = np.full(rays.shape[:2], 115.0)
    for place in below:
        value[outline.distance(place)[0] < 0] = 40.0
    on_top = outline.distance(top)[0] < 0
    value[on_top] = 70.0
    assert outline.dot is not None
    arm = top - np.array(outline.dot.offset)
    value[on_top & (np.hypot(arm[..., 0], arm[..., 1]) < outline.dot.radius)] = 200.0
    mean = value.reshape(y1 - y0, samples, x1 - x0, samples).mean(axis=(1, 3))
    image = np.full((view.camera.height, view.camera.width), 115, np.uint8)
    image[y0:y1, x0:x1] = np.rint(mean)
    return image


@pytest.mark.parametrize(
    ("outline", "pose"),
    [(DISK, np.array([0.1, 0.05, 0.4])), (SQUARE, np.array([-0.2, -0.12, 2.1]))],
)
def test_sharp_images_made_by_brute_force_are_measured_without_bias(outline, pose):
    view = View(CAMERA, POSE)
    image = brute_force(view, outline, pose)
    fit = fit_outline(image, view, outline, pose + np.array([4e-4, -3e-4, 0.008]))
    assert fit is not None
    d = fit.pose - pose
    # A pixel is 0.6 mm.
    assert np.all(np.abs(d) < [2e-5, 2e-5, 6e-4])
    # The fitted size is relative to that of the outline. Even without noise, it is not exactly 1.
    assert abs(fit.size - 1.0) < 5e-4 and fit.seen > 0.7


@pytest.mark.parametrize("outline", [DISK, FOUR, SQUARE])
def test_a_stationary_object_is_measured_as_by_a_full_fit(outline):
    shown = scene(outline, noise=3.0, light_falloff=0.4)
    known = fit_outline(shown.render(HOME), shown.view, outline, HOME)
    for _ in range(3):
        image = shown.render(HOME)
        whole = fit_outline(image, shown.view, outline, HOME)
        again = fit_again(image, known.linearisation, HOME)
        deviation = np.sqrt(np.diag(whole.covariance))
        # The fit with the stored linearisation uses slightly different pixels and sectors than the
        # full fit.
        assert np.all(np.abs(again.pose - whole.pose) < 0.7 * deviation)
        assert np.sqrt(np.diag(again.covariance)) == pytest.approx(deviation, rel=0.3)
    moved = HOME + np.array([3e-4, 0.0, 0.0])
    assert fit_again(shown.render(moved), known.linearisation, HOME) is None
    assert fit_again(image, known.linearisation, moved) is None
    assert fit_again((image * 0.8).astype(np.uint8), known.linearisation, HOME) is None


def test_a_tall_triangle_is_not_fitted_with_a_nonexistent_wall():
    """A model with walls as bright as the top would shift and shrink the triangle by a pixel."""
    random = np.random.default_rng(21)
    corners = 0.042 * np.array([[1.0, 0.0], [-0.5, 0.8], [-0.55, -0.8]])
    outline = ObjectOutline(0.022, True, vertices=tuple(map(tuple, corners)))
    for seed in range(4):
        place = random.uniform([-0.2, -0.13, -3.1], [0.2, 0.13, 3.1])
        shown = scene(outline, seed=seed, noise=3.0, light_falloff=0.5, light_direction=seed)
        found, _ = find_outlines(shown.render(place), shown.view, outline, REFERENCES.corners())
        assert len(found) == 1
        assert np.hypot(*(found[0].pose - place)[:2]) < 1e-4


@pytest.mark.parametrize("outline", [DISK, FOUR, SQUARE])
def test_the_normalised_error_matches_the_covariance(outline):
    random = np.random.default_rng(4)
    normalised, errors = [], []
    for number in range(2):
        above = CameraPose.above((*random.uniform(-0.05, 0.05, 2), 0.7), spin=0.03)
        shown = scene(
            outline,
            above,
            number,
            noise=random.uniform(2.0, 4.0),
            light_falloff=random.uniform(0.0, 0.6),
            light_direction=random.uniform(0.0, 6.0),
            blur=random.uniform(0.55, 0.9),
        )
        film = Film(outline)
        for _ in range(2):
            place = random.uniform([-0.22, -0.15, -3.1], [0.22, 0.15, 3.1])
            # If the first search misses an object, a second search follows 0.1 s later.
            seen = film.rest(shown, 12, place)
            d = error(seen, place)
            errors.append(d)
            normalised.append(d @ np.linalg.solve(seen.covariance, d))
    assert np.quantile(np.abs(errors), 0.9, axis=0) == pytest.approx([0, 0, 0], abs=6e-4)
    assert np.all(np.abs(errors)[:, :2] < 4e-5)
    # The mean is that of 4 observations with 3 degrees of freedom each. Some of the observations
    # share systematic errors of the table and the edge.
    assert 0.2 < np.mean(normalised) < 6.0
    assert np.max(normalised) < 20.0


@pytest.mark.parametrize("outline", [DISK, FOUR, SQUARE])
def test_no_rim_is_fitted_where_none_is_possible(outline):
    """The comparison of the grey levels accepts a pose a few pixels from the true one, but refuses
    a pose on the empty table."""
    shown = scene(outline, noise=4.0, light_falloff=0.67)
    random = np.random.default_rng(7)
    pixel = 0.7 / CAMERA.fx
    for _ in range(10):
        place = random.uniform((-0.2, -0.12, -3.0), (0.2, 0.12, 3.0))
        image = shown.render(place)
        beside = place + np.array([*random.normal(0.0, 1.5 * pixel, 2), 0.0])
        assert stands_out(image, shown.view, outline, beside)
        away = place + np.array([-0.13 if place[0] > 0 else 0.13, 0.0, 0.0])
        assert not stands_out(image, shown.view, outline, away)


def test_a_slide_is_tracked_and_its_end_detected():
    shown = scene(DISK, noise=3.0)
    film = Film(DISK)
    assert film.rest(shown, 14).at_rest
    velocity = np.array([0.2, -0.1, 1.0])
    for k in range(6):
        pose = HOME + velocity * k * FRAME
        seen = film.show(shown.render(pose - 0.003 * velocity, [pose + 0.003 * velocity]))
        assert seen.visible
        assert np.all(np.abs(error(seen, pose)) < [1e-4, 1e-4, 2e-3])
        if k > 2:
            assert not seen.at_rest
            assert seen.velocity == pytest.approx(velocity, abs=0.04)
    assert film.rest(shown, 14, pose).at_rest


def test_a_shadow_causes_no_bias():
    shown = scene(DISK, noise=2.0, shadow=(0.005, -0.003), shadow_depth=0.2)
    seen = Film(DISK).rest(shown, 4)
    assert np.all(np.abs(error(seen, HOME)) < [8e-5, 8e-5, 2e-3])


def cover(pose: np.ndarray, low: float, high: float) -> Occluder:
    """Return an occluder that covers the object from x = low to high in its own frame."""
    square = np.array([[low, -0.07], [high, -0.07], [high, 0.07], [low, 0.07]])
    corners = transform_points(pose, square)
    return Occluder(np.column_stack([corners, np.full(4, 0.02)]), level=20.0)


def test_a_partly_occluded_object_is_measured_and_a_mostly_occluded_one_is_not():
    shown = scene(DISK)
    film = Film(DISK)
    film.rest(shown, 8)
    seen = film.show(shown.render(HOME, occluders=[cover(HOME, -0.08, -0.03)]))
    assert seen.visible
    assert np.all(np.abs(error(seen, HOME)) < [5e-5, 5e-5, 1e-3])
    for _ in range(4):
        seen = film.show(shown.render(HOME, occluders=[cover(HOME, -0.08, 0.02)]))
        assert not seen.visible and seen.pose is None and len(seen.sentence) > 30
    # The angle is unknown if the dot is hidden.
    seen = film.show(shown.render(HOME, occluders=[cover(HOME, 0.02, 0.04)]))
    assert not seen.visible


def test_wrong_and_missing_objects_are_named():
    larger = ObjectOutline(0.012, False, radius=0.051, dot=DISK.dot)
    seen = Film(DISK).rest(scene(larger), 2)
    assert seen.problem is Problem.MISSHAPEN_OBJECT and "%" in seen.sentence
    seen = Film(DISK).rest(scene(SQUARE), 2)
    assert seen.problem in (Problem.WRONG_OBJECT, Problem.MISSHAPEN_OBJECT) and not seen.visible
    seen = Film(DISK).show(scene(DISK).render([5.0, 5.0, 0.0]))
    assert seen.problem is Problem.OBJECT_HIDDEN and "darker" in seen.sentence
    plain = ObjectOutline(0.012, False, radius=0.048, dot=Dot(0.006, (0.03, 0.0), False))
    seen = Film(DISK).rest(scene(plain), 2)
    assert seen.problem is Problem.DOT_HIDDEN and "dot" in seen.sentence


def test_two_identical_objects_are_ambiguous():
    shown = scene(DISK)
    image = shown.render(HOME)
    there = np.array([-0.15, -0.05, 1.0])
    other = scene(DISK, seed=1).render(there)
    middle = int(shown.view.project([[-0.02, 0.0]])[0][0])
    image[:, :middle] = other[:, :middle]
    seen = Film(DISK).show(image)
    assert seen.problem is Problem.DUPLICATE_OBJECT and not seen.visible
    assert "-150" in seen.sentence and "100" in seen.sentence


@pytest.mark.parametrize("outline", [DISK, FOUR, SQUARE])
def test_an_object_under_the_edge_of_a_hard_shadow_is_found(outline):
    """A shadow reduces the brightness of a part of the object to one half, and the noise there in
    proportion."""
    y, x = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    for number in range(2):
        place = HOME * [1, 1, 0] + [0.0, 0.0, 1.5 * number]
        shown = scene(outline, seed=number, noise=2.5, light_falloff=0.3)
        at = shown.view.project(place[:2], outline.height) + np.array([8.0 * number - 4.0, 0.0])
        across = (x - at[0]) * np.cos(number) + (y - at[1]) * np.sin(number)
        light = 1.0 - 0.5 / (1.0 + np.exp(np.clip(across, -30.0, 30.0)))
        image = np.rint(shown.render(place) * light).astype(np.uint8)
        found, _ = find_outlines(image, shown.view, outline, REFERENCES.corners())
        assert len(found) == 1
        assert np.hypot(*(found[0].pose - place)[:2]) < 2e-4
