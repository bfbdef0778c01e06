"""Trials that kill and restart a node at each phase of a tap, and check that the cell recovers
safely.

A simulated cell runs as processes, and a goal is sent. At a chosen phase of a tap, one node
receives ``SIGKILL`` and is restarted. A trial checks the true final pose of the object. A trial
also checks that the object moved only while the arm held the striker in position, and at most once
for each commanded tap.
"""

from __future__ import annotations

import math
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState, PlanState, TapCommand, TapperState
from tapping_cell_msgs.srv import ResetWorld

from tapping_cell.cli.graph import SIMULATED, Graph
from tapping_cell.configuration.cell import load_cell
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.nodes.conversions import from_message, seconds, to_message
from tapping_cell.se2 import Pose

START, GOAL = Pose(-0.05, 0.02, 0.0), Pose(-0.02, 0.01, 0.2)
TOLERANCE = (0.001, math.radians(1.0))
LOW = 0.030
"""Height of the tip in m below which the striker counts as lowered."""
STILL = 2e-4
"""Minimum displacement in m between successive true poses that counts as a motion of the
object."""
SILENCE_MARGIN_S = 0.4
"""A strike is unsafe if it occurs more than this time, in s, after the stamp of the last message in
which the arm reported that it was in position."""
RELEASE_AFTER_SILENCE_S = 0.65
"""Maximum time in s from the last message of the planner or the camera to the release of the
striker. It is the sum of the tapper's ``silence_limit`` (0.45 s), the transmission time of a
message and the firing window."""
STROKE_FACTOR = 1.1
"""Maximum ratio of the striker's time of flight to the time that the striker would need for the
stroke at the commanded speed."""
TIMEOUT_S = 240.0
PHASE_S = 120.0
"""Maximum wait for a phase of a tap."""
DOWN_S = 0.3
"""Time from the kill to the restart."""
WORLD = "sim_world"
PHASES = ("planning", "travelling", "lowered", "drawn", "fired", "withdrawing", "settling")


@dataclass(frozen=True, slots=True)
class Crash:
    """Result of one trial. ``unsafe``: descriptions of all unsafe events."""

    node: str
    phase: str
    ended: str
    """One of ``reached``, ``needed an operator`` and ``hung``."""
    seconds: float
    sentence: str
    unsafe: tuple[str, ...]

    @property
    def clean(self) -> bool:
        """Whether the trial was safe and the goal was reached. If ``sim_world`` was restarted, the
        boards were reset. The trial then also counts as clean if the cell requests an operator."""
        asked = self.ended == "needed an operator" and self.node == WORLD
        return not self.unsafe and (self.ended == "reached" or asked)


@dataclass
class Observed:
    """Recorder of all messages of one trial."""

    plans: deque[PlanState] = field(default_factory=lambda: deque(maxlen=5000))
    commands: list[TapCommand] = field(default_factory=list)
    arm: ArmState = field(default_factory=ArmState)
    tapper: TapperState = field(default_factory=TapperState)
    settled: deque[float] = field(default_factory=lambda: deque(maxlen=20_000))
    """Stamps of the messages that reported the arm in position, s."""
    struck: list[float] = field(default_factory=list)
    """For each motion of the object, the stamp of the first true pose that shows it, s."""
    lain: Pose | None = None
    moving: bool = False
    motions: int = 0
    unsafe: list[str] = field(default_factory=list)
    shots: dict[int, int] = field(default_factory=dict)
    frozen: list[tuple[str, float, float]] = field(default_factory=list)
    """Periods in which a node was stopped: name of the node, begin and end in s."""
    watching: bool = False

    def on_arm(self, message: ArmState) -> None:
        """Process ``arm_state``."""
        self.arm = message
        if message.state == ArmState.IN_POSITION:
            self.settled.append(seconds(message.header.stamp))

    def on_tapper(self, message: TapperState) -> None:
        """Process ``tapper_state``."""
        self.tapper = message
        if self.watching and message.outcome != TapperState.NONE:
            before = self.shots.setdefault(message.tap_id, message.outcome)
            if before != message.outcome and TapperState.UNKNOWN not in (before, message.outcome):
                self.unsafe.append(f"tap {message.tap_id}: {before} and {message.outcome}")

    def on_truth(self, message: PoseStamped) -> None:
        """Process the true pose of the object. A true pose arrives thirty times per second."""
        pose = from_message(message.pose)
        if self.lain is None or not self.watching:
            self.lain = pose
            return
        if pose.distance_to(self.lain) < STILL:
            self.moving = False
        elif not self.moving:
            self.moving = True
            self.motions += 1
            self.struck.append(seconds(message.header.stamp))
        self.lain = pose

    def judge_strikes(self) -> None:
        """Add each strike that was unsafe to the unsafe events.

        A strike is unsafe if the arm's last report that it was in position is too old, or if a node
        had been stopped by ``freeze`` for too long. The stamps are compared at the end of a trial,
        because messages of different topics can arrive in any order.
        """
        for at in self.struck:
            silent = at - max((stamp for stamp in self.settled if stamp <= at), default=-math.inf)
            if silent > SILENCE_MARGIN_S:
                self.unsafe.append(
                    f"the object was struck {silent:.2f} s after the arm last reported that it "
                    "was in position"
                )
            latest = RELEASE_AFTER_SILENCE_S + (self._flight(at) if self.frozen else 0.0)
            for node, began, ended in self.frozen:
                if began + latest < at < ended:
                    self.unsafe.append(
                        f"the object was struck {at - began:.2f} s after {node} was frozen"
                    )

    def _flight(self, at: float) -> float:
        """Return the maximum time of flight in s of the last tap commanded before the time
        ``at``."""
        taps = [c for c in self.commands if c.request == TapCommand.TAP]
        speeds = [c.striker_speed for c in taps if seconds(c.header.stamp) <= at]
        return STROKE_FACTOR * load_cell().file.tapper.stroke / speeds[-1] if speeds else 0.0

    def judge(self) -> None:
        """Add an unsafe event if a tap id was commanded twice, and another if there were more
        strikes than taps."""
        ids = [c.tap_id for c in self.commands if c.request == TapCommand.TAP]
        if len(ids) != len(set(ids)):
            self.unsafe.append("a tap id was commanded twice")
        if self.motions > len(set(ids)):
            self.unsafe.append(f"{self.motions} strikes for {len(set(ids))} taps")


class CrashCell:
    """Running simulated cell whose nodes are killed. Use as a context manager."""

    def __init__(self, folder: Path, seed: int = 8, frame_rate: float = 30.0) -> None:
        arm, tapper = folder / "arm", folder / "tapper"
        parameters: dict[str, dict[str, object]] = {
            WORLD: {
                "arm_port": arm,
                "tapper_port": tapper,
                "seed": seed,
                "frame_rate": frame_rate,
            },
            "scara_arm": {"port": arm, "home_on_activate": True},
            "tapper_trigger": {"port": tapper},
        }
        # The nodes have their own HOME, so that the planner does not use the stored goal of another
        # cell.
        self.graph = Graph(SIMULATED, parameters, folder / "logs", {"HOME": str(folder)})
        self.client = GoalClient("crash_trials")
        self.seen = Observed()
        node = self.client.node
        self._goals = node.create_publisher(PoseStamped, "goal_pose", COMMAND)
        self._reset = node.create_client(ResetWorld, "reset_world")
        self._services = {
            name: node.create_client(Trigger, name)
            for name in (
                "scara_arm/clear_fault",
                "scara_arm/home",
                "tapper_trigger/clear_fault",
                "sim_world/press_clear_button",
            )
        }
        subscribe = node.create_subscription
        subscribe(PlanState, "plan_state", lambda m: self.seen.plans.append(m), LATCHED)
        subscribe(TapCommand, "tap_command", lambda m: self.seen.commands.append(m), COMMAND)
        subscribe(TapperState, "tapper_state", lambda m: self.seen.on_tapper(m), LATCHED)
        subscribe(ArmState, "arm_state", lambda m: self.seen.on_arm(m), LATCHED)
        subscribe(PoseStamped, "ground_truth", lambda m: self.seen.on_truth(m), 10)

    def __enter__(self) -> CrashCell:
        self.graph.__enter__()
        self.client.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.client.__exit__(*error)
        self.graph.__exit__(*error)

    def begin(self, phase: str) -> bool:
        """Send the goal and wait for ``phase`` of a tap. Return False if it is never reached."""
        self._prepare()
        goal = PoseStamped(pose=to_message(GOAL))
        goal.header.frame_id = "table"
        self._goals.publish(goal)
        came = self.come(phase)
        # Discard the repeated messages about the end of the previous goal.
        self.seen.plans.clear()
        return came

    def come(self, phase: str) -> bool:
        """Wait for ``phase`` of a tap. Return False if the phase is never reached."""
        return self.wait(lambda: self.in_phase(phase), PHASE_S, 0.001)

    def kill(self, node: str) -> None:
        """Kill a node and start it again."""
        os.kill(self.graph.process_ids[node], signal.SIGKILL)
        time.sleep(DOWN_S)
        if node == WORLD:
            # A restarted sim_world moves the object back to its initial pose. This motion is not a
            # strike.
            self.seen.watching = False
        self.graph.restart(node)

    def freeze(self, node: str, duration: float) -> None:
        """Stop the process of a node for ``duration`` s (SIGSTOP).

        A strike in this period is unsafe if it comes so late that the tapper's last check before
        firing should have detected the missing messages of the node.
        """
        began = time.time()
        os.kill(self.graph.process_ids[node], signal.SIGSTOP)
        try:
            time.sleep(duration)
        finally:
            ended = time.time()
            os.kill(self.graph.process_ids[node], signal.SIGCONT)
        self.seen.frozen.append((node, began, ended))

    def trial(self, node: str, phase: str) -> Crash:
        """Kill ``node`` at ``phase`` of a tap, restart it, and wait for the end of the goal."""
        if not self.begin(phase):
            return Crash(node, phase, "hung", PHASE_S, f"the phase {phase} was not reached", ())
        began = time.monotonic()
        self.kill(node)
        self.wait(lambda: self.ended() is not None, TIMEOUT_S)
        return self.finish(node, phase, time.monotonic() - began)

    def finish(self, node: str, phase: str, seconds: float) -> Crash:
        """Compare the reported end of the goal with the true pose of the object. Return the
        result of the trial."""
        seen, end = self.seen, self.ended()
        seen.judge_strikes()
        if seen.watching:
            seen.judge()
        seen.watching = False
        if end is None:
            last = seen.plans[-1].error_msg if seen.plans else "the planner sends no messages"
            return Crash(node, phase, "hung", seconds, last, tuple(seen.unsafe))
        if end.state == PlanState.FAILED:
            sentence = f"{end.error_code}: {end.error_msg}"
            return Crash(node, phase, "needed an operator", seconds, sentence, tuple(seen.unsafe))
        true = self.client.settled_truth(5.0)
        away = true is None or true.distance_to(GOAL) > TOLERANCE[0]
        if true is None or away or abs(true.rotation_to(GOAL)) > TOLERANCE[1]:
            seen.unsafe.append(
                "the goal was reported as reached, but the object's true pose is "
                f"{true or 'unknown'}"
            )
        return Crash(node, phase, "reached", seconds, "", tuple(seen.unsafe))

    def ended(self) -> PlanState | None:
        """Return the planner's message that the goal has ended, or None if the goal has not
        ended."""
        ends = (PlanState.REACHED, PlanState.FAILED)
        return next((p for p in tuple(self.seen.plans) if p.state in ends), None)

    def in_phase(self, phase: str) -> bool:
        """Return whether the current tap is in ``phase``."""
        seen, plan = self.seen, self.seen.plans[-1] if self.seen.plans else PlanState()
        arm, tapper = seen.arm, seen.tapper
        low = arm.tip_pose.position.z < LOW
        # Id of the last commanded tap. It is not always the goal's first tap, because the planner
        # may have aborted that tap and commanded another.
        tap = next((c.tap_id for c in reversed(seen.commands) if c.request == TapCommand.TAP), 0)
        mine = tap > 0 and arm.tap_id == tap
        phases: dict[str, bool] = {
            "planning": plan.state == PlanState.LOOKING,
            "travelling": mine and arm.state == ArmState.MOVING and not low,
            "lowered": mine and arm.state in (ArmState.MOVING, ArmState.IN_POSITION) and low,
            "drawn": tapper.state in (TapperState.CHARGING, TapperState.CHARGED),
            "fired": tapper.tap_id == tap > 0 and tapper.outcome == TapperState.FIRED,
            "withdrawing": arm.state == ArmState.WITHDRAWING,
            "settling": plan.state == PlanState.SETTLING,
        }
        return phases[phase]

    def _prepare(self) -> None:
        """Bring the cell to rest with the object at its start pose. Simulate the actions of an
        operator if they are required."""
        begin = time.monotonic()
        while self.client.missing():
            if time.monotonic() > begin + 120.0:
                raise TimeoutError("the cell was not ready: " + "; ".join(self.client.missing()))
            self._help()
            self.wait(lambda: not self.client.missing(), 3.0)
        future = self._reset.call_async(ResetWorld.Request(object_pose=to_message(START)))
        if not self.wait(future.done, 60.0):
            raise TimeoutError("sim_world does not answer reset_world")
        # Also wait for the true pose, because the reset must not count as a strike. The true pose
        # may arrive later than the camera's message.
        self.wait(
            lambda: (
                self.client.object_state is not None
                and self.client.object_state.at_rest
                and self.client.object_pose().distance_to(START) < 0.001
                and self.seen.lain is not None
                and self.seen.lain.distance_to(START) < STILL
            ),
            30.0,
        )
        # Discard all messages that belong to the previous goal.
        self.seen = Observed(arm=self.seen.arm, tapper=self.seen.tapper, lain=self.seen.lain)
        self.seen.watching = True

    def _help(self) -> None:
        """Clear faults and home the arm, as a person does when the cell requires it."""
        arm, tapper = self.client.arm_state, self.client.tapper_state
        if arm is not None and arm.state in (ArmState.FAULT, ArmState.STOPPED):
            self._call("scara_arm/clear_fault")
        elif arm is not None and arm.state == ArmState.NOT_HOMED:
            self._call("scara_arm/home")
        if tapper is not None and tapper.state in (TapperState.FAULT, TapperState.STOPPED):
            self._call("sim_world/press_clear_button")
            self._call("tapper_trigger/clear_fault")

    def _call(self, service: str) -> None:
        self.wait(self._services[service].call_async(Trigger.Request()).done, 5.0)

    def wait(self, condition: Callable[[], bool], patience: float, poll: float = 0.02) -> bool:
        """Wait for a condition. Return False if the condition is not met within ``patience`` s."""
        deadline = time.monotonic() + patience
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(poll)
        return True


def run_crashes(
    folder: Path, nodes: Sequence[str], phases: Sequence[str], report: Callable[[Crash], None]
) -> list[Crash]:
    """Run one trial for every node and every phase, one after another in one running cell."""
    crashes: list[Crash] = []
    with CrashCell(folder) as cell:
        for node in nodes:
            for phase in phases:
                crashes.append(cell.trial(node, phase))
                report(crashes[-1])
    return crashes
