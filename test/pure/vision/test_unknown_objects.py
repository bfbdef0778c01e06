"""Objects without a file are found, with outlines that enclose them; nothing else is found."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from benchmarks.vision_scenes import Cell, random_place, random_scene
from tapping_cell.configuration.cell import load_cell
from tapping_cell.logic.arm_in_view import bars_in_table
from tapping_cell.se2 import Pose, transform_points
from tapping_cell.simulation.arm_picture import arm_solids
from tapping_cell.simulation.rendered_camera import (
    Occluder,
    SceneObject,
    SceneRenderer,
    SceneSettings,
)
from tapping_cell.vision import CameraPose, Dot, ObjectOutline, View
from tapping_cell.vision.unknown_objects import ArmBars, Standing, UnknownObjects

CELL = Cell.load()
LENGTH, WIDTH = 0.60, 0.44
TURN = np.linspace(0.0, 2.0 * math.pi, 90, endpoint=False)
CIRCLE = np.stack([np.cos(TURN), np.sin(TURN)], axis=-1)
RADIUS = 0.048
FAR_AWAY = np.array([5.0, 5.0, 0.0])
SHAPES = {
    "disk": CIRCLE,
    "square": np.array([[-0.7, -0.7], [0.7, -0.7], [0.7, 0.7], [-0.7, 0.7]]),
    "bar": np.array([[-1.0, -0.3], [1.0, -0.3], [1.0, 0.3], [-1.0, 0.3]]),
}


def scene_with(
    sizes: list[tuple[str, float, float, bool]], seed: int = 0
) -> tuple[SceneRenderer, list[np.ndarray]]:
    """Return a scene with the cell's disk and unknown objects, and the outlines of these objects.
    ``sizes`` contains shape, size and height in m, and whether the object is brighter than the
    table."""
    outlines = [size * SHAPES[shape] for shape, size, _, _ in sizes]
    others = [
        # The renderer takes the height, the brightness and the dot from the second argument.
        SceneObject(
            outline, ObjectOutline(height, bright, radius=size, dot=Dot(0.002, (0.004, 0.0), True))
        )
        for outline, (_, size, height, bright) in zip(outlines, sizes, strict=True)
    ]
    return (
        SceneRenderer(
            CELL.camera,
            CameraPose.above((0.02, -0.015, 0.7)),
            CELL.table,
            RADIUS * CIRCLE,
            CELL.marker,
            SceneSettings(noise=3.0, light_falloff=0.4),
            seed,
            others,
        ),
        outlines,
    )


def disk_at(pose: np.ndarray) -> Standing:
    return Standing(transform_points(pose, RADIUS * CIRCLE), CELL.marker.height)


def inside(outline: np.ndarray, points: np.ndarray, slack: float = 0.0) -> bool:
    contour = outline.astype(np.float32)[:, None]
    return all(
        cv2.pointPolygonTest(contour, (float(x), float(y)), True) >= -slack for x, y in points
    )


def search(
    finder: UnknownObjects, scene: SceneRenderer, poses: list[np.ndarray], times: int = 1, **options
) -> list[np.ndarray]:
    standing = [disk_at(poses[0])] if poses[0][0] < 1.0 else []
    for _ in range(times):
        finder.search(scene.render(poses), scene.view, standing, **options)
    return finder.outlines


@pytest.mark.parametrize("seed", range(3))
def test_each_unknown_object_has_an_outline_that_encloses_its_footprint(seed: int) -> None:
    random = np.random.default_rng(seed)
    names = list(SHAPES)
    sizes = [
        (
            names[int(random.integers(3))],
            float(random.uniform(0.016, 0.035)),
            float(random.uniform(0.004, 0.04)),
            bool(random.integers(2)),
        )
        for _ in range(4)
    ]
    scene, outlines = scene_with(sizes, seed)
    middles = np.array([[-0.2, -0.1], [0.2, -0.1], [-0.2, 0.1], [0.2, 0.1]])
    places = [np.array([x, y, random.uniform(-3.0, 3.0)]) for x, y in middles]
    poses = [np.array([0.0, 0.0, 0.5]), *places]
    found = search(UnknownObjects(LENGTH, WIDTH, CELL.table), scene, poses)
    assert len(found) == 4
    for place, outline, (_, size, height, _) in zip(places, outlines, sizes, strict=True):
        footprint = transform_points(place, outline)
        nearest = min(found, key=lambda one: math.hypot(*(one.mean(axis=0) - place[:2])))
        assert inside(nearest, footprint, slack=0.0005)
        # A tall object appears larger, outwards from the image centre, by its height times the
        # slope of the line of sight.
        away = math.hypot(*place[:2]) / 0.7 * height
        wide = np.ptp(nearest, axis=0).max()
        assert wide <= 2.0 * size + away + 0.018


@pytest.mark.parametrize("seed", range(3))
def test_the_table_its_markers_and_the_measured_object_are_not_unknown_objects(seed: int) -> None:
    random = np.random.default_rng(seed)
    scene = random_scene(random, CELL, seed)
    finder = UnknownObjects(LENGTH, WIDTH, CELL.table)
    for _ in range(4):
        assert search(finder, scene, [random_place(random)]) == []


def test_the_measured_object_is_an_unknown_object_only_while_it_is_not_measured() -> None:
    scene, _ = scene_with([])
    finder, place = UnknownObjects(LENGTH, WIDTH, CELL.table), np.array([0.1, 0.05, 0.0])
    finder.search(scene.render(place), scene.view, [])
    (outline,) = finder.outlines
    assert inside(outline, transform_points(place, RADIUS * CIRCLE), slack=0.0005)
    finder.search(scene.render(place), scene.view, [disk_at(place)])
    assert finder.outlines == []


def test_an_outline_stays_the_same_while_the_object_rests_and_follows_it_when_it_is_moved() -> None:
    scene, _ = scene_with([("square", 0.03, 0.02, False)])
    finder, away = UnknownObjects(LENGTH, WIDTH, CELL.table), FAR_AWAY
    first = search(finder, scene, [away, np.array([0.1, 0.0, 0.3])])
    for _ in range(10):
        again = search(finder, scene, [away, np.array([0.1, 0.0, 0.3])])
        assert len(again) == 1 and again[0] is first[0]
    moved = search(finder, scene, [away, np.array([0.108, 0.0, 0.3])])
    assert len(moved) == 1
    assert inside(moved[0], transform_points([0.108, 0.0, 0.3], 0.03 * SHAPES["square"]), 0.0005)
    gone = search(finder, scene, [away, away], times=2)
    assert gone == []


def test_a_hand_or_an_arm_that_reaches_in_is_not_an_object_and_hides_those_below_it() -> None:
    scene, _ = scene_with([("disk", 0.025, 0.02, False)])
    finder, there = UnknownObjects(LENGTH, WIDTH, CELL.table), np.array([0.1, 0.0, 0.0])
    before = search(finder, scene, [FAR_AWAY, there])
    assert len(before) == 1
    hand = Occluder(
        np.array([[0.05, -0.4, 0.1], [0.15, -0.4, 0.1], [0.15, 0.05, 0.1], [0.05, 0.05, 0.1]])
    )
    for _ in range(5):
        finder.search(scene.render([FAR_AWAY, there], occluders=[hand]), scene.view, [])
    assert len(finder.outlines) == 1
    assert finder.outlines[0] is before[0]


def test_the_arm_over_the_table_is_not_an_object() -> None:
    cell, random = load_cell(), np.random.default_rng(3)
    arm, geometry = cell.arm, cell.arm.geometry()
    false = 0
    for number in range(4):
        scene, place = random_scene(np.random.default_rng(number), CELL, number), FAR_AWAY
        for _ in range(5):
            joints = None
            while joints is None:
                target = Pose(*random_place(random))
                tip = cell.arm_base.inverse() @ target
                joints = geometry.inverse((tip.x, tip.y, arm.strike_height, tip.theta)).joints
            bars = bars_in_table(cell, geometry, [joints])
            solids = arm_solids(arm, cell.file.tapper, cell.arm_base, joints)
            finder = UnknownObjects(LENGTH, WIDTH, CELL.table)
            image = scene.render(place, occluders=solids)
            finder.search(image, scene.view, [], ArmBars(bars.start[0], bars.end[0], bars.radius))
            false += len(finder.outlines)
    assert false <= 1


def test_printed_lines_are_not_objects_but_a_wide_print_is() -> None:
    scene, _ = scene_with([])
    image = scene.render(FAR_AWAY)
    view: View = scene.view
    lines = [
        [[-0.2, -0.1], [0.2, -0.1]],
        [[0.0, -0.15], [0.0, 0.15]],
        [[-0.25, 0.12], [-0.05, 0.17]],
    ]
    pixel = 0.7 / CELL.camera.fx
    for line in lines:
        ends = np.rint(view.project(np.array(line))).astype(int)
        cv2.line(image, ends[0].tolist(), ends[1].tolist(), (10,), round(0.003 / pixel))
    finder = UnknownObjects(LENGTH, WIDTH, CELL.table)
    finder.search(image, view, [])
    assert finder.outlines == []
    square = np.rint(view.project(np.array([[0.1, 0.05], [0.13, 0.05], [0.13, 0.08], [0.1, 0.08]])))
    cv2.fillConvexPoly(image, square.astype(np.int32), (10,))
    finder.search(image, view, [])
    assert len(finder.outlines) == 1


def table_places(view: View, image: np.ndarray) -> np.ndarray:
    """Return the points (H, W, 2) of the table's plane, in m, that the pixels of an image show."""
    rows, columns = image.shape
    few = np.meshgrid(np.linspace(0, columns - 1, 80), np.linspace(0, rows - 1, 60))
    corners = view.on_plane(np.stack(few, axis=-1)).astype(np.float32)
    v, u = np.mgrid[:rows, :columns].astype(np.float32)
    return np.asarray(
        cv2.remap(corners, u * 79 / (columns - 1), v * 59 / (rows - 1), cv2.INTER_LINEAR)
    )


def grain(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return the reflectance of wood, relative to its mean, for planks of 90 mm with lengthwise
    grain."""
    streaks = cv2.GaussianBlur(random.standard_normal((900, 900)).astype(np.float32), (0, 0), 40, 3)
    x, y = np.moveaxis(places.astype(np.float32) / 0.001 + 450.0, -1, 0)
    planks = 1.0 + 0.1 * random.standard_normal(20)
    return np.asarray(
        planks[np.clip((y / 90.0).astype(int), 0, 19)]
        * (1.0 + 0.05 / streaks.std() * cv2.remap(streaks, x, y, cv2.INTER_LINEAR))
    )


def tiles(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return the reflectance of a chequered table with squares of 40 mm, relative to its brighter
    squares."""
    squares = np.floor(places / 0.04).sum(axis=-1)
    return np.where(squares % 2 > 0, 0.8, 1.0)


def breadboard(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return the reflectance of an optical breadboard with holes of 6 mm every 25 mm, relative to
    its top."""
    return np.where(np.linalg.norm((places + 0.0125) % 0.025 - 0.0125, axis=-1) < 0.003, 0.3, 1.0)


@pytest.mark.parametrize(("texture", "hides"), [(grain, False), (tiles, True), (breadboard, False)])
def test_the_texture_of_a_table_is_not_an_object_but_an_object_on_it_is(texture, hides) -> None:
    """An object is not found on the tiles: their brightness varies so much that the threshold of
    the search, which increases with this variation, exceeds the contrast of the object."""
    random = np.random.default_rng(1)
    scene, (footprint,) = scene_with([("disk", 0.03, 0.02, True)])
    finder, place = UnknownObjects(LENGTH, WIDTH, CELL.table), np.array([0.1, 0.0, 0.0])
    corners = CELL.table.corners()
    middles = corners.mean(axis=1, keepdims=True)
    for pose, expected in ((FAR_AWAY, 0), (place, 1)):
        image = scene.render([FAR_AWAY, pose])
        plain = np.zeros_like(image)
        silhouette = transform_points(pose, footprint)
        top = scene.view.on_plane(scene.view.project(silhouette, 0.02))
        bare = [*(middles + 1.45 * (corners - middles))]
        if expected:
            bare += [silhouette, top]
        for area in bare:
            cv2.fillConvexPoly(plain, np.rint(scene.view.project(area)).astype(np.int32), (1,))
        factor = np.where(plain, 1.0, texture(table_places(scene.view, image), random))
        finder.search(np.clip(image * factor, 0, 255).astype(np.uint8), scene.view, [])
        assert len(finder.outlines) == (0 if hides else expected)


def test_the_shadow_beside_a_measured_object_is_not_an_object() -> None:
    settings = SceneSettings(noise=2.0, shadow=(0.007, 0.006), shadow_depth=0.5)
    scene = SceneRenderer(
        CELL.camera,
        CameraPose.above((0.02, -0.015, 0.7)),
        CELL.table,
        RADIUS * CIRCLE,
        CELL.marker,
        settings,
    )
    for place in ([0.1, 0.05, 0.0], [-0.15, -0.1, 1.0]):
        finder = UnknownObjects(LENGTH, WIDTH, CELL.table)
        assert search(finder, scene, [np.array(place)]) == []
