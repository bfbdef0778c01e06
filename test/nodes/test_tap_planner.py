"""The planning node over DDS: its topics, its stored goal, and its shutdown.

The node's decisions are tested in virtual time
(``test/pure/logic/test_planner_with_played_devices.py``).
"""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from harness import TIMEOUT_S, Bench, bench
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile
from tapping_cell_msgs.msg import (
    ArmState,
    GoalReport,
    ObjectState,
    ObjectStates,
    PlanState,
    TapCommand,
    TapperState,
)

from tapping_cell import messages
from tapping_cell.durable_file import part_of
from tapping_cell.logic.effects import KeepGoal, Publish
from tapping_cell.logic.poses import covariance_to_message
from tapping_cell.nodes.cell_node import BEST_EFFORT_COMMAND, COMMAND, LATCHED
from tapping_cell.nodes.conversions import from_message, to_message
from tapping_cell.nodes.kept_content import BOOT
from tapping_cell.nodes.planner.tap_planner import TapPlanner
from tapping_cell.se2 import Pose

START = Pose(-0.05, 0.02, 0.2)
GOAL = Pose(-0.03, 0.02, 0.25)
FAST = {
    "ready_deadline": 5.0,
    "observe_deadline": 4.0,
    "place_deadline": 4.0,
    "fire_deadline": 4.0,
    "withdraw_deadline": 4.0,
    "silence_limit": 4.0,
}
"""Time limits that are shorter than in a real cell, so that missing messages are detected soon. The
limits are long enough for a busy machine, because the simulated devices publish every 30 ms."""


@dataclass
class Actors:
    """Simulated camera, arm and tapper. Each device behaves normally unless a test changes its
    behaviour."""

    bench: Bench
    pose: Pose = START
    moves_when_fired: bool = True
    lost_when_fired: bool = False
    visible: bool = True
    at_rest: bool = True
    camera_active: bool = True
    arm_active: bool = True
    arm_arrives: bool = True
    arm_withdraws: bool = True
    arm_state: int = ArmState.IDLE
    arm_error: tuple[int, str] = (0, "")
    tapper_answers: int | None = TapperState.FIRED
    tapper_active: bool = True
    references: tuple[int, ...] = tuple(range(101, 109))
    others: Callable[[Time], list[ObjectState]] = lambda stamp: []
    commands: list[TapCommand] = field(default_factory=list)
    plans: list[PlanState] = field(default_factory=list)
    _tap: TapCommand | None = None
    _outcome: int = TapperState.NONE

    def __post_init__(self) -> None:
        node = self.bench.probe
        assert node is not None
        self._node = node
        self._lock = threading.Lock()
        self._object = node.create_publisher(ObjectStates, "object_states", LATCHED)
        self._arm = node.create_publisher(ArmState, "arm_state", LATCHED)
        self._tapper = node.create_publisher(TapperState, "tapper_state", LATCHED)
        self.goals = node.create_publisher(PoseStamped, "goal_pose", COMMAND)
        node.create_subscription(TapCommand, "tap_command", self._on_command, COMMAND)
        self.plans = self.bench.listen(PlanState, "plan_state", LATCHED)
        node.create_timer(0.03, self._publish)

    def _on_command(self, command: TapCommand) -> None:
        with self._lock:
            self.commands.append(command)
            if command.request == TapCommand.TAP:
                self._tap, self._outcome = command, TapperState.NONE
                self.arm_state = ArmState.IN_POSITION if self.arm_arrives else ArmState.MOVING
                if self.arm_arrives and self.tapper_answers is not None:
                    self._outcome = self.tapper_answers
                    fired = self.tapper_answers != TapperState.NOT_FIRED
                    if fired and self.moves_when_fired:
                        self.pose = from_message(command.predicted_pose)
                    # Hide the object immediately: otherwise an image after the tap would still show
                    # it.
                    self.visible = self.visible and not (fired and self.lost_when_fired)
            elif self.arm_withdraws:
                self.arm_state = ArmState.IDLE

    def _publish(self) -> None:
        with self._lock:
            now = self._node.get_clock().now().to_msg()
            tap_id = self._tap.tap_id if self._tap is not None else 0
            if self.camera_active:
                seen = ObjectState(
                    visible=self.visible,
                    at_rest=self.at_rest,
                    frames_fused=30,
                    object_id="aluminium disk",
                )
                seen.header.stamp, seen.header.frame_id = now, "table"
                seen.pose.pose = to_message(self.pose)
                seen.references_used = list(self.references)
                seen.pose.covariance = covariance_to_message(np.diag([1e-10, 1e-10, 1e-8]))
                objects = [seen, *self.others(now)]
                self._object.publish(ObjectStates(header=seen.header, objects=objects))
            if self.arm_active:
                code, sentence = self.arm_error
                idle = self.arm_state == ArmState.IDLE
                arm = ArmState(
                    state=self.arm_state,
                    tap_id=0 if idle else tap_id,
                    homed=True,
                    clear_of_camera=idle,
                    error_code=code,
                    error_msg=sentence,
                )
                arm.header.stamp = now
                self._arm.publish(arm)
            if self.tapper_active:
                self._tapper.publish(
                    TapperState(
                        state=TapperState.SAFE,
                        tap_id=tap_id,
                        outcome=self._outcome,
                        interlock_closed=True,
                    )
                )

    def send(self, goal: Pose = GOAL) -> None:
        self.bench.wait(
            lambda: self.plans and self.goals.get_subscription_count() == 2, "the planner is up"
        )
        time.sleep(0.3)
        message = PoseStamped(pose=to_message(goal))
        message.header.frame_id = "table"
        self.goals.publish(message)

    def end(self, patience: float = TIMEOUT_S) -> PlanState:
        final = (PlanState.REACHED, PlanState.FAILED)
        self.bench.wait(lambda: self.plans[-1].state in final, "the goal's end", patience)
        return self.plans[-1]

    def taps(self) -> list[TapCommand]:
        return [command for command in self.commands if command.request == TapCommand.TAP]


@contextmanager
def acted(**parameters: object) -> Iterator[Actors]:
    with bench(lambda: [TapPlanner()], {"tap_planner": {**FAST, **parameters}}) as b:
        yield Actors(b)


@pytest.fixture
def actors() -> Iterator[Actors]:
    with acted() as made:
        yield made


def test_a_planner_that_has_ended_serves_nothing() -> None:
    # If services of a planner stayed visible after its end, new clients would wait for this
    # planner's action server.
    context = Context()
    rclpy.init(context=context)
    watcher = Node("watcher", context=context)
    service = "/position_object/_action/send_goal"
    gc.disable()  # garbage collection could remove such services at any time and hide the defect
    try:
        with acted() as actors:
            actors.bench.wait(lambda: watcher.count_services(service) == 1, "the planner")
            ended = actors.bench
        ended.wait(lambda: watcher.count_services(service) == 0, "the planner's end")
    finally:
        gc.enable()
        watcher.destroy_node()
        context.try_shutdown()


def test_the_goal_is_reached_with_working_devices(actors: Actors) -> None:
    actors.send()
    end = actors.end()
    assert end.state == PlanState.REACHED, end.error_msg
    assert end.taps == len(actors.taps()) >= 1
    # A withdrawal ends each tap. After the last tap, a second withdrawal parks the arm. The ids
    # increase.
    ids = [command.tap_id for command in actors.taps()]
    assert ids == sorted(set(ids))
    ended = [c.tap_id for c in actors.commands if c.request == TapCommand.WITHDRAW]
    assert ended == [*ids, ids[-1]]


@pytest.mark.parametrize("profile", [COMMAND, BEST_EFFORT_COMMAND], ids=["reliable", "best effort"])
def test_a_goal_of_any_publisher_is_accepted_once(actors: Actors, profile: QoSProfile) -> None:
    probe = actors.bench.probe
    assert probe is not None
    reports = actors.bench.listen(GoalReport, "goal_report", LATCHED)
    probe.destroy_publisher(actors.goals)
    actors.goals = probe.create_publisher(PoseStamped, "goal_pose", profile)
    subscribers = 2 if profile is COMMAND else 1
    actors.bench.wait(
        lambda: actors.plans and actors.goals.get_subscription_count() == subscribers, "the planner"
    )
    time.sleep(0.3)
    message = PoseStamped(pose=to_message(GOAL))
    message.header.frame_id = "table"
    actors.goals.publish(message)
    assert actors.end().state == PlanState.REACHED
    actors.bench.wait(lambda: reports, "the report")
    time.sleep(0.3)
    assert len(reports) == 1, [report.error_msg for report in reports]


def test_an_active_goal_is_stored_for_crash_recovery_and_deleted_at_its_end(tmp_path: Path) -> None:
    with acted() as made:
        made.arm_arrives = False
        made.send()
        made.bench.wait(made.taps, "a tap")
        (kept,) = (tmp_path / ".ros" / "tapping_cell").glob("domain*/goal.json")
        assert json.loads(kept.read_text())["goal"] == pytest.approx(list(GOAL))
        made.end()
        assert not kept.exists()


@pytest.mark.parametrize("restarted", [False, True], ids=["crash", "restart of the computer"])
def test_a_goal_is_resumed_after_a_crash_but_not_after_a_restart_of_the_computer(
    tmp_path: Path, restarted: bool
) -> None:
    with acted() as made:
        made.arm_arrives = False
        made.send()
        made.bench.wait(made.taps, "a tap")
        (kept,) = (tmp_path / ".ros" / "tapping_cell").glob("domain*/goal.json")
        content = json.loads(kept.read_text())
        made.end()
    if restarted:
        content[BOOT] = "an earlier one"
    kept.write_text(json.dumps(content))
    with acted() as made:
        if restarted:
            made.bench.wait(lambda: made.plans, "the planner")
            time.sleep(2.0)
            assert all(plan.state == PlanState.IDLE for plan in made.plans) and not made.taps()
            assert not kept.exists()
        else:
            made.bench.wait(made.taps, "a tap of the resumed goal")
            made.end()


def test_a_stored_goal_that_cannot_be_updated_is_deleted(tmp_path: Path) -> None:
    with acted() as made:
        made.arm_active = False
        made.send()
        folder = tmp_path / ".ros" / "tapping_cell"
        made.bench.wait(lambda: list(folder.glob("domain*/goal.json")), "the stored goal")
        (kept,) = folder.glob("domain*/goal.json")
        part_of(kept).mkdir()  # no new content can be written
        made.arm_active = True
        made.bench.wait(made.taps, "a tap")
        assert not kept.exists(), "a restart would resume the goal with an old number of taps"
        made.end()


@contextmanager
def planner_process(home: Path) -> Iterator[subprocess.Popen[str]]:
    """Run the planner in a process of its own, whose home is ``home``."""
    command = [sys.executable, "-m", "tapping_cell.nodes.planner.tap_planner"]
    options = ["--ros-args", "-p", "ready_deadline:=120.0"]
    with subprocess.Popen(
        [*command, *options],
        env={**os.environ, "HOME": str(home)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=["SIGTERM", "SIGINT"])
def test_an_orderly_shutdown_during_a_goal_ends_the_goal(
    number: signal.Signals, tmp_path: Path
) -> None:
    def kept() -> list[Path]:
        return list((tmp_path / ".ros" / "tapping_cell").glob("domain*/goal.json"))

    with bench(lambda: [], {}) as b:
        actors = Actors(b)
        actors.arm_arrives = False
        with planner_process(tmp_path) as planner:
            actors.send()
            b.wait(actors.taps, "a tap")
            assert kept()
            planner.send_signal(number)
            output, _ = planner.communicate(timeout=TIMEOUT_S)
        assert (planner.returncode, "Traceback" in output) == (0, False), output
        assert not kept()
        before = len(actors.plans)
        with planner_process(tmp_path) as planner:
            b.wait(lambda: len(actors.plans) > before + 4, "several reports of the next planner")
            planner.send_signal(number)
            output, _ = planner.communicate(timeout=TIMEOUT_S)
        assert {plan.state for plan in actors.plans[before:]} == {PlanState.IDLE}, output
        assert "resuming" not in output


def test_an_effect_that_fails_does_not_drop_the_effects_after_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(effect: Publish) -> None:
        raise KeyboardInterrupt  # a signal may arrive while a message is published

    with bench(lambda: [], {}):
        planner = TapPlanner()
        monkeypatch.setattr(planner.host, "_publish", fail)
        made = [Publish("plan_state", messages.PlanState()), KeepGoal({"goal": [0, 0, 0]})]
        monkeypatch.setattr(planner.logic, "on_message", lambda *_: made)
        with pytest.raises(KeyboardInterrupt):
            planner.host.receive("arm_state", messages.ArmState())
        assert planner.host.goal_file.recall() == {"goal": [0, 0, 0]}
        planner.destroy_node()
