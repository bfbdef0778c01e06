"""A cell of separate processes with an object on the table for which no node has a file."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from rich.console import Console
from tapping_cell_msgs.msg import ErrorCode, ObjectContact, ObjectStates
from yaml import safe_dump, safe_load

from tapping_cell.cli import session
from tapping_cell.cli.graph import SIMULATED, Graph
from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.goal_client import Finished, GoalClient
from tapping_cell.se2 import Pose

START, BETWEEN, GOAL = Pose(-0.17, 0.02, 0.0), Pose(0.0, 0.0, 0.4), Pose(0.17, 0.0, 0.3)
TIMEOUT_S = 240.0


def outcome(client: GoalClient, graph: Graph, goal: Pose) -> Finished:
    client.send(goal, (0.0, 0.0))
    deadline = time.monotonic() + TIMEOUT_S
    for event in client.events():
        graph.check()
        assert time.monotonic() < deadline
        if isinstance(event, Finished):
            return event
    raise AssertionError("the goal has no end")


@pytest.mark.timeout(2 * TIMEOUT_S + 180)
def test_an_object_without_a_file_is_detected_and_avoided(tmp_path: Path) -> None:
    truth = safe_load((shared_folder() / "truth" / "default.yaml").read_text())
    truth["object_start"], truth["further_starts"] = [*START], [[*BETWEEN]]
    truth["camera"] = {**truth.get("camera", {}), "shows_arm": True}
    (tmp_path / "truth.yaml").write_text(safe_dump(truth))
    parameters: dict[str, dict[str, object]] = {
        "sim_world": {
            "arm_port": tmp_path / "arm",
            "tapper_port": tmp_path / "tapper",
            "seed": 6,
            "truth_file": tmp_path / "truth.yaml",
            # Only the simulated world knows this object.
            "other_object_files": shared_folder() / "objects" / "plain_disk_with_dot.yaml",
        },
        "scara_arm": {"port": tmp_path / "arm", "home_on_activate": True},
        "tapper_trigger": {"port": tmp_path / "tapper"},
    }
    with (
        Graph(SIMULATED, parameters, tmp_path / "logs", {"HOME": str(tmp_path)}) as graph,
        GoalClient() as client,
    ):
        states: list[ObjectStates] = []
        contacts: list[ObjectContact] = []
        client.node.create_subscription(ObjectStates, "object_states", states.append, LATCHED)
        client.node.create_subscription(ObjectContact, "true_contacts", contacts.append, 10)
        session.wait_until_ready(client, 120.0, graph.check, Console(quiet=True))
        refused = outcome(client, graph, Pose(0.02, 0.01, 0.0))
        reached = outcome(client, graph, GOAL)
    assert refused.error_code == ErrorCode.GOAL_IN_KEEP_OUT
    assert "unknown object at x" in refused.error_msg
    assert reached.error_code == ErrorCode.NONE, reached.error_msg
    assert contacts == []
    searched = [state for state in states if state.unknown_searched_at.sec]
    assert len(searched) > 1
    for state in searched:
        assert len(state.unknown_objects) == 1
        for axis, place in (("x", BETWEEN.x), ("y", BETWEEN.y)):
            values = [getattr(point, axis) for point in state.unknown_objects[0].points]
            assert abs((min(values) + max(values)) / 2 - place) < 0.006
