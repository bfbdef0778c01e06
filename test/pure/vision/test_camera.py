"""The camera model: its defining formulas, and invalid parameters."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, reject
from hypothesis import strategies as st

from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.table import load_camera_model
from tapping_cell.vision import CameraError, CameraModel, CameraPose, View

coefficient = st.floats(-0.1, 0.1)
place = st.floats(-0.45, 0.45)


def by_definition(camera: CameraModel, x: float, y: float) -> tuple[float, float]:
    """Project a point by OpenCV's documented model."""
    d = (*camera.distortion, *([0.0] * (8 - len(camera.distortion))))
    k1, k2, p1, p2, k3, k4, k5, k6 = d
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return camera.fx * xd + camera.cx, camera.fy * yd + camera.cy


@given(
    st.lists(coefficient, min_size=8, max_size=8),
    place,
    place,
    st.sampled_from([0, 5, 8]),
)
def test_projection_follows_its_definition_and_rays_invert_it(values, x, y, count):
    model = "rational_polynomial" if count == 8 else "plumb_bob"
    values = [v * (0.02 if i in (2, 3) else 1.0) for i, v in enumerate(values)]
    try:
        camera = CameraModel(1280, 1024, 1100.0, 1120.0, 630.0, 515.0, tuple(values[:count]), model)
    except CameraError:
        reject()  # this lens model maps two directions to one pixel
    pixel = camera.project([2.0 * x, 2.0 * y, 2.0])
    assert pixel == pytest.approx(by_definition(camera, x, y), abs=1e-8)
    assert camera.rays(pixel) == pytest.approx([x, y], abs=1e-8)


def wide_lens(half_angle: float) -> CameraModel:
    """Return a rational_polynomial model of a fisheye lens whose image radius is proportional to
    the angle. The corners of the image are at ``half_angle`` degrees."""
    angle = np.radians(np.linspace(0.0, half_angle, 80))
    r = np.tan(angle)
    powers = r[:, None] ** [2, 4, 6]
    # The model as an equation that is linear in k: angle (1 + k4 r^2 + k5 r^4 + k6 r^6) = r (1 + k1
    # r^2 + k2 r^4 + k3 r^6).
    columns = np.hstack([r[:, None] * powers, -angle[:, None] * powers])
    k = np.linalg.lstsq(columns, angle - r, rcond=None)[0]
    focal = math.hypot(640.0, 512.0) / math.radians(half_angle)
    lens = (k[0], k[1], 1e-4, -2e-4, *k[2:])
    return CameraModel(1280, 1024, focal, focal, 639.5, 511.5, lens, "rational_polynomial")


@pytest.mark.parametrize("half_angle", [50.0, 60.0, 65.0, 70.0])
def test_rays_of_a_wide_lens_project_to_their_pixels(half_angle):
    camera = wide_lens(half_angle)
    pixels = np.stack(np.meshgrid(np.linspace(0, 1279, 60), np.linspace(0, 1023, 50)), axis=-1)
    rays = camera.rays(pixels)
    seen = camera.project(np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1))
    assert np.abs(seen - pixels).max() < 1e-6
    steepest = np.degrees(np.arctan(np.linalg.norm(rays, axis=-1).max()))
    assert steepest == pytest.approx(half_angle, abs=1.0)


def test_a_lens_that_folds_back_inside_the_image_is_refused():
    with pytest.raises(CameraError, match="pixel \\(0, 0\\).*folds back"):
        CameraModel(1280, 1024, 500.0, 500.0, 639.5, 511.5, (-0.2, 0.0, 0.0, 0.0, 0.0))
    # This lens folds back and then forth again: the corner of the image has three directions.
    folded = (-0.638, 0.355, 0.0, 0.0, 0.135, -2.018, 1.956, 0.315)
    with pytest.raises(CameraError, match="or several"):
        CameraModel(1280, 1024, 813.0, 813.0, 639.5, 511.5, folded, "rational_polynomial")
    # A smaller image is inside the circle at which this lens folds back, so the lens is accepted.
    # Pixels beyond this circle have no rays.
    small = CameraModel(640, 512, 500.0, 500.0, 319.5, 255.5, (-0.2, 0.0, 0.0, 0.0, 0.0))
    assert np.isfinite(small.rays([0.0, 0.0])).all()
    assert np.isnan(small.rays([-320.0, -256.0])).all()


@given(
    st.tuples(st.floats(-0.06, 0.06), st.floats(-0.06, 0.06), st.floats(0.4, 1.2)),
    st.floats(-3.0, 3.0),
    place,
    place,
    st.floats(0.0, 0.1),
)
def test_a_ray_intersects_the_plane_at_the_original_point(position, spin, x, y, height):
    camera = CameraModel(1280, 1024, 1150.0, 1150.0, 639.5, 511.5, (-0.12, 0.08, 4e-4, -3e-4, 0.0))
    view = View(camera, CameraPose.above(position, spin=spin))
    assert view.pose.position == pytest.approx(position, abs=1e-12)
    assert np.linalg.det(view.pose.rotation) == pytest.approx(1.0)
    scaled = np.array([x, y]) * 0.5 * position[2]
    assert view.on_plane(view.project(scaled, height), height) == pytest.approx(scaled, abs=1e-9)


def test_a_point_on_a_higher_plane_projects_further_out():
    view = View(
        CameraModel(1280, 1024, 1150.0, 1150.0, 639.5, 511.5), CameraPose.above((0, 0, 0.7))
    )
    low, high = (view.on_plane(view.project([0.3, 0.0], h), 0.0)[0] for h in (0.0, 0.07))
    assert low == pytest.approx(0.3)
    assert high == pytest.approx(0.3 * 0.7 / 0.63)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"distortion_model": "equidistant"}, "equidistant"),
        ({"d": [0.1, 0.2, 0.3]}, "but 3 are given"),
        ({"k": [0.0] * 9}, "uncalibrated"),
        ({"k": [1.0] * 4}, "4 numbers"),
        ({"d": [float("nan")] * 5}, "infinity or NaN"),
        ({"width": 4}, "too small"),
    ],
)
def test_an_invalid_camera_is_refused_with_a_message(change, words):
    info = {
        "width": 1280,
        "height": 1024,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [1000.0, 0.0, 640.0, 0.0, 1000.0, 512.0, 0.0, 0.0, 1.0],
    }
    with pytest.raises(CameraError, match=words):
        CameraModel.from_camera_info(**{**info, **change})


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((1024, 1280, 3), np.uint8),
        np.zeros((1024, 1280), np.uint16),
        np.zeros((480, 640), np.uint8),
    ],
)
def test_an_image_of_another_type_is_distinguished(image):
    camera = CameraModel(1280, 1024, 1150.0, 1150.0, 639.5, 511.5)
    assert "1280" in camera.check_image(image)
    assert "turn it by 90 degrees" in camera.check_image(np.zeros((1280, 1024), np.uint8))
    assert camera.check_image(np.zeros((1024, 1280), np.uint8)) is None


def test_the_standard_deviations_of_a_calibration_are_read_with_its_parameters(tmp_path):
    text = (shared_folder() / "camera_info.yaml").read_text()
    plain = load_camera_model(shared_folder() / "camera_info.yaml")
    path = tmp_path / "camera_info.yaml"
    path.write_text(text + "calibration: {deviations: {fx: 0.05, fy: 0.06, k1: 1.0e-4}}\n")
    stated = load_camera_model(path)
    assert plain.deviations == ()
    assert stated.deviations == (0.05, 0.06, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0)
    # Models with and without deviations compare equal, because a camera_info message has no
    # deviations.
    assert stated == plain
    with pytest.raises(CameraError, match="deviations"):
        dataclasses.replace(plain, deviations=(0.1, -1.0))
