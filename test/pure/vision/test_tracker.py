"""The complete vision on rendered frames: accuracy, covariance, and the messages for all
problems."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import CAMERA, DISK, MARKER, POSE, REFERENCES, renderer

from tapping_cell.se2 import Pose, transform_points, wrap_angle
from tapping_cell.simulation.rendered_camera import Occluder, SceneRenderer
from tapping_cell.vision import (
    CameraModel,
    CameraPose,
    ObjectMarker,
    Observation,
    PoseTracker,
    Problem,
    ReferenceMap,
    View,
)
from tapping_cell.vision.annotate import annotate
from tapping_cell.vision.table.fit import initial_pose
from tapping_cell.vision.table.tracker import TableTracker

HOME = np.array([0.1, 0.05, 0.4])
FRAME = 1.0 / 30.0


@pytest.fixture(scope="module")
def scene() -> SceneRenderer:
    return renderer()


@pytest.fixture(scope="module")
def bumped() -> SceneRenderer:
    """Return a scene whose camera was tilted by 0.3 degrees."""
    turned = POSE.moved([math.radians(0.3), 0.0, 0.0, 0.0, 0.0, 0.0])
    return renderer(turned, seed=1)


class Film:
    """Passes frames at 30 Hz to a tracker."""

    def __init__(self, tracker: PoseTracker | None = None) -> None:
        self.tracker = tracker or PoseTracker(CAMERA, REFERENCES, MARKER)
        self.time = 100.0

    def show(self, image: np.ndarray, stamp: float | None = None) -> Observation:
        self.time += FRAME
        return self.tracker.update(image, self.time if stamp is None else stamp)

    def rest(self, scene: SceneRenderer, frames: int, pose: np.ndarray = HOME) -> Observation:
        for _ in range(frames):
            observation = self.show(scene.render(pose))
        return observation


def error(observation: Observation, pose: np.ndarray) -> np.ndarray:
    """Return the errors x, y in mm and theta in degrees."""
    assert observation.pose is not None
    d = np.array(observation.pose) - pose
    return np.array([d[0] * 1e3, d[1] * 1e3, np.degrees(wrap_angle(d[2]))])


def hand(pose: np.ndarray, size: float = 0.06, height: float = 0.03) -> Occluder:
    square = size * np.array([[-1.0, -0.4], [1.0, -0.4], [1.0, 1.0], [-1.0, 1.0]])
    corners = transform_points(pose, square)
    return Occluder(np.column_stack([corners, np.full(4, height)]))


def test_at_rest_everything_is_known(scene):
    film = Film()
    seen = film.rest(scene, 30)
    assert seen.visible and seen.at_rest
    assert seen.problem is Problem.NONE
    assert seen.frames_fused >= 28
    assert seen.references_used == tuple(range(101, 109))
    assert seen.at_rest_since < 100.0 + 3 * FRAME
    assert np.all(np.abs(error(seen, HOME)) < [0.005, 0.005, 0.005])


def test_a_slide_is_tracked_and_its_end_detected(scene):
    film = Film()
    film.rest(scene, 6)
    velocity = np.array([0.15, -0.06, 1.0])
    for k in range(6):
        pose = HOME + velocity * k * FRAME
        seen = film.show(scene.render(pose, [pose + velocity * 0.006]))
        if k > 0:
            assert seen.visible and not seen.at_rest
        if k > 2:
            assert seen.velocity == pytest.approx(velocity, rel=0.05)
    end = HOME + velocity * 6 * FRAME
    stopped = film.time + FRAME
    seen = film.rest(scene, 5, end)
    assert seen.at_rest
    assert stopped - 1e-9 <= seen.at_rest_since <= stopped + FRAME + 1e-9
    assert np.all(np.abs(error(seen, end)) < [0.006, 0.006, 0.008])


def test_exact_files_give_small_errors_and_a_matching_covariance():
    """Camera pose, noise, blur and light differ between the scenes."""
    random = np.random.default_rng(8)
    normalised, errors = [], []
    for number in range(4):
        pose = CameraPose.above((*random.uniform(-0.05, 0.05, 2), 0.7), spin=0.01)
        scene = renderer(
            pose,
            seed=number,
            noise=random.uniform(2.0, 4.0),
            light_falloff=random.uniform(0.0, 0.6),
            blur=random.uniform(0.5, 0.9),
        )
        film = Film()
        for _ in range(4):
            place = random.uniform([-0.24, -0.17, -np.pi], [0.24, 0.17, np.pi])
            seen = film.rest(scene, 15, place)
            assert seen.at_rest
            d = error(seen, place) / [1e3, 1e3, np.degrees(1.0)]
            errors.append(d)
            normalised.append(d @ np.linalg.solve(seen.covariance, d))
    assert np.all(np.quantile(np.abs(errors), 0.95, axis=0) < [8e-6, 8e-6, np.radians(0.01)])
    # The mean is that of 16 chi-square values with 3 degrees of freedom. The four values of a scene
    # are correlated, because the error of the averaged reference markers is common to them.
    # The covariance of the edges is that of real images, and too large for renderings.
    assert np.mean(normalised) < 4.8
    assert np.mean(np.array(normalised) < 7.815) > 0.8


def test_tracking_works_with_a_third_of_the_light_and_more_noise(scene):
    dim = renderer(noise=4.0, light_falloff=0.67, seed=3)
    film = Film()
    for x, y in ((-0.25, -0.17), (0.0, 0.17), (0.25, -0.17)):
        place = np.array([x, y, 3.0 * x])
        seen = film.rest(dim, 12, place)
        assert seen.visible and seen.at_rest
        assert np.all(np.abs(error(seen, place)) < [0.02, 0.02, 0.02])


def test_a_hand_over_the_object(scene):
    film = Film()
    film.rest(scene, 12)
    for _ in range(8):
        seen = film.show(scene.render(HOME, occluders=[hand(HOME)]))
        assert not seen.visible and seen.pose is None
        assert seen.problem is Problem.OBJECT_HIDDEN
        assert "3" in seen.sentence
    elsewhere = HOME + np.array([-0.2, 0.03, 1.0])
    seen = film.rest(scene, 12, elsewhere)
    assert seen.at_rest
    assert np.all(np.abs(error(seen, elsewhere)) < 0.01)


def test_tracking_works_with_an_occluded_reference(scene):
    film = Film()
    cover = hand(np.array([-0.33, 0.25, 0.0]), 0.04, 0.0)
    for _ in range(12):
        seen = film.show(scene.render(HOME, occluders=[cover]))
    assert seen.at_rest
    assert 101 not in seen.references_used
    assert len(seen.references_used) == 7
    assert np.all(np.abs(error(seen, HOME)) < 0.01)


def test_a_reference_occluded_later_is_reported_until_it_is_seen_again(scene):
    film = Film()
    assert film.rest(scene, 12).sentence == ""
    cover = hand(np.array([-0.33, 0.25, 0.0]), 0.04, 0.0)
    for _ in range(15):
        seen = film.show(scene.render(HOME, occluders=[cover]))
        assert seen.visible
        assert np.all(np.abs(error(seen, HOME)) < 0.01)
    assert seen.sentence == "reference marker 101 is not seen; uncover it"
    assert film.rest(scene, 6).sentence == ""


def test_an_occlusion_for_less_than_the_patience_is_not_reported(scene):
    film = Film(PoseTracker(CAMERA, REFERENCES, MARKER, patience=0.5))
    film.rest(scene, 12)
    cover = hand(np.array([-0.33, 0.25, 0.0]), 0.04, 0.0)

    def said(frames: int) -> list[str]:
        return [film.show(scene.render(HOME, occluders=[cover])).sentence for _ in range(frames)]

    for _ in range(2):  # each passage of the arm is a new occlusion
        assert said(12) == [""] * 12
        assert film.rest(scene, 6).sentence == ""
    assert "reference marker 101 is not seen; uncover it" in said(30)


def test_a_displaced_reference_is_reported():
    wrong = tuple(
        dataclasses.replace(m, x=m.x + 0.003) if m.id == 105 else m for m in REFERENCES.markers
    )
    scene = renderer(references=ReferenceMap(REFERENCES.dictionary, wrong))
    seen = Film().rest(scene, 8)
    assert seen.at_rest
    assert 105 not in seen.references_used
    assert "105" in seen.sentence
    assert np.all(np.abs(error(seen, HOME)) < 0.02)


def test_a_bumped_camera_is_detected_and_corrected(scene, bumped):
    film = Film()
    film.rest(scene, 10)
    sentences = []
    for _ in range(12):
        seen = film.show(bumped.render(HOME))
        if seen.visible:
            assert np.all(np.abs(error(seen, HOME)) < 0.05)
            sentences.append(seen.sentence)
        else:
            assert seen.problem in (Problem.CAMERA_MOVED, Problem.REFERENCES_HIDDEN)
    assert seen.at_rest
    assert any("moved" in sentence for sentence in sentences)


def test_a_camera_moved_too_far_is_refused(scene):
    far = renderer(CameraPose.above((0.12, -0.02, 0.7), (0.09, 0.0), spin=0.02), seed=5)
    film = Film()
    film.rest(scene, 6)
    for _ in range(20):
        seen = film.show(far.render(HOME))
        assert not seen.visible
    assert seen.problem is Problem.CAMERA_MOVED_TOO_FAR
    assert "50 mm" in seen.sentence


def test_all_references_hidden(scene):
    everything = [hand(np.array([m.x, m.y, 0.0]), 0.045, 0.0) for m in REFERENCES.markers]
    film = Film()
    seen = film.show(scene.render(HOME, occluders=everything))
    assert seen.problem is Problem.TABLE_UNKNOWN
    film = Film()
    film.rest(scene, 10)
    seen = film.show(scene.render(HOME, occluders=everything))
    assert seen.visible and seen.at_rest
    moved = film.show(scene.render(HOME + np.array([0.002, 0.0, 0.0]), occluders=everything))
    assert moved.problem is Problem.REFERENCES_HIDDEN
    film.time += 3.0
    seen = film.show(scene.render(HOME, occluders=everything))
    assert seen.problem is Problem.REFERENCES_HIDDEN
    assert "hidden for" in seen.sentence


def test_light_off_and_on(scene):
    film = Film()
    film.rest(scene, 8)
    for _ in range(4):
        seen = film.show(scene.render(HOME, light=0.02))
        assert seen.problem is Problem.DARK and not seen.visible
    seen = film.rest(scene, 4)
    assert seen.at_rest
    assert np.all(np.abs(error(seen, HOME)) < 0.01)
    seen = film.show(np.full((1024, 1280), 255, np.uint8))
    assert seen.problem is Problem.OVEREXPOSED


def test_frozen_late_and_wrong_frames(scene):
    film = Film()
    film.rest(scene, 5)
    image = scene.render(HOME)
    assert film.show(image).visible
    assert film.show(image).problem is Problem.FROZEN_FRAME
    frames = film.show(scene.render(HOME)).frames_fused
    assert film.show(scene.render(HOME), film.time - 1.0).problem is Problem.LATE_FRAME
    assert film.show(scene.render(HOME), float("nan")).problem is Problem.LATE_FRAME
    small = film.show(np.zeros((480, 640), np.uint8))
    assert small.problem is Problem.WRONG_IMAGE and "640 x 480" in small.sentence
    colour = film.show(np.zeros((1024, 1280, 3), np.uint8))
    assert colour.problem is Problem.WRONG_IMAGE
    assert film.show(scene.render(HOME)).frames_fused == frames + 1


def test_a_duplicate_a_wrong_and_a_mirrored_marker(scene):
    other = PoseTracker(CAMERA, REFERENCES, ObjectMarker("apriltag_36h11", 9, 0.05, 0.012))
    seen = Film(other).show(scene.render(HOME))
    assert seen.problem is Problem.WRONG_MARKER
    assert "marker 9" in seen.sentence and "3" in seen.sentence
    image = scene.render(HOME)
    x, y = (round(v) for v in scene.view.project(HOME[:2], 0.012))
    patch = image[y - 70 : y + 70, x - 70 : x + 70].copy()
    twice = image.copy()
    twice[700:840, 300:440] = patch
    seen = Film().show(twice)
    assert seen.problem is Problem.DUPLICATE_MARKER and not seen.visible
    mirrored = image.copy()
    mirrored[y - 70 : y + 70, x - 70 : x + 70] = patch[:, ::-1]
    assert Film().show(mirrored).problem is Problem.MIRRORED_MARKER


def test_an_object_at_another_height_is_not_accepted():
    lifted = renderer(marker=dataclasses.replace(MARKER, height=0.045))
    seen = Film().rest(lifted, 3)
    assert seen.problem is Problem.MISSHAPEN_MARKER and not seen.visible
    assert "lifted" in seen.sentence


def test_another_dictionary_and_size_for_the_object():
    marker = ObjectMarker("aruco_4x4_50", 17, 0.03, 0.02, (0.01, 0.005, 1.0))
    scene = renderer(marker=marker)
    seen = Film(PoseTracker(CAMERA, REFERENCES, marker)).rest(scene, 10)
    assert seen.at_rest
    assert np.all(np.abs(error(seen, HOME)) < [0.01, 0.01, 0.02])


def test_a_small_marker_among_larger_references():
    marker = ObjectMarker("apriltag_36h11", 5, 0.016, 0.012)
    scene = renderer(marker=marker)
    seen = Film(PoseTracker(CAMERA, REFERENCES, marker)).rest(scene, 12)
    assert seen.visible
    assert np.all(np.abs(error(seen, HOME)) < [0.02, 0.02, 0.3])


def test_a_soft_lens_causes_no_bias():
    scene = renderer(blur=1.8)
    film = Film()
    for place in (HOME, HOME + np.array([-0.3, 0.05, 1.0])):
        seen = film.rest(scene, 30, place)
        assert seen.at_rest
        assert np.all(np.abs(error(seen, place)) < 0.03)


def test_the_camera_pose_is_found_from_the_map(scene):
    film = Film()
    film.rest(scene, 20)
    table: TableTracker = film.tracker.table
    assert np.all(np.abs(table.pose.position - POSE.position) < 2e-5)
    sigma = np.sqrt(np.diag(table.covariance))
    assert np.all(sigma < [2e-5, 2e-5, 1e-5, 1e-5, 1e-5, 2e-5])


def test_a_wrong_lens_is_corrected_by_the_references(scene):
    """The calibration has twice the usual errors, and the object is at the edge of the table."""
    off = dataclasses.replace(
        CAMERA,
        fx=1151.0,
        fy=1150.8,
        cx=640.7,
        cy=510.6,
        distortion=(-0.123, 0.085, 0.0005, -0.0003, 0.0),
    )
    film = Film(PoseTracker(off, REFERENCES, MARKER))
    edge = np.array([0.23, -0.15, 0.4])
    seen = film.rest(scene, 10, edge)
    d = error(seen, edge)
    assert np.all(np.abs(d) < 4.0 * np.sqrt(np.diag(seen.covariance)) * [1e3, 1e3, 57.3])
    assert np.all(np.abs(d) < [0.02, 0.02, 0.01])


def test_a_bad_print_widens_the_covariance(scene):
    exact = Film().rest(scene, 10)
    random = np.random.default_rng(6)
    printed = tuple(
        dataclasses.replace(m, x=m.x + random.normal(0, 1e-4), y=m.y + random.normal(0, 1e-4))
        for m in REFERENCES.markers
    )
    doubtful = renderer(references=ReferenceMap(REFERENCES.dictionary, printed))
    seen = Film().rest(doubtful, 10)
    sigma = np.sqrt(np.diag(seen.covariance))
    assert sigma[0] > 10.0 * np.sqrt(exact.covariance[0, 0])
    assert np.all(np.abs(error(seen, HOME)[:2]) * 1e-3 < 4.0 * sigma[:2])


def test_the_annotated_image_shows_outline_and_numbers(scene):
    film = Film()
    seen = film.rest(scene, 5)
    image = scene.render(HOME)
    picture = annotate(image, film.tracker.view, seen, DISK, 0.012, Pose(0.0, 0.0, 0.0))
    assert picture.shape == (1024, 1280, 3)
    rim = scene.view.project(transform_points(HOME, DISK[::20]), 0.012).round().astype(int)
    green = picture[rim[:, 1], rim[:, 0]].astype(int)
    assert np.all(green[:, 1] - green[:, 2] > 60)
    used = film.tracker.view.project(REFERENCES.corners()[0, 0]).round().astype(int)
    plain = picture[used[1], used[0]].astype(int)
    marked = annotate(image, film.tracker.view, seen, DISK, 0.012, references=REFERENCES)
    blue = marked[used[1], used[0]].astype(int)
    assert blue[0] - blue[2] > 60 > plain[0] - plain[2]
    once = annotate(image, film.tracker.view, Film().show(image), DISK, 0.012)
    green = once[rim[:, 1], rim[:, 0]].astype(int)
    assert np.all(green[:, 1] - green[:, 2] > 60)
    blank = annotate(image, None, Observation(0.0, sentence="words"), DISK, 0.012)
    assert not np.array_equal(blank[:60], cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)[:60])
    assert np.array_equal(blank[100:], cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)[100:])


def test_an_uncalibrated_resolution_is_refused():
    half = CameraModel(640, 512, 575.0, 575.0, 319.5, 255.5)
    seen = Film(PoseTracker(half, REFERENCES, MARKER)).show(np.zeros((1024, 1280), np.uint8))
    assert seen.problem is Problem.WRONG_IMAGE
    assert "640 x 512" in seen.sentence


@given(
    st.sampled_from([0.0, 1e-9, 1e-3, 0.2]),
    st.sampled_from([0.0, math.pi / 2, 0.3]),
    st.integers(2, len(REFERENCES.markers)),
)
def test_the_initial_pose_is_that_of_the_camera(tilt: float, spin: float, count: int) -> None:
    """Also if the camera looks exactly along the normal of the table, as simulated cameras do."""
    pose = CameraPose.above((0.03, -0.02, 0.7), spin=spin).moved(np.array([tilt, 0, 0, 0, 0, 0]))
    corners = REFERENCES.corners()[:count].reshape(-1, 2)
    camera = dataclasses.replace(CAMERA, distortion=())
    found = initial_pose(camera, corners, View(camera, pose).project(corners))
    assert found is not None
    assert np.allclose(found.position, pose.position, atol=1e-6)
    assert np.allclose(found.rotation, pose.rotation, atol=1e-6)
