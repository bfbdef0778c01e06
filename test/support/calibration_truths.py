"""Random true parameters for the calibrations, and simulated measurements."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence

import numpy as np

from tapping_cell.calibration.arm import ArmRecord, predicted
from tapping_cell.calibration.tapper import TapRecord
from tapping_cell.calibration.target import Target, TargetView
from tapping_cell.hardware.scara import ScaraGeometry
from tapping_cell.mechanics import Tap
from tapping_cell.se2 import inverse, transform_points
from tapping_cell.simulation.rendered_sheet import Sheet
from tapping_cell.vision import (
    CameraError,
    CameraModel,
    CameraPose,
    ReferenceMap,
    ReferenceMarker,
    View,
)
from tapping_cell.vision.markers.detection import marker_pattern

Random = np.random.Generator
_MODULES_A_SQUARE = 48
"""Pixels per square of the drawn target. A marker with 3 / 4 of the size of its square is 36
pixels wide, so that each of its modules has a whole number of pixels."""


def camera(random: Random) -> CameraModel:
    """Return a random camera of 1280 x 1024 pixels: 55 to 85 degrees wide, with barrel or slight
    pincushion distortion."""
    while True:
        focal = random.uniform(700.0, 1250.0)
        size = (1280, 1024, focal, focal * random.uniform(0.995, 1.005))
        middle = 639.5 + random.uniform(-25.0, 25.0), 511.5 + random.uniform(-25.0, 25.0)
        radial = random.uniform(-0.25, 0.05), random.uniform(0.0, 0.08)
        tangential = random.uniform(-5e-4, 5e-4, 2).tolist()
        # Unlike a real lens, some random coefficients map two directions to one pixel of the image.
        # CameraModel then raises an error, and other coefficients are chosen.
        with contextlib.suppress(CameraError):
            return CameraModel(*size, *middle, (*radial, *tangential, 0.0))


def view_pose(random: Random, model: CameraModel, size: tuple[float, float]) -> CameraPose:
    """Return a random pose of the camera above a target of ``size`` m, as a person would choose it
    for a photograph. The camera is tilted by 5 to 40 degrees. The target is anywhere in the image,
    and a third to two thirds as wide as the image."""
    share = random.uniform(0.35, 0.65)
    distance = size[0] / (share * model.width / model.fx)
    tilt, side = np.radians(random.uniform(5.0, 40.0)), random.uniform(0.0, 2.0 * math.pi)
    away = distance * np.array(
        [np.sin(tilt) * np.cos(side), np.sin(tilt) * np.sin(side), np.cos(tilt)]
    )
    aim = random.uniform(-0.25, 0.25, 2) * distance * model.width / model.fx
    return CameraPose.above(away, aim, random.uniform(-0.6, 0.6))


def corners_of(target: Target) -> np.ndarray:
    """Return the target's corners (N, 2) in the frame of its sheet, in m."""
    middle = 0.5 * target.square * np.array([target.columns, target.rows])
    return np.array([1.0, -1.0]) * (target.points + target.square - middle)


def corner_views(
    random: Random, model: CameraModel, target: Target, count: int, noise: float
) -> list[TargetView]:
    """Return ``count`` views as a detector with a noise of ``noise`` pixels would measure them. A
    view contains those corners of the target that are inside the image."""
    size = (target.columns * target.square, target.rows * target.square)
    views: list[TargetView] = []
    while len(views) < count:
        pixels = View(model, view_pose(random, model, size)).project(corners_of(target))
        inside = ((pixels > 5.0) & (pixels < np.array([model.width, model.height]) - 6.0)).all(1)
        if inside.sum() < target.least_corners:
            continue
        seen = pixels[inside] + noise * random.standard_normal((int(inside.sum()), 2))
        name = f"view {len(views) + 1}"
        views.append(TargetView(name, np.flatnonzero(inside), seen, 0.8, 40.0))
    return views


def target_sheet(target: Target) -> Sheet:
    """Return the target as it is printed, with a white margin."""
    n = _MODULES_A_SQUARE
    cells = np.indices((target.rows, target.columns)).sum(axis=0) % 2 * 255
    pattern = np.kron(cells, np.ones((n, n))).astype(np.uint8)
    if target.kind == "charuco":
        for number, (row, column) in enumerate(np.argwhere(cells > 0)):
            modules = marker_pattern(target.dictionary, number)
            each = round(n * target.marker / target.square) // modules.shape[0]
            marker = np.kron(modules * 255, np.ones((each, each))).astype(np.uint8)
            inset = (n - marker.shape[0]) // 2
            top, left = row * n + inset, column * n + inset
            pattern[top : top + marker.shape[0], left : left + marker.shape[1]] = marker
    return Sheet(np.pad(pattern, n // 2, constant_values=255), target.square / n)


def markers(random: Random) -> ReferenceMap:
    """Return eight reference markers near their places in config/table.yaml, with random errors of
    position and angle."""
    places = [(x, y) for y in (0.25, 0.0, -0.25) for x in (-0.33, 0.0, 0.33) if x or y]
    return ReferenceMap(
        "APRILTAG_36h11",
        tuple(
            ReferenceMarker(
                101 + number,
                0.040,
                x + random.normal(0.0, 0.006),
                y + random.normal(0.0, 0.006),
                random.normal(0.0, 0.15),
            )
            for number, (x, y) in enumerate(places)
        ),
    )


def markers_sheet(references: ReferenceMap) -> Sheet:
    """Return one sheet of 0.84 x 0.66 m with the markers. A pixel has the value at its centre."""
    pixel = 0.00025
    pattern = np.full((round(0.66 / pixel), round(0.84 / pixel)), 255, dtype=np.uint8)
    rows, columns = pattern.shape
    for m in references.markers:
        modules = marker_pattern(references.dictionary, m.id)
        reach = 0.75 * m.size
        column = (
            np.arange(round((m.x - reach) / pixel), round((m.x + reach) / pixel)) + columns // 2
        )
        row = np.arange(round((-m.y - reach) / pixel), round((-m.y + reach) / pixel)) + rows // 2
        x, y = np.meshgrid((column + 0.5 - columns / 2) * pixel, (rows / 2 - row - 0.5) * pixel)
        own = transform_points(inverse((m.x, m.y, m.theta)), np.stack([x, y], axis=-1))
        across = np.floor((own[..., 0] / m.size + 0.5) * modules.shape[0]).astype(int)
        down = np.floor((0.5 - own[..., 1] / m.size) * modules.shape[0]).astype(int)
        inside = (across >= 0) & (across < len(modules)) & (down >= 0) & (down < len(modules))
        ink = inside & ~modules[np.where(inside, down, 0), np.where(inside, across, 0)]
        pattern[np.ix_(row, column)] = np.where(ink, 0, 255)
    return Sheet(pattern, pixel)


def arm(random: Random) -> dict[str, float]:
    """Return random parameters of an arm. The base pose deviates from the drawing by 20 mm and 0.1
    rad, and the elbow's zero deviates by 0.02 rad (standard deviations). The mount of the marker is
    random too."""
    geometry = ScaraGeometry()
    return {
        "base_x": random.normal(0.0, 0.02),
        "base_y": 0.47 + random.normal(0.0, 0.02),
        "base_yaw": -math.pi / 2 + random.normal(0.0, 0.1),
        "elbow_zero": random.normal(0.0, 0.02),
        "mount_x": 0.06 + random.normal(0.0, 0.03),
        "mount_y": random.normal(0.0, 0.03),
        "mount_angle": random.uniform(-3.0, 3.0),
        "upper_arm": geometry.upper_arm,
        "forearm": geometry.forearm,
    }


def arm_joints(random: Random, truth: dict[str, float], count: int, margin: float) -> np.ndarray:
    """Return joints (count, 3) that hold the marker above the table of 0.60 x 0.44 m."""
    found: list[np.ndarray] = []
    while len(found) < count:
        joints = random.uniform([-1.5, -2.4, -3.0], [1.5, 2.4, 3.0])
        (point,), _ = predicted(joints[None], truth)
        if abs(point.real) < 0.30 - margin and abs(point.imag) < 0.22 - margin:
            found.append(joints)
    return np.array(found)


def arm_record(
    random: Random, truth: dict[str, float], count: int, position: float, angle: float
) -> ArmRecord:
    """Return measured poses with noise of ``position`` m and ``angle`` rad."""
    joints = arm_joints(random, truth, count, 0.02)
    points, angles = predicted(joints, truth)
    seen = np.stack([points.real, points.imag], axis=1)
    return ArmRecord(
        joints=joints,
        points=seen + position * random.standard_normal(seen.shape),
        angles=angles + angle * random.standard_normal(count),
        rows=np.arange(2, count + 2),
    )


def tapper(random: Random, mass: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that computes the striker's speed from the energy. It has a random
    efficiency, a random threshold, a random exponent that differs from 1 / 2 by up to 10 %, and a
    random loss that increases with the speed."""
    efficiency, power = random.uniform(0.4, 1.0), random.uniform(-0.05, 0.05)
    threshold, loss = random.uniform(0.0, 1e-4), random.uniform(0.0, 0.15)

    def speed(energy: np.ndarray) -> np.ndarray:
        ideal = np.sqrt(2.0 * efficiency * np.maximum(energy - threshold, 0.0) / mass)
        return ideal * (energy / 5e-3) ** power / (1.0 + loss * np.sqrt(energy / 0.05))

    return speed


def tap_record(
    random: Random,
    tap: Tap,
    speed: Callable[[np.ndarray], np.ndarray],
    shares: Sequence[int],
    scatter: float,
) -> TapRecord:
    """Return taps through the middle of the object at energies from 1 to 60 mJ, measured to 0.1 mm.
    ``shares`` contains the number of taps at each energy."""
    energies = np.repeat(np.geomspace(1e-3, 6e-2, len(shares)), shares)
    striker = speed(energies) * np.exp(scatter * random.standard_normal(len(energies)))
    near = np.array([-tap.body.bounding_radius, 0.0])
    launch = np.linalg.norm(tap.impact.strike(striker, 0.0, near).velocity, axis=-1)
    travel = tap.sliding.rest(launch, np.zeros_like(launch)).distance
    zero = np.zeros_like(energies)
    seen = np.maximum(travel + 1e-4 * random.standard_normal(len(energies)), 0.0)
    known = zero + 1e-4
    return TapRecord(energies, seen, zero, zero, known, np.arange(2, len(energies) + 2))
