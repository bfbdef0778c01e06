"""A client in a ROS domain without a cell answers as soon as discovery has had its time."""

from __future__ import annotations

import math

import pytest
from rich.console import Console

from tapping_cell.cli import session
from tapping_cell.nodes.clients.cell_client import CellClient, NoCell
from tapping_cell.nodes.clients.client_node import ClientNode
from tapping_cell.nodes.clients.goal_client import GoalClient

ANSWER = "no cell answers in ROS domain"


def sees(monkeypatch: pytest.MonkeyPatch, client: ClientNode, *others: str) -> None:
    """Make the client discover these nodes only, although the tests of a process share a domain."""
    own = (client.node.get_name(), client.node.get_namespace())
    found = [own, *((name, "/") for name in others)]
    monkeypatch.setattr(client.node, "get_node_names_and_namespaces", lambda: found)


def test_an_endless_wait_for_a_cell_ends_if_there_is_no_node(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with CellClient() as client, pytest.raises(NoCell, match=ANSWER):
        sees(monkeypatch, client, "_ros2cli_daemon_0")
        client.wait_for_cell(math.inf)


def test_a_goal_is_refused_if_there_is_no_node(monkeypatch: pytest.MonkeyPatch) -> None:
    with GoalClient("goal") as client:
        sees(monkeypatch, client)
        with pytest.raises(session.NotReadyInTime, match=ANSWER):
            session.wait_for_planner(client, None, Console(quiet=True))


def test_a_client_with_another_node_keeps_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    with GoalClient("goal") as client:
        sees(monkeypatch, client, "starting")
        with pytest.raises(session.NotReadyInTime, match="not ready after 2 s"):
            session.wait_for(
                lambda: ["it starts"],
                2.0,
                lambda: session.refuse_empty_domain(client),
                Console(quiet=True),
            )
