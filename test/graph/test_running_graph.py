"""The complete graph as processes, used through its topics and its action as a client would.

Second goals, objects moved by hand and frozen nodes are tested in virtual time
(``test/pure/verification/test_scenarios.py``).
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rich.console import Console
from std_msgs.msg import Bool
from tapping_cell_msgs.msg import (
    ArmState,
    ErrorCode,
    PlanState,
    TapCommand,
    TapperState,
)
from tapping_cell_msgs.srv import ResetWorld

from tapping_cell.cli import session
from tapping_cell.cli.graph import SIMULATED, Graph
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.clients.goal_client import Finished, GoalClient
from tapping_cell.nodes.conversions import seconds, to_message
from tapping_cell.se2 import Pose


@dataclass
class Cell:
    """A running cell and its client."""

    graph: Graph
    client: GoalClient
    plans: list[PlanState]
    commands: list[TapCommand]

    def __post_init__(self) -> None:
        node = self.client.node
        self.goals = node.create_publisher(PoseStamped, "goal_pose", COMMAND)
        self.stop = node.create_publisher(Bool, "emergency_stop", LATCHED)
        self.reset = node.create_client(ResetWorld, "reset_world")

    def wait(self, condition: object, what: str, patience: float = 60.0) -> None:
        deadline = time.monotonic() + patience
        while not condition():  # type: ignore[operator]
            self.graph.check()
            assert time.monotonic() < deadline, f"waited {patience:.0f} s in vain: {what}"
            time.sleep(0.02)

    def ready(self) -> None:
        session.wait_until_ready(self.client, 120.0, self.graph.check, Console(quiet=True))

    def place(self, pose: Pose) -> None:
        request = ResetWorld.Request(object_pose=to_message(pose))
        future = self.reset.call_async(request)
        self.wait(future.done, "reset_world")
        assert future.result().success, future.result().message
        self.ready()

    def publish_goal(self, pose: Pose, frame: str = "table") -> None:
        message = PoseStamped(pose=to_message(pose))
        message.header.frame_id = frame
        self.goals.publish(message)

    def run_action(self, goal: Pose, tolerance: tuple[float, float] = (0.0, 0.0)) -> Finished:
        self.client.send(goal, tolerance)
        deadline = time.monotonic() + 150
        for event in self.client.events():
            self.graph.check()
            assert time.monotonic() < deadline
            if isinstance(event, Finished):
                return event
        raise AssertionError("the goal has no end")


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    folder = tmp_path_factory.mktemp("cell")
    parameters: dict[str, dict[str, object]] = {
        "sim_world": {"arm_port": folder / "arm", "tapper_port": folder / "tapper", "seed": 4},
        "scara_arm": {"port": folder / "arm", "home_on_activate": True},
        "tapper_trigger": {"port": folder / "tapper"},
    }
    with (
        Graph(SIMULATED, parameters, folder / "logs", {"HOME": str(folder)}) as graph,
        GoalClient() as client,
    ):
        plans: list[PlanState] = []
        commands: list[TapCommand] = []
        client.node.create_subscription(PlanState, "plan_state", plans.append, LATCHED)
        client.node.create_subscription(TapCommand, "tap_command", commands.append, COMMAND)
        made = Cell(graph, client, plans, commands)
        made.ready()
        made.wait(lambda: made.goals.get_subscription_count() == 2, "the planner listens")
        yield made


def test_the_graph_has_the_names_of_the_design(cell: Cell) -> None:
    nodes = {name for name, _ in cell.client.node.get_node_names_and_namespaces()}
    assert set(SIMULATED) <= nodes
    topics = {name for name, _ in cell.client.node.get_topic_names_and_types()}
    assert {
        "/arm_state",
        "/camera/camera_info",
        "/camera/image_annotated",
        "/camera/image_raw",
        "/diagnostics",
        "/emergency_stop",
        "/goal_pose",
        "/ground_truth",
        "/joint_states",
        "/joint_trajectory",
        "/markers",
        "/object_pose",
        "/object_state",
        "/plan_state",
        "/tap_command",
        "/tapper_state",
    } <= topics


@pytest.mark.parametrize(
    ("pose", "frame", "code"),
    [
        (Pose(math.nan, 0.0, 0.0), "table", ErrorCode.GOAL_NOT_FINITE),
        (Pose(0.0, 0.0, 0.0), "map", ErrorCode.GOAL_WRONG_FRAME),
        (Pose(0.6, 0.0, 0.0), "table", ErrorCode.GOAL_OFF_TABLE),
    ],
    ids=["NaN", "frame", "off the table"],
)
def test_an_invalid_goal_on_the_topic_is_refused_with_a_message_and_moves_nothing(
    cell: Cell, pose: Pose, frame: str, code: int
) -> None:
    received, commanded = len(cell.plans), len(cell.commands)
    cell.publish_goal(pose, frame)
    cell.wait(lambda: any(plan.error_code == code for plan in cell.plans[received:]), str(code))
    refused = next(plan for plan in cell.plans[received:] if plan.error_code == code)
    assert len(refused.error_msg) > 30
    time.sleep(0.5)
    assert len(cell.commands) == commanded


def test_every_image_arrives_at_the_pose_node(cell: Cell) -> None:
    """The default transport of DDS loses best-effort images of 1.3 MB; the transport profile of
    this repository does not."""
    counts: dict[str, list[tuple[float, int]]] = {"/sim_world": [], "/camera_pose": []}

    def count(message: DiagnosticArray) -> None:
        for status in message.status:
            values = {entry.key: entry.value for entry in status.values}
            if status.name in counts:
                at = seconds(message.header.stamp)
                counts[status.name].append((at, int(values["pictures"])))

    subscription = cell.client.node.create_subscription(DiagnosticArray, "/diagnostics", count, 10)

    def since_start(node: str) -> int:
        return counts[node][-1][1] - counts[node][0][1] if counts[node] else 0

    # On a slow machine the simulated world sends fewer images per second, so wait until enough
    # images have been sent.
    deadline = time.monotonic() + 120.0
    time.sleep(8.0)
    while since_start("/sim_world") <= 150 or len(counts["/camera_pose"]) < 6:
        assert time.monotonic() < deadline, counts
        time.sleep(1.0)
    cell.client.node.destroy_subscription(subscription)
    # Compare the counts of sent and of received images, which the two nodes publish at different
    # times. On a busy machine an image can wait in a queue, which increases the difference of the
    # counts for a while. A lost image increases the difference, and also its minimum, permanently.
    times, sent = np.array(counts["/sim_world"]).T
    ahead = [np.interp(at, times, sent) - taken for at, taken in counts["/camera_pose"]]
    assert min(ahead[len(ahead) // 2 :]) - min(ahead) <= 4, counts


def test_an_invalid_action_goal_returns_its_error_code(cell: Cell) -> None:
    finished = cell.run_action(Pose(2.0, 0.0, 0.0))
    assert finished.error_code == ErrorCode.GOAL_OFF_TABLE
    assert "2000.0 mm" in finished.error_msg
    finished = cell.run_action(Pose(0.0, 0.0, 0.0), (-1.0, 0.0))
    assert finished.error_code == ErrorCode.GOAL_BAD_TOLERANCE


def test_canceling_withdraws_the_arm_and_disarms_the_tapper(cell: Cell) -> None:
    cell.place(Pose(-0.05, 0.0, 0.0))
    cell.client.send(Pose(0.05, 0.0, 1.0))
    cell.wait(
        lambda: cell.client.arm_state and cell.client.arm_state.state == ArmState.MOVING,
        "the first tap begins",
    )
    before = cell.client.true_pose
    cell.client.cancel()
    ends = [event for event in cell.client.events() if isinstance(event, Finished)]
    assert ends[0].error_code == ErrorCode.GOAL_CANCELED
    cell.wait(lambda: not cell.client.missing(), "the cell is at rest again")
    assert before is not None and cell.client.true_pose is not None
    assert before.distance_to(cell.client.true_pose) < 1e-6


def test_the_emergency_stop_ends_the_goal_and_latches_every_device(cell: Cell) -> None:
    """This must be the last test of the graph, because the graph stays stopped."""
    cell.place(Pose(-0.05, 0.0, 0.0))
    cell.client.send(Pose(0.05, 0.0, 1.0))
    cell.wait(
        lambda: cell.client.arm_state and cell.client.arm_state.state == ArmState.MOVING,
        "the first tap begins",
    )
    cell.stop.publish(Bool(data=True))
    ends = [event for event in cell.client.events() if isinstance(event, Finished)]
    # The planner reports the code of the stop itself or of the first stopped node, whichever it
    # receives first.
    stopped = (ErrorCode.EMERGENCY_STOP, ErrorCode.ARM_STOPPED, ErrorCode.TAPPER_STOPPED)
    assert ends[0].error_code in stopped
    cell.wait(
        lambda: (
            cell.client.arm_state.state == ArmState.STOPPED
            and cell.client.tapper_state.state == TapperState.STOPPED
        ),
        "both stopped",
    )
    finished = cell.run_action(Pose(0.0, 0.0, 0.0))
    assert finished.error_code == ErrorCode.ARM_STOPPED
    assert "clear the stop" in finished.error_msg
