"""Pose and covariance of the object on the table, measured with an overhead camera."""

from importlib import import_module
from typing import TYPE_CHECKING

from tapping_cell.vision.camera import CameraError, CameraModel, CameraPose, View
from tapping_cell.vision.markers.detection import (
    MarkerError,
    ObjectMarker,
    ReferenceMap,
    ReferenceMarker,
)
from tapping_cell.vision.observation import Observation, Problem
from tapping_cell.vision.other_objects import RoundRobin, marker_ids
from tapping_cell.vision.outline.shape import Dot, ObjectOutline, OutlineError
from tapping_cell.vision.rest_detection import RestSettings

if TYPE_CHECKING:
    from tapping_cell.vision.table.fit import TableSettings
    from tapping_cell.vision.tracker import PoseTracker, TrackerSettings
    from tapping_cell.vision.unknown_objects import ArmBars, Standing, UnknownObjects
else:
    _HOMES = {
        "ArmBars": "unknown_objects",
        "PoseTracker": "tracker",
        "Standing": "unknown_objects",
        "TableSettings": "table.fit",
        "TrackerSettings": "tracker",
        "UnknownObjects": "unknown_objects",
    }

    def __getattr__(name: str) -> object:
        """Import image processing at its first use; most nodes read only the settings."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


__all__ = [
    "ArmBars",
    "CameraError",
    "CameraModel",
    "CameraPose",
    "Dot",
    "MarkerError",
    "ObjectMarker",
    "ObjectOutline",
    "Observation",
    "OutlineError",
    "PoseTracker",
    "Problem",
    "ReferenceMap",
    "ReferenceMarker",
    "RestSettings",
    "RoundRobin",
    "Standing",
    "TableSettings",
    "TrackerSettings",
    "UnknownObjects",
    "View",
    "marker_ids",
]
