"""Joint states of other robots on the same topic: recognised by their bytes, and never read."""

from __future__ import annotations

import pytest
import rclpy
from harness import Bench
from hypothesis import given
from hypothesis import strategies as st
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from tapping_cell.configuration.cell import load_cell
from tapping_cell.nodes import own_joints
from tapping_cell.nodes.camera.arm_view import ArmView
from tapping_cell.nodes.own_joints import OwnJoints

NAMES = ("shoulder", "elbow")
OTHERS = ("wheel", "left_shoulder", "elbow_2", "Elbow", "")


@given(
    st.lists(st.sampled_from(NAMES + OTHERS), unique=True, max_size=7),
    st.integers(0, 7),
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9),
)
def test_positions_are_found_exactly_if_all_joints_have_one(
    names: list[str], count: int, frame: str
) -> None:
    message = JointState(name=names, position=[float(i) for i in range(count)])
    message.header.frame_id = frame
    places = {name: float(i) for i, name in enumerate(names) if i < count}
    expected = tuple(places[name] for name in NAMES) if set(NAMES) <= set(places) else None
    own, data = OwnJoints(NAMES), serialize_message(message)
    assert own.positions(data) == expected
    assert own.may_be_in(data) or not set(NAMES) <= set(names)


def test_a_message_without_the_joints_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_joints, "deserialize_message", None)
    foreign = serialize_message(JointState(name=["wheel"], position=[1.0]))
    assert OwnJoints(NAMES).positions(foreign) is None
    assert not OwnJoints(()).may_be_in(foreign)


def test_the_arm_is_found_behind_many_messages_of_another_robot() -> None:
    rclpy.init()
    node, wait = Node("probe"), Bench().wait
    try:
        view = ArmView(node, load_cell())
        publisher = node.create_publisher(JointState, "joint_states", 200)
        wait(publisher.get_subscription_count, "the view listens")
        names, place = load_cell().arm.joint_names, (0.4, 0.8, -0.02, 0.1)
        assert not view.is_known
        for position in ((0.0,) * 4, place):
            publisher.publish(JointState(name=names, position=position))
        for _ in range(150):
            publisher.publish(JointState(name=["wheel"], position=[1.0]))
        # No executor spins: the messages of others wake nobody.
        wait(lambda: view._joints() == place, "the newest joints of the arm")
        view.close()
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
