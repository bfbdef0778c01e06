"""Unknown objects traced in rendered images, compared with the shapes that were drawn."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenes import CAMERA, REFERENCES

from tapping_cell.se2 import transform_points
from tapping_cell.simulation.rendered_camera import SceneObject, SceneRenderer, SceneSettings
from tapping_cell.vision import CameraPose, ObjectMarker, ObjectOutline
from tapping_cell.vision.outline.tracing import NotTraced, TracedObject, trace_object

POSE = CameraPose.above((0.01, -0.02, 0.7), spin=0.02)
ROUND = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
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


def test_two_objects_on_the_table_are_refused() -> None:
    marker = ObjectMarker("apriltag_36h11", 7, 0.025, 0.012)
    second = SceneObject(disk(0.03), ObjectMarker("apriltag_36h11", 8, 0.025, 0.012))
    with pytest.raises(NotTraced, match="leave one object"):
        traced(disk(0.04), marker, (0.0, 0.0, 0.0), others=(second,))


def test_an_empty_table_and_an_image_without_a_table_are_refused() -> None:
    marker = ObjectMarker("apriltag_36h11", 7, 0.025, 0.012)
    scene = SceneRenderer(CAMERA, POSE, REFERENCES, disk(0.04), marker)
    with pytest.raises(NotTraced, match="no area at least 12 mm wide differs"):
        trace_object(scene.render((2.0, 2.0, 0.0)), CAMERA, REFERENCES, 0.012)
    with pytest.raises(NotTraced, match="table is not seen"):
        trace_object(
            np.full((CAMERA.height, CAMERA.width), 100, dtype=np.uint8), CAMERA, REFERENCES, 0.012
        )
