"""Frames have the cell's prefix in every message that leaves a node, and only there."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped
from harness import bench
from tapping_cell_msgs.msg import ObjectState, ObjectStates

from tapping_cell.nodes.camera.camera_pose import CameraPose
from tapping_cell.nodes.frame_names import add_prefix, remove_table_prefix


def test_the_prefix_is_added_once_also_in_nested_messages() -> None:
    message = ObjectStates(objects=[ObjectState(), ObjectState()])
    message.header.frame_id = message.objects[0].header.frame_id = "table"
    message.objects[1].header.frame_id = "fixture"  # of others
    for _ in range(2):
        add_prefix(message, "left/")
    frames = [message.header.frame_id, *(each.header.frame_id for each in message.objects)]
    assert frames == ["left/table", "left/table", "fixture"]


def test_only_the_own_table_loses_its_prefix() -> None:
    names = {"left/table": "table", "table": "table", "right/table": "right/table", "jig": "jig"}
    for given, expected in names.items():
        goal = PoseStamped()
        goal.header.frame_id = given
        remove_table_prefix(goal, "left/")
        assert goal.header.frame_id == expected


def test_a_node_adds_its_prefix() -> None:
    with bench(lambda: [CameraPose()], {"camera_pose": {"frame_prefix": "left/"}}) as b:
        states: list[ObjectState] = b.listen_own_object()
        b.wait(lambda: states, "the node reports that it has no image")
        assert states[-1].header.frame_id == "left/table"
