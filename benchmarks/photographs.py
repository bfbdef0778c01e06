"""Accuracy and covariance on photographs of printed boards, compared with cv2.aruco.

``--folder`` is a folder of photographs with a file ``board.yaml``, or a folder of such folders.
The camera is calibrated from all photographs, as by ``calibrate
camera``. In each photograph, a quarter of the board's markers are reference markers of the table,
and every other marker is an object. The board states the true poses. The references either
surround the objects, as in a cell, or are every fourth marker, which on many boards is one edge, so
that the pose of the table is extrapolated. ``board.yaml`` is one of:

    {kind: charuco, columns: 8, rows: 8, square: 0.025, marker: 0.019, dictionary: 4X4_50}
    {kind: grid, columns: 4, rows: 5, marker: 0.0375, gap: 0.005, dictionary: 6X6_1000}

A board that OpenCV drew before version 4.6 also has ``legacy: true``. Lengths are in m.

Public sets (repository, folder, board):

- PhotonVision/photonvision, ``test-resources/calibrationCharucoImg/lifecam`` (webcam, two
  resolutions, board on a screen): charuco 8 x 8, 4X4_1000, square 0.0254, marker 0.01905; legacy
  for ``Old_Pattern``
- rlav440/pyCamSet, ``tests/test_data/calibration_charuco`` (three cameras of a laboratory):
  charuco 20 x 20, 4X4_1000, square 0.004, marker 0.0032
- abakisita/camera_calibration, ``aruco_data`` (webcam, printed grid on paper that is not flat):
  grid 4 x 5, 6X6_1000, marker 0.0375, gap 0.005
- jpjp210202/Hand-Eye-Calibration-Doosan-A0509-IntelRealSenseA457-ChArUco,
  ``data/intrinsics_images`` (board on cardboard): charuco 7 x 5, 4X4_50, square 0.03, marker 0.021

The views of some sets do not determine the focal length well enough; ``calibrate camera`` refuses
them.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml

from benchmarks.vision_scenes import with_deviations
from tapping_cell.calibration.camera import CalibrationRefused, calibrate_camera
from tapping_cell.calibration.target import Target, TargetView, find_target
from tapping_cell.se2 import wrap_angle
from tapping_cell.vision import (
    CameraModel,
    ObjectMarker,
    PoseTracker,
    ReferenceMap,
    ReferenceMarker,
    TrackerSettings,
    View,
)
from tapping_cell.vision.markers import aruco
from tapping_cell.vision.markers.detection import marker_dictionary
from tapping_cell.vision.markers.object_pose import pose_of_corners
from tapping_cell.vision.table.fit import initial_pose

FOLDER = True
"""The section reads the folder ``--folder``."""
EVERY = 4
"""One marker in ``EVERY`` is a reference marker (at least four)."""
BOUND = 16.27
"""Quantile of the chi-square distribution with 3 degrees of freedom at p = 0.001."""
ENDINGS = {".png", ".jpg", ".jpeg", ".bmp", ".tif"}


class Board(NamedTuple):
    """A printed board: poses (x, y) of its markers by id, with y up, and what ``find`` detects."""

    dictionary: str
    side: float
    places: dict[int, np.ndarray]
    target: Any

    @classmethod
    def load(cls, file: Path) -> Board:
        """Read ``board.yaml``."""
        b = yaml.safe_load(file.read_text(encoding="utf-8"))
        name, grid, side = str(b["dictionary"]), (b["columns"], b["rows"]), b["marker"]
        book = marker_dictionary(name)
        if b["kind"] == "charuco":
            board: Any = cv2.aruco.CharucoBoard(grid, b["square"], side, book)
            board.setLegacyPattern(bool(b.get("legacy", False)))
            target: Any = Target("charuco", *grid, b["square"], side, name)
        else:
            board = cv2.aruco.GridBoard(grid, side, b["gap"], book)
            target = GridTarget(np.concatenate(board.getObjPoints())[:, :2].astype(float))
        middles = np.array(board.getObjPoints()).mean(axis=1)[:, :2] * [1.0, -1.0]
        return cls(
            name, side, dict(zip(np.ravel(board.getIds()).tolist(), middles, strict=True)), target
        )

    def error(self, number: int, measured: np.ndarray) -> np.ndarray:
        """Return the error (3,) of the measured pose (3,) of a marker: m, m, rad."""
        error = measured - [*self.places[number], 0.0]
        error[2] = wrap_angle(error[2])
        return error

    def find(self, image: np.ndarray, name: str) -> TargetView | str:
        """Detect the points of the board for the calibration."""
        if isinstance(self.target, Target):
            return find_target(image, self.target, name)
        found = opencv_markers(image, self.dictionary)
        kept = [number for number in self.places if number in found]
        if 4 * len(kept) < self.target.least_corners:
            return f"only {len(kept)} markers are seen"
        ids = (4 * np.array(kept)[:, None] + np.arange(4)).ravel()
        return TargetView(name, ids, np.concatenate([found[k] for k in kept]), 0.7, 30.0)


class GridTarget(NamedTuple):
    """Corners (N, 2) of the markers of a grid board."""

    points: np.ndarray
    least_corners: int = 16


def opencv_markers(image: np.ndarray, dictionary: str) -> dict[int, np.ndarray]:
    """Detect markers with OpenCV's sub-pixel refinement: corners (4, 2) by id."""
    parameters = aruco.detector_parameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return dict(aruco.detect_markers(image, marker_dictionary(dictionary), parameters))


def folders(folder: Path) -> list[Path]:
    """Return the sets of photographs in a folder."""
    found = sorted(file.parent for file in folder.rglob("board.yaml"))
    if not found:
        raise SystemExit(f"{folder} contains no board.yaml; see benchmarks/photographs.py")
    return found


def around(board: Board) -> list[int]:
    """Choose markers that are as far from each other as possible, beginning in a corner."""
    ids = sorted(board.places)
    places = np.array([board.places[number] for number in ids])
    gaps = np.linalg.norm(places[:, None] - places, axis=2)
    chosen = [int(np.argmax(gaps.sum(axis=1)))]
    while len(chosen) < max(4, len(ids) // EVERY):
        chosen.append(int(np.argmax(gaps[chosen].min(axis=0))))
    return sorted(ids[row] for row in chosen)


def measure(folder: Path) -> dict[str, Any]:
    """Return the figures of every set."""
    cv2.setNumThreads(1)
    report = {}
    for each in folders(folder):
        report[str(each.relative_to(folder)) if each != folder else each.name] = _set(each)
    return report


def _set(folder: Path) -> dict[str, Any]:
    board = Board.load(folder / "board.yaml")
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in ENDINGS)
    images = {file.name: cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files}
    size = next(iter(images.values())).shape[::-1]
    views = [board.find(image, name) for name, image in images.items()]
    try:
        calibration = calibrate_camera(
            [v for v in views if isinstance(v, TargetView)], board.target, size
        )
    except CalibrationRefused as refusal:
        return {"photographs": len(images), "refused": str(refusal)}
    camera = with_deviations(calibration)
    layouts = {"around": around(board), "every fourth": sorted(board.places)[::EVERY]}
    return {
        "photographs": len(images),
        "lens": calibration.lens,
        "rms_pixels": calibration.rms,
        "layouts": {
            name: _compared(list(images.values()), camera, board, chosen)
            for name, chosen in layouts.items()
        },
    }


def _compared(
    images: list[np.ndarray], camera: CameraModel, board: Board, chosen: list[int]
) -> dict[str, Any]:
    """Measure with the markers ``chosen`` as references."""
    table = ReferenceMap(
        board.dictionary,
        tuple(ReferenceMarker(k, board.side, *board.places[k].tolist()) for k in chosen),
    )
    objects = [
        ObjectMarker(board.dictionary, k, board.side, 0.0) for k in board.places if k not in chosen
    ]
    ours, theirs, both, squares, seconds = [], [], [], [], 0.0
    for image in images:
        begin = resource.getrusage(resource.RUSAGE_SELF).ru_utime
        measured = dict(_ours(image, camera, table, objects, board))
        seconds += resource.getrusage(resource.RUSAGE_SELF).ru_utime - begin
        for error, covariance in measured.values():
            ours.append(error)
            squares.append(float(error @ np.linalg.solve(covariance, error)))
        cv2_errors = dict(_opencv(image, camera, table, objects, board))
        theirs += cv2_errors.values()
        shared = measured.keys() & cv2_errors.keys()
        both += [(measured[k][0], cv2_errors[k]) for k in shared]
    return {
        "seconds": seconds / len(images),
        "cell": _figures(ours)
        | {
            "square": float(np.mean(squares)) if squares else 0.0,
            "beyond": float(np.mean(np.array(squares) > BOUND)) if squares else 0.0,
        },
        "cv2.aruco": _figures(theirs),
        "both": {
            "cell": _figures([a for a, _ in both]),
            "cv2.aruco": _figures([b for _, b in both]),
        },
    }


def _ours(
    image: np.ndarray,
    camera: CameraModel,
    table: ReferenceMap,
    objects: list[ObjectMarker],
    board: Board,
) -> Iterator[tuple[int, tuple[np.ndarray, np.ndarray]]]:
    """Yield id, error (3,) and covariance of every object that the cell measures."""
    settings = TrackerSettings(other_ids=frozenset(each.id for each in objects))
    tracker = PoseTracker(camera, table, objects[0], settings, objects[1:])
    first, others = tracker.update_several(image, 0.0, range(len(objects) - 1))
    for number, seen in {0: first, **{k + 1: each for k, each in others.items()}}.items():
        if seen.pose is not None and seen.covariance is not None:
            each = objects[number].id
            yield each, (board.error(each, np.array(seen.pose)), seen.covariance)


def _opencv(
    image: np.ndarray,
    camera: CameraModel,
    table: ReferenceMap,
    objects: list[ObjectMarker],
    board: Board,
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield id and error (3,) of every object that cv2.aruco detects."""
    found = opencv_markers(image, board.dictionary)
    seen = [row for row, marker in enumerate(table.markers) if marker.id in found]
    if len(seen) < 2:
        return
    corners = np.concatenate([found[table.markers[row].id] for row in seen])
    pose = initial_pose(camera, table.corners()[seen].reshape(-1, 2), corners)
    if pose is None:
        return
    for each in objects:
        if each.id in found:
            measured = pose_of_corners(View(camera, pose), found[each.id], each)
            yield each.id, board.error(each.id, measured)


def _figures(errors: list[np.ndarray]) -> dict[str, float]:
    if not errors:
        return {"found": 0}
    gaps = np.hypot(*np.array(errors)[:, :2].T) * 1e3
    turns = np.degrees(np.abs(np.array(errors)[:, 2]))
    return {
        "found": len(errors),
        "median_mm": float(np.median(gaps)),
        "p95_mm": float(np.quantile(gaps, 0.95)),
        "median_deg": float(np.median(turns)),
        "p95_deg": float(np.quantile(turns, 0.95)),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    rows = [
        "error^2: mean squared standardised error (3 if the covariance is right)",
        "beyond: share of poses beyond p = 0.001",
        f"{'':<34}  {'found':>5}  {'mm median':>9} {'p95':>7}  {'deg median':>10} {'p95':>7}  "
        f"{'error^2':>7} {'beyond':>7}",
    ]
    for name, f in report.items():
        if "refused" in f:
            rows.append(f"{name}: calibration refused: {f['refused']}")
            continue
        rows.append(
            f"{name}: {f['photographs']} photographs, {f['lens']}, rms {f['rms_pixels']:.2f} pixels"
        )
        for layout, measured in f["layouts"].items():
            rows.append(f"  references {layout}, {measured['seconds']:.2f} s each")
            parts = {"cell": measured["cell"], "cv2.aruco": measured["cv2.aruco"]}
            parts |= {f"{who}, found by both": part for who, part in measured["both"].items()}
            rows += [_row(who, part) for who, part in parts.items()]
    return rows


def _row(who: str, part: dict[str, float]) -> str:
    row = f"    {who:<30}  {part['found']:>5}"
    if part["found"]:
        row += f"  {part['median_mm']:>9.4f} {part['p95_mm']:>7.4f}"
        row += f"  {part['median_deg']:>10.4f} {part['p95_deg']:>7.4f}"
    if "square" in part:
        row += f"  {part['square']:>7.2f} {100 * part['beyond']:>6.1f}%"
    return row
