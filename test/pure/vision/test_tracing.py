"""Unknown objects traced in rendered images, compared with the shapes that were drawn."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import CAMERA, REFERENCES

from tapping_cell.se2 import transform_points
from tapping_cell.simulation.rendered_camera import SceneObject, SceneRenderer, SceneSettings
from tapping_cell.vision import CameraPose, ObjectMarker, ObjectOutline
from tapping_cell.vision.outline.tracing import NotTraced, TracedObject, trace_object

POSE = CameraPose.above((0.01, -0.02, 0.7), spin=0.02)
ROUND = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
WEDGE = np.array([[-0.04, -0.02], [0.05, -0.02], [0.01, 0.04], [-0.04, 0.02]])


def disk(radius: float) -> np.ndarray:
    return radius * np.stack([np.cos(ROUND), np.sin(ROUND)], axis=-1)


def traced(
    outline: np.ndarray,
    appearance: ObjectMarker | ObjectOutline,
    pose: tuple[float, float, float],
    others: tuple[SceneObject, ...] = (),
    **settings: object,
) -> TracedObject:
    scene = SceneRenderer(
        CAMERA,
        POSE,
        REFERENCES,
        outline,
        appearance,
        SceneSettings(**settings),  # type: ignore[arg-type]
        others=others,
    )
    poses = np.array([pose, *((0.2, 0.0, 0.0) for _ in others)])
    return trace_object(scene.render(poses), CAMERA, REFERENCES, appearance.height)


def corners_on_table(found: TracedObject) -> np.ndarray:
    assert found.vertices is not None
    return transform_points(np.array(found.pose), np.array(found.vertices))


def farthest(found: np.ndarray, true: np.ndarray) -> float:
    """Return the largest distance of a true corner from the nearest traced corner."""
    apart = np.linalg.norm(found[:, None] - true[None], axis=2)
    return float(apart.min(axis=0).max()) if len(found) == len(true) else math.inf


def off_the_rim(points: np.ndarray, polygon: np.ndarray) -> float:
    """Return the largest distance of the points from the rim of the polygon."""
    line = np.asarray(polygon, np.float32)
    return max(abs(cv2.pointPolygonTest(line, point.tolist(), True)) for point in points)


def test_a_disk_with_an_off_centre_marker() -> None:
    marker = ObjectMarker("apriltag_36h11", 7, 0.025, 0.012, (0.006, -0.003, 0.0))
    found = traced(disk(0.04), marker, (0.02, -0.01, 1.1))
    assert found.radius == pytest.approx(0.04, abs=1e-4)
    assert found.pose[:2] == pytest.approx((0.02, -0.01), abs=1.5e-4)
    assert found.pose[2] == pytest.approx(1.1, abs=2e-3)
    assert found.marker is not None and found.marker.id == 7
    assert found.marker.size == pytest.approx(0.025, abs=5e-5)
    assert found.marker.offset == pytest.approx((0.006, -0.003, 0.0), abs=2e-4)


@pytest.mark.parametrize("brighter", [False, True])
def test_a_polygon_without_a_marker(brighter: bool) -> None:
    appearance = ObjectOutline(0.012, brighter, vertices=tuple(map(tuple, WEDGE.tolist())))
    pose = (-0.02, 0.01, 2.2)
    found = traced(WEDGE, appearance, pose)
    assert found.marker is None and found.brighter == brighter
    true = transform_points(np.array(pose), WEDGE)
    # A dark wall next to a dark top cannot be distinguished from it. Therefore, away from the image
    # centre, the traced outline includes the foot of the wall.
    assert farthest(corners_on_table(found), true) < (4e-4 if brighter else 1.5e-3)
    # The frame's origin is the centroid, and its x axis is parallel to the longest side.
    vertices = np.array(found.vertices)
    sides = np.roll(vertices, -1, axis=0) - vertices
    longest = sides[np.hypot(*sides.T).argmax()]
    assert math.atan2(longest[1], longest[0]) == pytest.approx(0.0, abs=1e-3)
    following = np.roll(vertices, -1, axis=0)
    cross = vertices[:, 0] * following[:, 1] - vertices[:, 1] * following[:, 0]
    assert ((vertices + following) * cross[:, None]).sum(axis=0) == pytest.approx(
        (0.0, 0.0), abs=1e-9
    )


def test_a_shadow_beside_a_bright_object_is_not_part_of_it() -> None:
    appearance = ObjectOutline(0.012, True, vertices=tuple(map(tuple, WEDGE.tolist())))
    pose = (0.0, 0.02, 0.4)
    found = traced(WEDGE, appearance, pose, shadow=(0.006, 0.004), shadow_depth=0.4)
    true = transform_points(np.array(pose), WEDGE)
    assert farthest(corners_on_table(found), true) < 4e-4


def test_one_of_several_objects_is_chosen_by_a_point_on_it() -> None:
    first = ObjectMarker("apriltag_36h11", 7, 0.025, 0.012)
    bright = ObjectOutline(0.012, True, vertices=tuple(map(tuple, WEDGE.tolist())))
    scene = SceneRenderer(
        CAMERA, POSE, REFERENCES, disk(0.04), first, others=(SceneObject(WEDGE, bright),)
    )
    image = scene.render(np.array([(-0.08, 0.0, 0.0), (0.08, 0.03, 0.5)]))
    found = trace_object(image, CAMERA, REFERENCES, 0.012, at=(0.08, 0.03))
    assert found.brighter and found.marker is None
    true = transform_points(np.array([0.08, 0.03, 0.5]), WEDGE)
    assert farthest(corners_on_table(found), true) < 4e-4
    # The only object with a marker needs no point.
    assert trace_object(image, CAMERA, REFERENCES, 0.012).radius == pytest.approx(0.04, abs=4e-4)
    with pytest.raises(NotTraced, match=r"no object lies at x 0, y 90 mm .* x 8\d, y 3\d mm"):
        trace_object(image, CAMERA, REFERENCES, 0.012, at=(0.0, 0.09))


def test_several_objects_are_refused_with_their_places() -> None:
    marker = ObjectMarker("apriltag_36h11", 7, 0.025, 0.012)
    second = SceneObject(disk(0.03), ObjectMarker("apriltag_36h11", 8, 0.025, 0.012))
    with pytest.raises(NotTraced, match=r"2 objects .* x 20\d|19\d, y -?0 mm .* leave one object"):
        traced(disk(0.04), marker, (0.0, 0.0, 0.0), others=(second,))


def test_an_object_that_is_cut_is_refused() -> None:
    appearance = ObjectOutline(0.012, False, vertices=tuple(map(tuple, WEDGE.tolist())))
    reference = REFERENCES.markers[0]
    with pytest.raises(NotTraced, match="reaches a reference marker or the edge"):
        traced(WEDGE, appearance, (reference.x * 0.85, reference.y * 0.85, 0.0))


@settings(max_examples=settings.default.max_examples // 3)
@given(
    st.floats(0.0, 0.4),
    st.floats(0.0, 6.0),
    st.floats(-math.pi, math.pi),
    st.booleans(),
    st.integers(0, 1000),
)
def test_uneven_light_and_a_grained_table_do_not_change_the_shape(
    dark: float, grain: float, angle: float, brighter: bool, seed: int
) -> None:
    """``dark``: share of the light that is lost in the corners. ``grain``: standard deviation of
    the table's brightness, which varies across the boards of a wooden table."""
    appearance = ObjectOutline(0.012, brighter, vertices=tuple(map(tuple, WEDGE.tolist())))
    pose = (0.02, 0.01, angle)
    scene = SceneRenderer(CAMERA, POSE, REFERENCES, WEDGE, appearance)
    image = scene.render(pose).astype(float)
    rows, columns = image.shape
    y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
    boards = np.random.default_rng(seed).standard_normal(rows // 3 + 1).repeat(3)[:rows]
    shade = (image + grain * boards[:, None]) * (1.0 - 0.5 * dark * (x**2 + y**2))
    found = trace_object(
        np.clip(shade, 0, 255).astype(np.uint8), CAMERA, REFERENCES, 0.012, at=(0.02, 0.01)
    )
    assert found.brighter == brighter
    # A coarse grain may cut a corner, so the outlines are compared: by less than 2.5 pixels.
    true, corners = transform_points(np.array(pose), WEDGE), corners_on_table(found)
    assert max(off_the_rim(true, corners), off_the_rim(corners, true)) < 1.5e-3
    assert found.deviation < 3e-4


def test_a_marker_on_an_object_as_bright_as_the_table_is_not_the_object() -> None:
    marker = ObjectMarker("apriltag_36h11", 7, 0.025, 0.012)
    with pytest.raises(NotTraced, match="only marker 7 and its border differ"):
        traced(0.0155 * SQUARE, marker, (0.0, 0.0, 0.3))


def test_an_empty_table_and_an_image_without_a_table_are_refused() -> None:
    marker = ObjectMarker("apriltag_36h11", 7, 0.025, 0.012)
    scene = SceneRenderer(CAMERA, POSE, REFERENCES, disk(0.04), marker)
    with pytest.raises(NotTraced, match="no area at least 12 mm wide differs"):
        trace_object(scene.render((2.0, 2.0, 0.0)), CAMERA, REFERENCES, 0.012)
    with pytest.raises(NotTraced, match="table is not seen"):
        trace_object(
            np.full((CAMERA.height, CAMERA.width), 100, dtype=np.uint8), CAMERA, REFERENCES, 0.012
        )
