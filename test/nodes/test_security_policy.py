"""The SROS 2 policy grants each node exactly the topics, services and actions that it opens."""

from __future__ import annotations

import fnmatch
import importlib
import importlib.util
import os
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import rclpy

from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes import MODULES, security
from tapping_cell.nodes.cell_node import CellNode
from tapping_cell.nodes.clients.cell_client import CellClient
from tapping_cell.nodes.clients.goal_client import GoalClient

FOLDER = shared_folder() / "security"
SERVED = ("send_goal", "get_result", "cancel_goal")
SENT = ("feedback", "status")
DISCOVERY_S = 60.0

OPENED_LATER: dict[str, dict[str, set[str]]] = {
    # The first is opened only with image_transport:=compressed, the others only when the node is
    # configured to search for unknown objects in a cell with an arm.
    "camera_pose": {"subscribe": {"/camera/image_raw/compressed", "/arm_state", "/joint_states"}},
    # Opened only while a browser shows the page.
    "operator_page": {
        "subscribe": {
            "/arm_state",
            "/arrangement_state",
            "/camera/camera_info",
            "/camera/image_annotated",
            "/camera/pose",
            "/diagnostics",
            "/object_states",
            "/tapper_state",
            "/unknown_objects",
        },
        "request": {f"/{name}/get_state" for name in MODULES},
    },
    # Opened only for nodes that the client finds.
    "cell_client": {"request": {f"/{name}/get_state" for name in MODULES}},
}

OPENED_WITH_OTHER_PACKAGES: dict[str, dict[str, set[str]]] = {
    "scara_arm": {"publish": {"/tf", "/tf_static"}},
    "camera_pose": {"publish": {"/tf", "/tf_static", "/detections"}},
    "tap_planner": {"subscribe": {"/tf", "/tf_static"}},
}

Endpoints = dict[str, set[str]]


def granted() -> dict[str, Endpoints]:
    """Return the granted names by node and kind."""
    found: dict[str, Endpoints] = {}
    for enclave in ElementTree.parse(FOLDER / "cell.policy.xml").iter("enclave"):
        (profile,) = enclave.iter("profile")
        node = profile.attrib["node"]
        expected = "operator" if node == "goal" else node
        assert enclave.attrib["path"] == security.enclave_of(expected)
        rules: Endpoints = defaultdict(set)
        for part in profile:
            included = part.tag.endswith("}include")
            group = (
                ElementTree.parse(FOLDER / part.attrib["href"]).getroot() if included else [part]
            )
            for rule in group:
                for kind, verdict in rule.attrib.items():
                    assert verdict == "ALLOW"
                    for entry in rule:
                        _grant(rules, kind, _full(entry.text or "", node))
        found[node] = rules
    return found


def _full(name: str, node: str) -> str:
    return name if name.startswith("/") else "/" + name.replace("~", node)


def _grant(rules: Endpoints, kind: str, name: str) -> None:
    if kind not in ("execute", "call"):
        rules[kind].add(name)
        return
    topics, services = ("publish", "reply") if kind == "execute" else ("subscribe", "request")
    rules[topics] |= {f"{name}/_action/{part}" for part in SENT}
    rules[services] |= {f"{name}/_action/{part}" for part in SERVED}


def opened(node: Any, name: str, expected: Endpoints) -> Endpoints:
    """Return what a node has opened in the running middleware.

    The middleware lists an endpoint shortly after it was created. Therefore, this function waits
    until all expected endpoints are listed, for at most ``DISCOVERY_S``.
    """
    end = time.monotonic() + DISCOVERY_S
    while True:
        found = _opened_now(node, name)
        missing = any(expected.get(kind, set()) - names for kind, names in found.items())
        if not missing or time.monotonic() > end:
            return found
        time.sleep(0.05)


def _opened_now(node: Any, name: str) -> Endpoints:
    asked = {
        "publish": node.get_publisher_names_and_types_by_node,
        "subscribe": node.get_subscriber_names_and_types_by_node,
        "reply": node.get_service_names_and_types_by_node,
        "request": node.get_client_names_and_types_by_node,
    }
    return {kind: {found for found, _ in ask(name, "/")} for kind, ask in asked.items()}


def node_class(name: str) -> type[CellNode[Any]]:
    module = importlib.import_module(MODULES[name])
    wanted = name.replace("_", "")
    (found,) = (
        kind
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, CellNode) and kind.__name__.lower() == wanted
    )
    return found


@pytest.mark.parametrize("name", [*MODULES, "goal", "cell_client"])
def test_a_node_is_granted_only_what_it_opens(name: str, own_graph: None) -> None:
    rules, later = granted()[name], OPENED_LATER.get(name, {})
    if importlib.util.find_spec("tf2_ros") is None:
        later = {**later, **OPENED_WITH_OTHER_PACKAGES.get(name, {})}
    expected = {kind: names - later.get(kind, set()) for kind, names in rules.items()}
    if name == "goal":
        with GoalClient("goal") as client:
            real = opened(client.node, "goal", expected)
    elif name == "cell_client":
        with CellClient() as watching:
            real = opened(watching.node, name, expected)
    else:
        rclpy.init(args=["--ros-args", "-p", "autostart:=false"])
        node = node_class(name)()
        try:
            real = opened(node, name, expected)
        finally:
            node.cleanup()
            node.destroy_node()
            rclpy.try_shutdown()
    for kind, names in real.items():
        assert names <= rules[kind], f"{name} may not {kind} {sorted(names - rules[kind])}"
        needless = expected.get(kind, set()) - names
        assert not needless, f"{name} is granted to {kind} {sorted(needless)} and does not"


@pytest.mark.parametrize(
    ("topic", "publishers"),
    [
        ("/tap_command", {"tap_planner"}),
        ("/plan_state", {"tap_planner"}),
        ("/object_states", {"camera_pose"}),
        ("/arm_state", {"scara_arm"}),
        ("/tapper_state", {"tapper_trigger"}),
        ("/camera/image_raw", {"overhead_camera", "sim_world"}),
        ("/emergency_stop", {"operator_page_stop"}),
        ("/enabling", {"operator_page"}),
        ("/tf", {"scara_arm", "camera_pose"}),
        ("/tf_static", {"scara_arm", "camera_pose"}),
        ("/goal_pose", set()),
        ("/joint_trajectory", set()),
        ("/clock", set()),
    ],
)
def test_only_its_owner_may_publish_a_topic(topic: str, publishers: set[str]) -> None:
    assert {name for name, rules in granted().items() if topic in rules["publish"]} == publishers


def test_a_middleware_without_security_is_refused_with_a_message(tmp_path: Path) -> None:
    (tmp_path / "enclaves" / "tapping_cell" / "tap_planner").mkdir(parents=True)
    environment = {
        **os.environ,
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(tmp_path),
    }
    for enclave, words in (
        ("/tapping_cell/tap_planner", ("ROS_SECURITY_ENABLE is true",)),
        ("/nowhere", ("keys cannot be used", "enclaves/nowhere", "ROS_SECURITY_KEYSTORE")),
    ):
        command = [sys.executable, "-m", MODULES["tap_planner"], "--ros-args", "--enclave", enclave]
        ended = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=150, check=False
        )
        assert ended.returncode == 1
        assert "Traceback" not in ended.stderr
        assert all(word in ended.stderr for word in words), ended.stderr


def test_the_sros2_permissions_deny_what_the_policy_does_not_grant(
    tmp_path: Path,
) -> None:
    """The permissions are evaluated as DDS Security specifies: what no rule allows is denied."""
    generation = pytest.importorskip("sros2.api._artifact_generation")
    generation.generate_artifacts(tmp_path, [], [FOLDER / "cell.policy.xml"])
    folder = tmp_path / "enclaves" / "tapping_cell"
    rules = granted()
    assert {path.name for path in folder.iterdir()} == {
        security.enclave_of("operator" if node == "goal" else node).rpartition("/")[2]
        for node in rules
    }
    topics = {topic for each in rules.values() for topic in each["publish"] | each["subscribe"]}
    for enclave in folder.iterdir():
        grant = ElementTree.parse(enclave / "permissions.xml").getroot().find("permissions/grant")
        assert grant is not None
        assert grant.findtext("default") == "DENY"
        assert grant.findtext("subject_name") == f"CN={security.enclave_of(enclave.name)}"
        node = "goal" if enclave.name == "operator" else enclave.name
        for kind in ("publish", "subscribe"):
            allowed = [
                entry.text or "" for entry in grant.iterfind(f"allow_rule/{kind}/topics/topic")
            ]
            passed = {
                topic
                for topic in topics
                if any(fnmatch.fnmatchcase(f"rt{topic}", pattern) for pattern in allowed)
            }
            assert passed == rules[node][kind], f"{enclave.name}, {kind}"
    governance = ElementTree.parse(tmp_path / "enclaves" / "governance.xml").getroot()
    for key, value in (
        ("allow_unauthenticated_participants", "false"),
        ("enable_join_access_control", "true"),
        ("enable_read_access_control", "true"),
        ("enable_write_access_control", "true"),
    ):
        assert {entry.text for entry in governance.iter(key)} == {value}


def test_only_the_planner_subscribes_to_goals() -> None:
    """``ros2 topic pub --once`` publishes and ends as soon as a single subscription is connected.
    If another node subscribed to goals, the planner could miss the goal."""
    subscribers = {name for name, rules in granted().items() if "/goal_pose" in rules["subscribe"]}
    assert subscribers == {"tap_planner"}
