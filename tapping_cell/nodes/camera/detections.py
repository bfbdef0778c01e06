"""Publish the objects as ``vision_msgs/Detection3DArray`` if vision_msgs is installed; otherwise do
nothing."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from geometry_msgs.msg import Vector3
from rclpy.node import Node
from tapping_cell_msgs.msg import ObjectState, ObjectStates

from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.nodes.conversions import from_message, to_message
from tapping_cell.se2 import Pose

try:
    from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose
except ImportError:
    Detection3DArray = None


class DetectionPublisher:
    """Publisher of the visible objects, as boxes around their outlines."""

    def __init__(self, node: Node) -> None:
        self._publisher = None
        if Detection3DArray is not None:
            self._publisher = node.create_publisher(Detection3DArray, "detections", 10)

    def publish(self, states: ObjectStates, files: Iterable[ObjectFile]) -> None:
        """Publish the visible objects of ``states``; ``files`` are in the same order. Nothing is
        computed while there is no subscriber."""
        if self._publisher is None or not self._publisher.get_subscription_count():
            return
        pairs = zip(states.objects, files, strict=True)
        detections = [_detection(state, file) for state, file in pairs if state.visible]
        self._publisher.publish(Detection3DArray(header=states.header, detections=detections))


def _detection(state: ObjectState, file: ObjectFile) -> Detection3D:
    found = Detection3D(header=state.header, id=state.object_id)
    result = ObjectHypothesisWithPose(pose=state.pose)
    result.hypothesis.class_id, result.hypothesis.score = state.object_id, 1.0
    found.results.append(result)
    corners = np.array(file.shape.outline())
    low, high = corners.min(axis=0), corners.max(axis=0)
    x, y = (low + high) / 2
    middle = from_message(state.pose.pose) @ Pose(float(x), float(y), 0.0)
    found.bbox.center = to_message(middle, file.height / 2)
    length, width = high - low
    found.bbox.size = Vector3(x=float(length), y=float(width), z=file.height)
    return found
