"""The objects as ``vision_msgs/Detection3DArray``, where vision_msgs is installed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from harness import bench
from test_camera_pose import TRUE, Cell

from tapping_cell.configuration.cell import load_cell
from tapping_cell.nodes.camera.camera_pose import CameraPose
from tapping_cell.nodes.conversions import from_message
from tapping_cell.se2 import Pose
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.truth import CameraTruth

vision_msgs = pytest.importorskip("vision_msgs.msg", reason="vision_msgs is not installed")


@pytest.fixture
def cell() -> Iterator[Cell]:
    configuration = load_cell()
    renderer = make_renderer(configuration, CameraTruth(), np.asarray(configuration.outline()), 1)
    with bench(lambda: [CameraPose()], {"camera_pose": {"frame_prefix": "left/"}}) as b:
        yield Cell(b, b.listen_own_object(), [], renderer)


def test_a_visible_object_is_a_detection_with_its_box(cell: Cell) -> None:
    received = cell.bench.listen(vision_msgs.Detection3DArray, "detections")
    cell.show(10)
    cell.bench.wait(lambda: received and received[-1].detections, "a detection")
    (found,) = received[-1].detections
    file = load_cell().object
    assert found.id == found.results[0].hypothesis.class_id == file.name
    assert received[-1].header.frame_id == found.header.frame_id == "left/table"
    assert from_message(found.results[0].pose.pose).distance_to(TRUE) < 0.001
    assert found.results[0].pose.covariance[0] > 0
    assert from_message(found.bbox.center).distance_to(TRUE) < 0.001
    assert found.bbox.center.position.z == pytest.approx(file.height / 2)
    size, across = found.bbox.size, 2 * file.shape.reach()
    assert (size.x, size.y, size.z) == pytest.approx((across, across, file.height), rel=0.01)


def test_an_object_that_is_not_seen_is_no_detection(cell: Cell) -> None:
    received = cell.bench.listen(vision_msgs.Detection3DArray, "detections")
    cell.show(3)
    cell.bench.wait(lambda: received and received[-1].detections, "a detection")
    cell.show(3, Pose(5.0, 0.0, 0.0))
    cell.bench.wait(lambda: not received[-1].detections, "no detection")
