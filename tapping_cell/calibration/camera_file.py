"""The calibrated camera as ROS's camera_info YAML (``camera_calibration_parsers``)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from tapping_cell.calibration.camera import CameraCalibration
from tapping_cell.calibration.keep import fingerprints, now
from tapping_cell.configuration.provenance import Provenance, provenance_yaml
from tapping_cell.se2 import Array
from tapping_cell.vision.camera import CameraModel


def camera_record(result: CameraCalibration, target: str, inputs: Sequence[Path]) -> Provenance:
    """Create the record of a calibration; ``target`` is a description of the target used."""
    return Provenance(
        by="calibrate camera",
        made=now(),
        inputs=fingerprints(inputs),
        observations=sum(len(view.residuals) for view in result.views),
        left_out=len(result.rejected),
        residual=result.rms,
        residual_of="root mean square of the distances of corners, pixels",
        uncertainty=result.focal_deviation,
        uncertainty_of="focal length, relative",
        deviations={name: value for name, value in result.deviations.items() if value > 0},
        notes=(
            f"target: {target}",
            f"{len(result.views)} views used, {len(result.rejected)} photographs left out",
            f"lens: {result.lens}",
            *result.warnings,
        ),
    )


def camera_info_yaml(model: CameraModel, name: str, record: Provenance) -> str:
    """Format the file. As in ROS, the image rectified by the projection matrix contains only valid
    pixels."""
    size = (model.width, model.height)
    projection, _ = cv2.getOptimalNewCameraMatrix(model.matrix, model.coefficients, size, 0.0)
    lines = [
        f"image_width: {model.width}",
        f"image_height: {model.height}",
        f"camera_name: {json.dumps(name, ensure_ascii=False)}",
        *_matrix("camera_matrix", model.matrix),
        f"distortion_model: {model.distortion_model}",
        *_matrix("distortion_coefficients", np.array([model.distortion])),
        *_matrix("rectification_matrix", np.eye(3)),
        *_matrix("projection_matrix", np.column_stack([projection, np.zeros(3)])),
    ]
    return "\n".join(lines) + "\n" + provenance_yaml(record)


def _matrix(name: str, values: Array) -> list[str]:
    rows, columns = values.shape
    data = ", ".join(repr(float(value)) for value in np.ravel(values))
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{data}]"]
