"""Time per tap by activity for the published task: 10 mm and 10 degrees, back and forth.

Every node is a process, with rendered images and emulated boards. A tap lasts from its command to
the next command, or to the end of its goal. This time is divided into consecutive activities
without gaps or overlaps. Two activities overlap with others and are listed separately: the slide,
and charging while the arm moves. The planned duration of the arm's motion to the strike is also
listed.
"""

from __future__ import annotations

import io
import math
import os
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from tapping_cell_msgs.msg import ArmState, ObjectStates, PlanState, TapCommand, TapperState

from benchmarks.rigs import simulated_graph
from tapping_cell.cli import session
from tapping_cell.cli.graph import nodes_of, own_domain
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.logic.arm_times import arm_times
from tapping_cell.logic.poses import from_message
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.se2 import Pose, wrap_angle

DEFAULT_COUNT = 20
MOVES = ((10.0, 0.0, 10.0), (-10.0, 0.0, -10.0))
"""Goals relative to the object's pose, used in turn: mm, mm and degrees."""
READY_TIMEOUT_S = 60.0
ACTIVITIES = ("travel", "lower", "settle", "charge", "fire", "withdraw", "camera", "planning")
BESIDES = ("slide", "charging", "planned motion to the strike")
TOPICS = {
    "tap_command": (TapCommand, COMMAND),
    "plan_state": (PlanState, LATCHED),
    "arm_state": (ArmState, LATCHED),
    "tapper_state": (TapperState, LATCHED),
    "object_states": (ObjectStates, LATCHED),
}


@dataclass(slots=True)
class Tap:
    """Times of the events during one tap, in s."""

    commanded: float
    planned: float = math.nan
    above: float = math.nan
    at_pose: float = math.nan
    in_position: float = math.nan
    charging: float = math.nan
    charged: float = math.nan
    reported: float = math.nan
    free: float = math.nan
    observed: float = math.nan
    at_rest: float = math.nan
    done: float = math.nan

    def activities(self) -> dict[str, float]:
        """Return durations in s, by name: those of the consecutive activities (``ACTIVITIES``) and
        those of the activities that overlap with them (``BESIDES``)."""
        ready = max(self.in_position, self.charged)
        return {
            "travel": self.above - self.commanded,
            "lower": self.at_pose - self.above,
            "settle": self.in_position - self.at_pose,
            "charge": ready - self.in_position,
            "fire": self.reported - ready,
            "withdraw": self.free - self.reported,
            "camera": self.observed - self.free,
            "planning": self.done - self.observed,
            "slide": self.at_rest - self.reported,
            "charging": self.charged - self.charging,
            "planned motion to the strike": self.planned,
        }


class Stopwatch:
    """Records the times of each tap from the stamps of the cell's messages."""

    def __init__(self, cell: Cell) -> None:
        self._times = arm_times(cell)
        self._tip: tuple[float, ...] | None = None
        self.taps: list[Tap] = []
        self.goals: list[tuple[float, int]] = []
        """Duration (s) and number of taps of each reached goal."""
        self._accepted = math.nan
        self._height = cell.arm.travel_height
        self._tap: Tap | None = None
        self._ids: list[int] = []

    def on_message(self, topic: str, message: Any) -> None:
        """Process one message."""
        stamp = _seconds(message.header.stamp)
        if topic == "plan_state":
            self._time_goal(message, stamp)
        if topic == "tap_command" and message.request == TapCommand.TAP:
            self._end(stamp)
            self._tap = Tap(stamp, self._planned(from_message(message.strike_pose)))
            self._ids.append(message.tap_id)
        elif topic == "arm_state":
            tip = from_message(message.tip_pose)
            self._tip = (tip.x, tip.y, message.tip_pose.position.z, tip.theta)
        if self._tap is not None:
            getattr(self, f"_{topic}")(self._tap, message, stamp)

    def _planned(self, strike: Pose) -> float:
        """Return the planned duration of the arm's motion to a strike, in s; NaN before the arm has
        reported a pose."""
        if self._times is None or self._tip is None:
            return math.nan
        return self._times.to_strikes(self._tip, np.array([strike])).item()

    def _end(self, stamp: float) -> None:
        if self._tap is not None and not math.isnan(self._tap.observed):
            self._tap.done = stamp
            self.taps.append(self._tap)
        self._tap = None

    def _time_goal(self, message: Any, stamp: float) -> None:
        if message.state == PlanState.REACHED and not math.isnan(self._accepted):
            self.goals.append((stamp - self._accepted, message.taps))
        if message.state in (PlanState.REACHED, PlanState.FAILED, PlanState.CANCELED):
            self._accepted = math.nan
        elif math.isnan(self._accepted) and message.state != PlanState.IDLE:
            self._accepted = stamp

    def _tap_command(self, tap: Tap, message: Any, stamp: float) -> None:
        """Do nothing: the time of a WITHDRAW command is not needed, and ``on_message`` processes
        TAP commands."""

    def _plan_state(self, tap: Tap, message: Any, stamp: float) -> None:
        if message.state == PlanState.LOOKING and math.isnan(tap.free):
            tap.free = stamp
        elif message.state == PlanState.PLANNING and not math.isnan(tap.free):
            tap.observed = stamp
        elif message.state == PlanState.REACHED:
            self._end(stamp)
        elif message.state in (PlanState.FAILED, PlanState.CANCELED):
            self._tap = None

    def _arm_state(self, tap: Tap, message: Any, stamp: float) -> None:
        height = message.tip_pose.position.z
        arrives = math.isnan(tap.in_position) and stamp >= tap.commanded
        if message.state == ArmState.MOVING and arrives:
            if height > self._height - 1e-3:
                tap.above = stamp
            else:
                tap.at_pose = stamp
        elif message.state == ArmState.IN_POSITION and math.isnan(tap.in_position):
            tap.in_position = stamp
            if math.isnan(tap.at_pose):
                tap.at_pose = stamp

    def _tapper_state(self, tap: Tap, message: Any, stamp: float) -> None:
        if message.tap_id != self._ids[-1]:
            return
        if message.state == TapperState.CHARGING and math.isnan(tap.charging):
            tap.charging = stamp
        if message.state in (TapperState.CHARGED, TapperState.FIRING) and math.isnan(tap.charged):
            tap.charged = stamp
        if message.outcome == TapperState.FIRED and math.isnan(tap.reported):
            tap.reported = stamp

    def _object_states(self, tap: Tap, message: Any, stamp: float) -> None:
        fired = not math.isnan(tap.reported)
        own = message.objects[0]
        if fired and own.at_rest and math.isnan(tap.at_rest):
            since = _seconds(own.at_rest_since)
            if since > tap.reported:
                tap.at_rest = since


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def measure(count: int = DEFAULT_COUNT) -> dict[str, Any]:
    """Return the mean duration of every activity over ``count`` goals, in s."""
    return {**_summary(in_graph(count)), "load": os.getloadavg()[0]}


def _summary(watch: Stopwatch) -> dict[str, Any]:
    columns: dict[str, list[float]] = defaultdict(list)
    for tap in watch.taps:
        activities = tap.activities()
        columns["cycle"].append(tap.done - tap.commanded)
        for name, seconds in activities.items():
            columns[name].append(seconds)
    return {
        "taps": len(watch.taps),
        "goals": len(watch.goals),
        "goal": float(np.mean([seconds for seconds, _ in watch.goals])),
        "taps_a_goal": float(np.mean([number for _, number in watch.goals])),
        **{
            name: float(np.nanmean(values)) if np.any(np.isfinite(values)) else math.nan
            for name, values in columns.items()
        },
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    return [
        *(f"{name:32s}{report[name]:8.3f} s" for name in (*ACTIVITIES, "cycle")),
        *(f"{'(' + name + ')':32s}{report[name]:8.3f} s" for name in BESIDES),
        f"{report['goals']} goals, {report['goal']:.2f} s and {report['taps_a_goal']:.2f} taps"
        f" each, from the goal to its end; load {report['load']:.1f} on {os.cpu_count()} cores",
    ]


def in_graph(count: int) -> Stopwatch:
    """Measure goals of the published task in a cell whose nodes are processes."""
    domain = own_domain()  # the domain stays reserved until this function returns
    domain.use()
    cell = load_cell()
    watch = Stopwatch(cell)
    quiet = Console(file=io.StringIO())
    nodes = nodes_of(cell, hardware=False)
    with simulated_graph(nodes) as graph, GoalClient("cycle_bench") as client:
        for topic, (kind, quality) in TOPICS.items():
            client.node.create_subscription(kind, topic, partial(watch.on_message, topic), quality)
        for number in range(count):
            session.wait_until_ready(client, READY_TIMEOUT_S, graph.check, quiet)
            observed = client.object_state
            client.send(_goal(client.object_pose(), number), observed=observed)
            session.follow(client, graph.check, quiet)
    return watch


def _goal(here: Pose, number: int) -> Pose:
    """Return goal ``number`` relative to the object's pose."""
    dx, dy, turn = MOVES[number % len(MOVES)]
    theta = float(wrap_angle(here.theta + math.radians(turn)))
    return Pose(here.x + dx / 1000, here.y + dy / 1000, theta)
