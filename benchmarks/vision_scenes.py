"""Random scenes of the vision benchmarks, and scores of observations against ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from tapping_cell.calibration.camera import CameraCalibration
from tapping_cell.configuration.cell import load_cell
from tapping_cell.se2 import wrap_angle
from tapping_cell.simulation.rendered_camera import SceneRenderer, SceneSettings
from tapping_cell.vision import CameraModel, CameraPose, ObjectMarker, Observation, ReferenceMap

BOUND_95 = 7.815
"""95 % quantile of the chi-square distribution with 3 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class Cell:
    """Contents of the files of ``config/``: camera, reference markers and the disk's marker."""

    camera: CameraModel
    table: ReferenceMap
    marker: ObjectMarker

    @classmethod
    def load(cls) -> Cell:
        """Load the files from the package's share folder."""
        cell = load_cell()
        marker = cell.object.seen()
        assert isinstance(marker, ObjectMarker)
        return cls(cell.camera, cell.references, marker)


def random_scene(
    random: np.random.Generator, cell: Cell, seed: int, turn: float = 0.0
) -> SceneRenderer:
    """Return a random scene. The camera is tilted by up to 5 degrees, and also turned by ``turn``
    rad about its x axis. The noise is 2 to 4 grey levels. The brightness decreases from one side of
    the table to the other by up to two thirds."""
    settings = SceneSettings(
        noise=random.uniform(2.0, 4.0),
        light_falloff=random.uniform(0.0, 0.67),
        light_direction=random.uniform(0.0, 2.0 * math.pi),
        vignetting=0.2,
        blur=random.uniform(0.5, 0.9),
    )
    place = (*random.uniform(-0.043, 0.043, 2), 0.7)
    pose = CameraPose.above(place, spin=random.uniform(-0.05, 0.05))
    pose = pose.moved([turn, 0.0, 0.0, 0.0, 0.0, 0.0])
    return SceneRenderer(
        cell.camera, pose, cell.table, disk_outline(), cell.marker, settings, seed=seed
    )


def disk_outline() -> np.ndarray:
    """Return points (n, 2) of the rim of the disk, in m."""
    angle = np.linspace(0.0, 2.0 * math.pi, 120, endpoint=False)
    return 0.048 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def random_place(random: np.random.Generator) -> np.ndarray:
    """Return a random pose (3,) on the table."""
    return random.uniform([-0.25, -0.17, -math.pi], [0.25, 0.17, math.pi])


def miscalibrated(
    random: np.random.Generator, cell: Cell, lens: float, misprint: float
) -> tuple[CameraModel, ReferenceMap]:
    """Return camera and table files with random errors. The errors of the lens are ``lens`` times
    the standard deviations that OpenCV's calibration reports for twenty views. The reference
    markers have random displacements with a standard deviation of ``misprint`` m. They are also
    rotated, and the rotation moves their corners by half of ``misprint``."""
    n = lens * random.standard_normal(8)
    known = cell.camera
    wrong = np.array([0.0015 * n[4], 0.004 * n[5], 1.2e-4 * n[6], 1.2e-4 * n[7], 0.0])
    camera = replace(
        known,
        fx=known.fx + 0.5 * n[0],
        fy=known.fy + 0.5 * n[1],
        cx=known.cx + 0.7 * n[2],
        cy=known.cy + 0.7 * n[3],
        distortion=tuple((known.coefficients[:5] + wrong).tolist()),
    )
    markers = []
    for marker in cell.table.markers:
        x, y, turn = misprint * random.standard_normal(3)
        arm = marker.size / math.sqrt(2.0)
        moved = replace(marker, x=marker.x + x, y=marker.y + y)
        markers.append(replace(moved, theta=marker.theta + 0.5 * turn / arm))
    return camera, ReferenceMap(cell.table.dictionary, tuple(markers))


def with_deviations(calibration: CameraCalibration) -> CameraModel:
    """Return the calibrated camera with the standard deviations in the calibration file."""
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    stated = tuple(calibration.deviations.get(name, 0.0) for name in names)
    return replace(calibration.model, deviations=stated)


def error_of(observation: Observation, true: np.ndarray) -> np.ndarray:
    """Return the error of a valid observation, (3,): m, m, rad."""
    assert observation.pose is not None
    error = np.array(observation.pose) - true
    error[2] = wrap_angle(error[2])
    return error


@dataclass(slots=True)
class Score:
    """Errors and squared normalised errors (squared Mahalanobis distances) of many observations,
    and the number of missed ones."""

    errors: list[np.ndarray]
    normalised: list[float]
    missed: int = 0

    def add(self, observation: Observation, true: np.ndarray) -> None:
        """Add one observation."""
        if observation.covariance is None:
            self.missed += 1
            return
        error = error_of(observation, true)
        self.errors.append(error)
        self.normalised.append(float(error @ np.linalg.solve(observation.covariance, error)))

    def figures(self) -> dict[str, Any]:
        """Return the mean squared normalised error, the share within the 95 % bound, and the errors
        in mm and degrees."""
        errors = np.array(self.errors)
        gaps = np.hypot(errors[:, 0], errors[:, 1]) * 1e3
        turns = np.degrees(np.abs(errors[:, 2]))
        inside = np.array(self.normalised) < BOUND_95
        return {
            "count": len(errors),
            "missed": self.missed,
            "mean_normalised": float(np.mean(self.normalised)),
            "within_95": float(inside.mean()),
            "median_mm": float(np.median(gaps)),
            "p95_mm": float(np.quantile(gaps, 0.95)),
            "median_deg": float(np.median(turns)),
            "p95_deg": float(np.quantile(turns, 0.95)),
        }


def score_lines(scores: dict[str, dict[str, Any]]) -> list[str]:
    """Format several scores as a table."""
    width = max(len(name) for name in scores)
    rows = [
        f"{'':<{width}}  {'count':>5} {'missed':>6}  {'error^2':>7} {'in 95 %':>7}"
        f"  {'mm median':>9} {'p95':>7}  {'deg median':>10} {'p95':>7}"
    ]
    for name, f in scores.items():
        rows.append(
            f"{name:<{width}}  {f['count']:>5} {f['missed']:>6}  {f['mean_normalised']:>7.2f} "
            f"{f['within_95'] * 100:>6.1f}%  {f['median_mm']:>9.4f} {f['p95_mm']:>7.4f}  "
            f"{f['median_deg']:>10.4f} {f['p95_deg']:>7.4f}"
        )
    return rows


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Limit OpenCV to one thread."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
