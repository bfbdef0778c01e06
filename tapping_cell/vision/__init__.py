"""Pose and covariance of the object on the table, measured with an overhead camera."""

from tapping_cell.vision.annotate import annotate
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
from tapping_cell.vision.table.fit import TableSettings
from tapping_cell.vision.tracker import PoseTracker, TrackerSettings
from tapping_cell.vision.unknown_objects import ArmBars, Standing, UnknownObjects

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
    "annotate",
    "marker_ids",
]
