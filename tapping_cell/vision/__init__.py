"""Where the object truly is on the table, with an honest covariance, from an overhead camera."""

from tapping_cell.vision.camera import CameraError, CameraModel, CameraPose, View
from tapping_cell.vision.markers import (
    MarkerError,
    ObjectMarker,
    ReferenceMap,
    ReferenceMarker,
)

__all__ = [
    "CameraError",
    "CameraModel",
    "CameraPose",
    "MarkerError",
    "ObjectMarker",
    "ReferenceMap",
    "ReferenceMarker",
    "View",
]
