"""A node reports endpoints of other nodes that can never connect to its topics."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.event_handler import EventHandler
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool, String
from tapping_cell_msgs.msg import ObjectStates, PlanState

from tapping_cell.cli.graph import own_domain
from tapping_cell.nodes.connection_check import ConnectionCheck
from tapping_cell.nodes.planner.tap_planner import TapPlanner

PROFILES = [
    QoSProfile(depth=1, reliability=reliability, durability=durability)
    for reliability in (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)
    for durability in (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL)
]
PROFILES += [QoSProfile(depth=1, deadline=Duration(seconds=2))]
PROFILES += [QoSProfile(depth=1, liveliness_lease_duration=Duration(seconds=2))]
LATCHED, BEST_EFFORT, RELIABLE = PROFILES[1], PROFILES[2], PROFILES[0]


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    domain = own_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain.number))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    yield
    rclpy.try_shutdown()


def wait(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_exactly_the_endpoints_that_do_not_connect_are_reported(ros: None) -> None:
    """The expected result follows from the middleware's count of the subscriptions that are
    connected to a publisher."""
    other, own = rclpy.create_node("other"), rclpy.create_node("own")
    pairs = [*enumerate(itertools.product(PROFILES, PROFILES))]
    publishers = {
        f"/topic_{number}": other.create_publisher(Bool, f"topic_{number}", offered)
        for number, (offered, _) in pairs
    }
    for number, (_, requested) in pairs:
        own.create_subscription(Bool, f"topic_{number}", lambda _: None, requested)
    wait(lambda: all(len(own.get_publishers_info_by_topic(topic)) == 1 for topic in publishers))
    apart = {t for t in publishers if not publishers[t].get_subscription_count()}
    check = ConnectionCheck(own)
    sentences = list(check.new_mismatches())
    assert 0 < len(apart) < len(publishers)
    assert {sentence.split()[4] for sentence in sentences} == apart
    assert not list(check.new_mismatches()), "reported twice"
    # The publishers' side reports the same mismatches.
    found = list(ConnectionCheck(other).new_mismatches())
    assert {sentence.split()[2] for sentence in found} == apart
    for node in (other, own):
        node.destroy_node()


CASES: list[tuple[Callable[[Node], Any], str]] = [
    (
        lambda probe: probe.create_publisher(ObjectStates, "object_states", BEST_EFFORT),
        "nothing is received on /object_states from the node /probe: the QoS profiles are "
        "incompatible (best effort publisher and reliable subscription, volatile publisher and "
        "transient local subscription)",
    ),
    (
        lambda probe: probe.create_subscription(String, "markers", lambda _: None, RELIABLE),
        "nothing on /markers reaches the node /probe: the publisher has the type "
        "visualization_msgs/msg/MarkerArray, but the subscription has std_msgs/msg/String",
    ),
    # No message is expected in the following cases. The planner has several subscriptions on each
    # of the topics goal_pose and emergency_stop, and at least one of them is compatible. A
    # best-effort subscription to plan_state is compatible with the planner's reliable publisher.
    (lambda probe: probe.create_publisher(PoseStamped, "goal_pose", BEST_EFFORT), ""),
    (lambda probe: probe.create_publisher(PoseStamped, "goal_pose", RELIABLE), ""),
    (lambda probe: probe.create_publisher(Bool, "emergency_stop", RELIABLE), ""),
    (lambda probe: probe.create_publisher(Bool, "emergency_stop", LATCHED), ""),
    (lambda probe: probe.create_publisher(Bool, "emergency_stop", BEST_EFFORT), ""),
    (
        lambda probe: probe.create_subscription(
            PlanState, "plan_state", lambda _: None, BEST_EFFORT
        ),
        "",
    ),
]


def test_the_planner_reports_unconnected_endpoints_without_extra_events(ros: None) -> None:
    planner = TapPlanner()
    assert not [each for each in planner.waitables if isinstance(each, EventHandler)]
    # One participant cannot use two types on one topic, so the probe has its own context, like
    # another process.
    with rclpy.context.Context() as context:
        probe = rclpy.create_node("probe", context=context)
        endpoints = [make(probe) for make, _ in CASES]
        for endpoint in endpoints:
            wait(lambda topic=endpoint.topic_name: _has_endpoint(planner, topic))
        sentences = list(ConnectionCheck(planner).new_mismatches())
        probe.destroy_node()
    planner.cleanup()
    planner.destroy_node()
    assert set(sentences) == {sentence for _, sentence in CASES if sentence}


def _has_endpoint(node: Node, topic: str) -> bool:
    """Return whether ``node`` has discovered the probe's endpoint."""
    infos = (
        *node.get_publishers_info_by_topic(topic),
        *node.get_subscriptions_info_by_topic(topic),
    )
    return any(info.node_name == "probe" for info in infos)
