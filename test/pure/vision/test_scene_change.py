"""A scene at rest is measured rarely, and each change of it immediately."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import CAMERA, DISK, MARKER, POSE, REFERENCES, renderer

from tapping_cell.se2 import transform_points
from tapping_cell.simulation.rendered_camera import Occluder, SceneObject, SceneRenderer
from tapping_cell.vision import Observation, PoseTracker, TrackerSettings, marker_ids
from tapping_cell.vision.scene_change import SceneChange

HOME = np.array([0.1, 0.05, 0.4])
FRAME = 1.0 / 30.0


@pytest.fixture(scope="module")
def scene() -> SceneRenderer:
    return renderer()


class CountingTracker(PoseTracker):
    """Counts the frames that are measured."""

    measured = 0

    def _judge(
        self, image: np.ndarray, stamp: float, others: Collection[int]
    ) -> tuple[Observation, dict[int, Observation]]:
        self.measured += 1
        return super()._judge(image, stamp, others)


@pytest.fixture(scope="module")
def after_two_seconds(scene: SceneRenderer) -> CountingTracker:
    tracker = CountingTracker(CAMERA, REFERENCES, MARKER)
    for number in range(60):
        tracker.update(scene.render(HOME), number * FRAME)
    return tracker


@pytest.fixture
def settled(after_two_seconds: CountingTracker) -> CountingTracker:
    return copy.deepcopy(after_two_seconds)


def test_a_still_scene_is_measured_five_times_a_second(
    scene: SceneRenderer, settled: CountingTracker
) -> None:
    before = settled.measured
    for number in range(60, 120):
        seen = settled.update(scene.render(HOME), number * FRAME)
        assert seen.stamp == number * FRAME
        assert seen.visible and seen.at_rest and seen.frames_fused >= 30
    assert 8 <= settled.measured - before <= 14


@pytest.mark.parametrize(
    "step",
    [(1e-4, 0.0, 0.0), (0.0, -2e-4, 0.0), (0.0, 0.0, math.radians(0.3)), (0.02, 0.01, 1.0)],
    ids=["0.1 mm", "0.2 mm", "0.3 deg", "far"],
)
def test_the_first_frame_after_a_motion_is_measured(
    scene: SceneRenderer, settled: CountingTracker, step: tuple[float, float, float]
) -> None:
    settled.update(scene.render(HOME), 60 * FRAME)
    before = settled.measured
    settled.update(scene.render(HOME + np.array(step)), 61 * FRAME)
    assert settled.measured == before + 1


@pytest.mark.parametrize("where", ["object", "reference"])
def test_an_occlusion_is_detected_at_once(
    scene: SceneRenderer, settled: CountingTracker, where: str
) -> None:
    marker = REFERENCES.markers[0]
    place = HOME if where == "object" else np.array([marker.x, marker.y, 0.0])
    square = 0.01 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    corners = transform_points(place, square)
    cover = [Occluder(np.column_stack([corners, np.full(4, 0.001)]))]
    settled.update(scene.render(HOME), 60 * FRAME)
    before = settled.measured
    seen = settled.update(scene.render(HOME, occluders=cover), 61 * FRAME)
    assert settled.measured == before + 1
    assert seen.visible == (where == "reference")


@given(
    noise=st.floats(0.5, 2.0),
    contrast=st.floats(120.0, 180.0),
    seed=st.integers(0, 2**16),
)
def test_an_edge_shift_of_a_fifth_of_a_pixel_is_a_change_and_noise_is_not(
    noise: float, contrast: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    columns = np.arange(120.0)

    def frame(edge: float) -> np.ndarray:
        ideal = 40.0 + contrast / (1.0 + np.exp(-(columns - edge) / 0.6))
        noisy = ideal[None, :] + random.normal(0.0, noise, (100, 120))
        return np.clip(np.round(noisy), 0, 255).astype(np.uint8)

    change = SceneChange()
    assert not change.unchanged(frame(60.0))
    change.watch(frame(60.0), [np.array([[40.0, 30.0], [80.0, 70.0]])])
    for _ in range(20):
        change.learn(frame(60.0))
    same = [change.unchanged(frame(60.0)) for _ in range(20)]
    assert sum(same) >= 19
    assert not change.unchanged(frame(60.2))
    assert not change.unchanged(frame(59.8))


def test_observing_another_stationary_object_costs_no_more() -> None:
    other = replace(MARKER, id=MARKER.id + 1)
    two = SceneRenderer(
        CAMERA, POSE, REFERENCES, DISK, MARKER, others=[SceneObject(np.asarray(DISK), other)]
    )
    known = TrackerSettings(other_ids=marker_ids([MARKER, other]))
    tracker = CountingTracker(CAMERA, REFERENCES, MARKER, known, [other])
    poses = np.array([HOME, HOME - [0.15, 0.05, 0.4]])

    def measure(number: int) -> dict[int, Observation]:
        stamp = 1.0 + number * FRAME
        return tracker.update_several(two.render(poses), stamp, [0])[1]

    for number in range(60):
        measure(number)
    before = tracker.measured
    for number in range(60, 120):
        seen = measure(number)[0]
        assert seen.visible and seen.at_rest and seen.stamp == 1.0 + number * FRAME
    assert 8 <= tracker.measured - before <= 14
    # If only the other object moves, it is measured immediately.
    poses[1] += [0.001, 0.0, 0.0]
    before = tracker.measured
    assert measure(120)[0].pose == pytest.approx(tuple(poses[1]), abs=5e-4)
    assert tracker.measured == before + 1


def test_late_frames_trigger_no_search(scene: SceneRenderer, settled: CountingTracker) -> None:
    begun = settled._last_thorough
    for number in range(1, 9):
        assert settled.update(scene.render(HOME), 60 * FRAME + 0.5 * number).visible
    assert settled._last_thorough == begun
