"""Emulator of a joint_trajectory_controller and its arm in ros2_control, with time as an argument.

The emulator accepts a trajectory if it names the controller's joints, in any order, and if its
times increase. A new trajectory replaces the current one, starting from the present command
(preemption). Points with velocities are joined by cubics, others by straight lines. The arm follows
its commands with a lag. An action goal succeeds once every joint is within its goal tolerance after
the trajectory's end. The goal is aborted if the joints need longer than the goal time or if the arm
leaves the path tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tapping_cell.hardware.joint_trajectory import TrajectoryPoint
from tapping_cell.hardware.trajectory_link import GoalState, Progress

Array = NDArray[np.float64]

STEP = 1e-3
"""Time step over which the arm's speed is measured, in s."""


@dataclass(frozen=True, slots=True)
class ControllerSettings:
    """Behaviour of the controller and its arm."""

    names: tuple[str, ...]
    lag: float = 0.02
    """Delay from a commanded position until the arm reaches it, in s."""
    goal_tolerance: float = 1e-3
    """Maximum position error at the goal, rad or m."""
    goal_time: float = 0.5
    """Maximum time to reach the goal after the trajectory's end, in s."""
    path_tolerance: float = 0.05
    """Maximum position error on the path, rad or m; checked only while an action goal is active."""
    speed_scaling: float = 1.0
    """Factor on the trajectory's speed, as set by a robot's speed slider."""
    offset: float = 0.0
    """Constant position error of every joint, such as that of a compliant drive, rad or m."""


@dataclass(frozen=True, slots=True)
class _Run:
    """A trajectory and the time when it was accepted."""

    start: float
    points: tuple[TrajectoryPoint, ...]
    """Points of the trajectory; the first point is the state at the start."""


class TrajectoryController:
    """One controller with its arm. Times in s, never decreasing; positions in rad or m."""

    def __init__(
        self, settings: ControllerSettings, positions: Sequence[float], now: float = 0.0
    ) -> None:
        self.settings = settings
        self.active = True
        """Whether the controller is activated; otherwise it accepts nothing."""
        self.taken = 0
        still = (0.0,) * len(settings.names)
        self._runs = [_Run(now, (TrajectoryPoint(0.0, tuple(positions), still),))]
        self._blocked: tuple[float, Array] | None = None
        self._goal_active = False
        self._progress = Progress(GoalState.UNREPORTED)

    def take(
        self,
        names: Sequence[str],
        points: Sequence[TrajectoryPoint],
        now: float,
        as_goal: bool = False,
    ) -> str:
        """Accept a trajectory; return the reason if it is rejected, else an empty string.

        ``as_goal``: whether it was received through the action.
        """
        refusal = self._refusal(names, points)
        if refusal:
            if as_goal:
                self._progress = Progress(GoalState.FAILED, refusal)
            return refusal
        self._watch(now)
        order = [list(names).index(name) for name in self.settings.names]
        place, speed = self._commanded(now)
        start = TrajectoryPoint(0.0, tuple(place.tolist()), tuple(speed.tolist()))
        sorted_points = tuple(
            TrajectoryPoint(
                point.time,
                tuple(point.positions[i] for i in order),
                tuple(point.velocities[i] for i in order) if point.velocities else (),
            )
            for point in points
        )
        self._runs = [*self._runs[-3:], _Run(now, (start, *sorted_points))]
        self.taken += 1
        self._goal_active = as_goal
        self._progress = Progress(GoalState.ACTIVE if as_goal else GoalState.UNREPORTED)
        return ""

    def cancel(self, now: float) -> None:
        """Cancel the goal; the commanded position then remains constant."""
        if not self._goal_active:
            return
        place, _ = self._commanded(now)
        self._hold(place, now)
        self._progress = Progress(GoalState.FAILED, "cancelled")

    def block(self, now: float) -> None:
        """Block the arm at its present position by an obstacle."""
        self._blocked = (now, self._follows(now))

    def unblock(self, now: float) -> None:
        """Remove the obstacle; the arm jumps to its commanded position."""
        self._blocked = None

    def push(self, offset: Sequence[float], now: float) -> None:
        """Push the arm externally by ``offset``; the arm stays displaced."""
        place, _ = self._commanded(now)
        self._hold(place + np.asarray(offset, dtype=float), now)

    def state(self, now: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the true positions and speeds of the joints."""
        place = self._follows(now)
        speed = (place - self._follows(now - STEP)) / STEP
        return tuple(place.tolist()), tuple(speed.tolist())

    def moving(self, now: float) -> bool:
        """Return whether the arm truly moves."""
        _, speeds = self.state(now)
        return max(map(abs, speeds)) > 1e-6

    def progress(self, now: float) -> Progress:
        """Return the state of the last goal."""
        self._watch(now)
        return self._progress

    def _watch(self, now: float) -> None:
        """Check the tolerances of the active goal."""
        if not self._goal_active:
            return
        run, settings = self._runs[-1], self.settings
        end = run.start + run.points[-1].time / settings.speed_scaling
        place = self._follows(now)
        if now < end:
            behind = float(np.max(np.abs(place - self._commanded(now - settings.lag)[0])))
            if behind > settings.path_tolerance:
                self._hold(place, now)
                self._progress = Progress(GoalState.FAILED, "path tolerance violated (code -4)")
            return
        error = float(np.max(np.abs(place - np.array(run.points[-1].positions))))
        if error <= settings.goal_tolerance:
            self._goal_active = False
            self._progress = Progress(GoalState.SUCCEEDED)
        elif now > end + settings.goal_time:
            self._hold(place, now)
            self._progress = Progress(GoalState.FAILED, "goal tolerance violated (code -5)")

    def _hold(self, place: Array, now: float) -> None:
        still = (0.0,) * len(place)
        held = _Run(now, (TrajectoryPoint(0.0, tuple(place.tolist()), still),))
        self._runs = [*self._runs[-3:], held]
        self._goal_active = False

    def _refusal(self, names: Sequence[str], points: Sequence[TrajectoryPoint]) -> str:
        if not self.active:
            return "the controller is not active"
        if sorted(names) != sorted(self.settings.names):
            return "the joints are not those of the controller"
        if not points:
            return "an empty trajectory"
        if any(len(point.positions) != len(names) for point in points):
            return "a point does not have a position for each joint"
        times = [point.time for point in points]
        if any(b <= a for a, b in pairwise(times)):
            return "the times do not increase"
        return ""

    def _follows(self, time: float) -> Array:
        """Return the arm's position: that of the delayed command, or where the arm is blocked."""
        if self._blocked is not None and time >= self._blocked[0]:
            return self._blocked[1]
        return self._commanded(time - self.settings.lag)[0] + self.settings.offset

    def _commanded(self, time: float) -> tuple[Array, Array]:
        run = next((r for r in reversed(self._runs) if r.start <= time), self._runs[0])
        t = (time - run.start) * self.settings.speed_scaling
        after = next((i for i, p in enumerate(run.points) if p.time > t), len(run.points))
        if after == len(run.points) or t <= 0:
            point = run.points[-1] if t > 0 else run.points[0]
            return np.array(point.positions), np.zeros(len(point.positions))
        before, behind = run.points[after - 1], run.points[after]
        place, rate = _between(before, behind, t)
        return place, rate * self.settings.speed_scaling


def _between(before: TrajectoryPoint, after: TrajectoryPoint, time: float) -> tuple[Array, Array]:
    """Interpolate between two points by a cubic, or linearly if the points have no velocities."""
    a, b = np.array(before.positions), np.array(after.positions)
    span = after.time - before.time
    u = (time - before.time) / span
    if not before.velocities or not after.velocities:
        return a + u * (b - a), (b - a) / span
    v, w = span * np.array(before.velocities), span * np.array(after.velocities)
    place = (
        a * (1 + 2 * u) * (1 - u) ** 2
        + v * u * (1 - u) ** 2
        + b * u**2 * (3 - 2 * u)
        - w * u**2 * (1 - u)
    )
    slope = 6 * u * (1 - u) * (b - a) + v * (1 - u) * (1 - 3 * u) + w * u * (3 * u - 2)
    return place, slope / span


def stamps(since: float, until: float, rate: float) -> list[float]:
    """Return the times in (since, until] at which states are published at ``rate`` Hz."""
    first = math.floor(since * rate) + 1
    return [number / rate for number in range(first, math.floor(until * rate) + 1)]
