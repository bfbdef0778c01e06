"""Diagnosis of photographs that show a target other than the specified one."""

from __future__ import annotations

from dataclasses import replace

from tapping_cell.calibration.target import Target, TargetError, find_target
from tapping_cell.vision.camera import Image
from tapping_cell.vision.markers import aruco
from tapping_cell.vision.markers.detection import marker_dictionary

_FAMILIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_36h11")


def hint(image: Image, target: Target) -> str | None:
    """Describe the target that a grey image seems to show; None if no target is recognised."""
    others = [
        (replace(target, columns=target.columns + 1, rows=target.rows + 1), "--corners"),
        (replace(target, columns=target.columns - 1, rows=target.rows - 1), "--squares"),
        (replace(target, columns=target.rows, rows=target.columns), "--squares"),
    ]
    for other, option in others:
        try:
            found = find_target(image, other, "")
        except TargetError:
            continue
        if not isinstance(found, str):
            return (
                f"a board of {other.columns} x {other.rows} squares is visible: --squares counts"
                f" squares, --corners inner corners; give --squares {other.columns}x{other.rows}"
                + (
                    f" or --corners {other.inner[0]}x{other.inner[1]}"
                    if option == "--corners"
                    else ""
                )
            )
    if target.kind == "charuco":
        seen = {name: _markers(image, name) for name in _FAMILIES}
        best = max(seen, key=lambda name: seen[name])
        if seen[best] >= 4:
            return f"{seen[best]} markers of {best} are visible: give --dictionary {best}"
    return None


def _markers(image: Image, name: str) -> int:
    """Count the markers of a dictionary in the image."""
    found = aruco.detect_markers(image, marker_dictionary(name), aruco.detector_parameters())
    return len({number for number, _ in found})
