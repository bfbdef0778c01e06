"""A client in a ROS domain without a cell answers as soon as discovery has had its time."""

from __future__ import annotations

import math

import pytest
from rclpy.node import Node
from rich.console import Console

from tapping_cell.cli import session
from tapping_cell.nodes.clients.cell_client import CellClient, NoCell
from tapping_cell.nodes.clients.goal_client import GoalClient

ANSWER = "no cell answers in ROS domain"


def test_an_endless_wait_for_a_cell_ends_if_there_is_no_node() -> None:
    with CellClient() as client, pytest.raises(NoCell, match=ANSWER):
        client.wait_for_cell(math.inf)


def test_a_goal_is_refused_if_there_is_no_node() -> None:
    with GoalClient("goal") as client, pytest.raises(session.NotReadyInTime, match=ANSWER):
        session.wait_for_planner(client, None, Console(quiet=True))


def test_a_client_with_another_node_is_not_alone() -> None:
    with GoalClient("goal") as client:
        other = Node("starting", context=client.node.context)
        with pytest.raises(session.NotReadyInTime, match="not ready after 2 s"):
            session.wait_for(
                lambda: ["it starts"],
                2.0,
                lambda: session.refuse_empty_domain(client),
                Console(quiet=True),
            )
        other.destroy_node()
