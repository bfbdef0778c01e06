"""An image of several objects shows each at its place, at rest and while others move."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import load_object
from tapping_cell.simulation.rendered_camera import SceneObject, SceneRenderer
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.truth import CameraTruth
from tapping_cell.vision import PoseTracker, RoundRobin, TrackerSettings, marker_ids

CELL = load_cell()
SQUARE = load_object(shared_folder() / "objects" / "aluminium_square.yaml")
SEEN = [CELL.object.seen(), SQUARE.seen()]
SETTINGS = TrackerSettings(other_ids=marker_ids(SEEN))
POSES = np.array([[-0.1, 0.02, 0.3], [0.08, -0.05, 1.0]])


def scene(noise: float = 2.0) -> SceneRenderer:
    square = SceneObject(np.asarray(SQUARE.shape.vertices), SQUARE.seen())
    truth = CameraTruth(noise=noise)
    return make_renderer(CELL, truth, np.asarray(CELL.outline()), 1, [square])


@pytest.fixture(scope="module")
def renderer() -> SceneRenderer:
    return scene()


@pytest.fixture
def tracker() -> PoseTracker:
    return PoseTracker(CELL.camera, CELL.references, SEEN[0], SETTINGS, SEEN[1:])


def test_every_object_is_found_where_it_lies(renderer, tracker) -> None:
    for frame in range(12):
        tracker.update_several(renderer.render(POSES), 1.0 + frame / 30, [0])
    first, others = tracker.update_several(renderer.render(POSES), 2.0, [0])
    for observation, true in zip((first, others[0]), POSES, strict=True):
        assert observation.visible and observation.at_rest and observation.pose is not None
        assert np.hypot(*(np.array(observation.pose)[:2] - true[:2])) < 5e-4


def test_a_moved_object_leaves_no_trace_and_the_others_stay() -> None:
    renderer, fresh = scene(0.0), scene(0.0)
    first = renderer.render(POSES)
    moved = POSES.copy()
    moved[1] += [0.05, 0.04, 0.3]
    renderer.render(POSES, [moved])
    renderer.render((POSES + moved) / 2, [moved])
    assert np.array_equal(renderer.render(moved), fresh.render(moved))
    assert np.array_equal(renderer.render(POSES), first)
    assert not np.array_equal(first, fresh.render(moved))


def test_two_objects_moving_side_by_side_are_both_rendered() -> None:
    renderer = scene(0.0)
    close = np.array([[0.0, 0.0, 0.0], [0.105, 0.0, 0.0]])
    step = np.array([0.002, 0.0, 0.0])
    both = renderer.render(close, [close + step]).astype(float)
    alone = [renderer.render(pose, [pose + step]).astype(float) for pose in close[:1]]
    rows, columns = np.nonzero(np.abs(both - alone[0]) > 20)
    # The images with and without the second object differ only where this object is.
    where = renderer.view.project(np.array([[0.105, 0.0]]), SQUARE.height)[0]
    assert abs(np.mean(columns) - where[0]) < 40 and abs(np.mean(rows) - where[1]) < 40


def test_objects_of_the_same_appearance_are_rendered_identically() -> None:
    disk = SceneObject(np.asarray(CELL.outline()), CELL.object.seen())
    renderer = make_renderer(
        CELL, replace(CameraTruth(), noise=0.0), np.asarray(CELL.outline()), 1, [disk]
    )
    one = renderer.render(np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]))
    other = renderer.render(np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]))
    assert np.array_equal(one, other)
    assert one.mean() != pytest.approx(renderer.render(np.array([[-0.1, 0.0, 0.0]])).mean())


def test_an_object_placed_by_hand_is_found_again(renderer, tracker) -> None:
    for frame in range(6):
        tracker.update_several(renderer.render(POSES), 1.0 + frame / 30, [0])
    moved = POSES.copy()
    moved[1] = [-0.2, -0.1, -2.0]
    found = []
    for frame in range(60):
        # The square is measured only in every sixth frame, because in the node, objects take turns.
        due = [0] if frame % 6 == 0 else []
        _, others = tracker.update_several(renderer.render(moved), 1.2 + frame / 30, due)
        found += [one.pose for one in others.values() if one.visible]
    assert found and np.hypot(*(np.array(found[-1])[:2] - moved[1][:2])) < 5e-4


def test_objects_keep_their_names_after_occlusion_and_swapped_places(renderer, tracker) -> None:
    clock = itertools.count()

    def observe(poses: np.ndarray) -> list[np.ndarray | None]:
        for _ in range(45):
            first, others = tracker.update_several(
                renderer.render(poses), 1.0 + next(clock) / 30, [0]
            )
        return [np.array(one.pose) if one.visible else None for one in (first, others[0])]

    hidden = POSES.copy()
    hidden[1] = [5.0, 5.0, 0.0]  # outside the image
    exchanged = POSES[::-1]
    for poses, missing in ((POSES, False), (hidden, True), (exchanged, False)):
        own, other = observe(poses)
        assert own is not None and np.hypot(*(own - poses[0])[:2]) < 5e-4
        assert (other is None) == missing
        if other is not None:
            assert np.hypot(*(other - poses[1])[:2]) < 5e-4


def test_observing_other_objects_does_not_affect_the_first_object(renderer, tracker) -> None:
    pictures = [renderer.render(POSES) for _ in range(3)]
    alone = PoseTracker(CELL.camera, CELL.references, SEEN[0], SETTINGS)
    for number, picture in enumerate(pictures):
        one = alone.update(picture, number / 30)
        first, _ = tracker.update_several(picture, number / 30, [0])
        assert one.pose is not None and first.pose is not None
        assert np.hypot(*(np.array(one.pose)[:2] - np.array(first.pose)[:2])) < 1e-6


@pytest.mark.parametrize("rate", [3.0, 30.0])
@pytest.mark.parametrize("turn", [1, 7])
def test_an_object_at_rest_is_reported_at_rest_however_rarely_it_is_measured(
    renderer, tracker, rate: float, turn: int
) -> None:
    turns = RoundRobin(turn)  # of these objects, only number 0 is on the table
    settled, since = [], set()
    for frame in range(round(12 + 4 * rate)):
        stamp = 1.0 + frame / rate
        due = [number for number in turns.due(stamp) if number == 0]
        _, others = tracker.update_several(renderer.render(POSES), stamp, due)
        if frame >= 10 and 0 in others:
            settled.append(others[0].at_rest and others[0].frames_fused >= 5)
            since.add(others[0].at_rest_since)
    assert settled and all(settled) and len(since) == 1


def test_every_frame_is_measured_while_a_longer_observation_is_requested(renderer, tracker) -> None:
    for frame in range(60):
        tracker.update_several(renderer.render(POSES), 1.0 + frame / 30, [0])
    first, others = tracker.update_several(renderer.render(POSES), 3.0, [0])
    for frame in range(1, 13):
        one, two = tracker.update_several(renderer.render(POSES), 3.0 + frame / 30, [0])
        known = one.frames_fused, two[0].frames_fused
    measured = first.frames_fused, others[0].frames_fused
    for frame in range(13, 25):
        stamp = 3.0 + frame / 30
        one, two = tracker.update_several(renderer.render(POSES), stamp, [0], every_frame=True)
    assert (one.frames_fused, two[0].frames_fused) == (known[0] + 12, known[1] + 12)
    assert known[0] - measured[0] < 12 and known[1] - measured[1] < 12
