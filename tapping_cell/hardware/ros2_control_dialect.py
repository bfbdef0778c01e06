"""Dialect for an arm with its own ROS driver.

The dialect sends trajectories to the arm's ``joint_trajectory_controller`` and relies only on the
joint states. If the controller reports a failure, the move fails; if it reports success, the joint
states must confirm it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tapping_cell.hardware import controller_needs
from tapping_cell.hardware.dialect import Axes, AxisReading, Firmware, LineCounters, StraightMove
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.finding import Finding
from tapping_cell.hardware.joint_trajectory import straight_points
from tapping_cell.hardware.trajectory_link import GoalState, JointSample, TrajectoryLink

REST_WINDOW = 0.05
"""Time for which the joints must be constant before the arm counts as at rest, s: 3 states at 50
Hz."""
REST_SPEED = 0.02
"""Reported speed above which a joint counts as moving, rad/s or m/s. The noise of a joint at rest
is below this speed."""
MIN_RATE = 20.0
"""Minimum rate of the joint states, Hz. It is also the rate at which a strike pose is verified."""
RATE_WINDOW = 0.5
"""Time over which the rate is measured, s."""
CLOCK_LIMIT = 0.1
"""Maximum time by which a stamp may lie in the future, s. Beyond it, the clocks count as not
synchronised."""
WAIT = 0.02
"""Longest wait between checks for a sample, s."""


@dataclass(frozen=True, slots=True)
class Ros2ControlSettings:
    """Joints, in the order of the kinematics, and requirements on their states."""

    joints: tuple[str, ...]
    max_acceleration: tuple[float, ...]
    """Maximum accelerations, rad/s^2 or m/s^2."""
    tolerance: tuple[float, ...]
    """Position tolerances of the arm, rad or m. The position of a joint at rest may vary by half
    its tolerance."""
    state_timeout: float = 0.25
    """Longest silence of the joint states, s."""
    axes: tuple[str, ...] = ()
    """Names of the values in the link's samples; empty if these are the values of ``joints``."""


class Ros2ControlDialect:
    """One trajectory controller; see :class:`~tapping_cell.hardware.dialect.ArmDialect`."""

    stop_bytes = opening_stop_bytes = b""

    def __init__(self, link: TrajectoryLink, settings: Ros2ControlSettings) -> None:
        self._link = link
        self._settings = settings
        self.counters = LineCounters()
        self._ends = -math.inf

    @property
    def units(self) -> Sequence[float]:
        """Controller units per rad or m of each joint; all are 1."""
        return (1.0,) * len(self._names)

    @property
    def _names(self) -> tuple[str, ...]:
        return self._settings.axes or self._settings.joints

    def connect(self, deadline: float) -> Firmware:
        """Receive joint states for a while; raise if their rate or their clock is unsuitable."""
        firmware, findings = self.inspect(deadline)
        controller_needs.refuse(findings)
        return firmware

    def inspect(self, deadline: float) -> tuple[Firmware, list[Finding]]:
        """Check the names, the rate and the clock of the joint states; nothing moves."""
        self._ends = -math.inf
        self._await_first(deadline)
        until = self._link.now() + RATE_WINDOW
        while (left := until - self._link.now()) > 0:
            self._link.wait(left)
        samples = [s for s in self._link.samples if s.received >= until - RATE_WINDOW]
        rate = len(samples) / RATE_WINDOW
        ahead = max((s.ahead for s in samples), default=0.0)
        age = min((s.received - s.measured for s in samples), default=0.0)
        findings = [
            Finding(
                "rate of the joint states",
                f"{rate:.0f} Hz",
                f"must be at least {MIN_RATE:.0f} Hz (the broadcaster's or the controller"
                " manager's update_rate)",
                rate >= MIN_RATE,
            ),
            Finding(
                "clock of the joint states' stamps",
                f"{ahead:.3f} s ahead" if ahead > age else f"{age:.3f} s behind",
                f"must be at most {CLOCK_LIMIT:g} s ahead of this computer's clock and at most"
                f" {self._settings.state_timeout:g} s behind it: synchronise the clocks (chrony,"
                " PTP)",
                ahead <= CLOCK_LIMIT and age <= self._settings.state_timeout,
            ),
        ]
        remarks = [
            f"{name} also publishes on the topic of the controller {self._link.name}: only the cell"
            f" may send trajectories to it while the cell runs; end {name}"
            for name in self._link.other_commanders
        ]
        if samples and samples[-1].velocities is None:
            remarks.append(
                "the joint states contain no velocities, so rest is detected from positions alone"
            )
        # `continued` is False, because the arm's driver or its motor drives may have been restarted
        # since the last connect.
        firmware = Firmware("ros2_control", self._link.interface, False, tuple(remarks))
        return firmware, findings

    def store(self, finding: Finding, deadline: float) -> None:
        """Raise ValueError: the settings of the arm's own driver cannot be changed here."""
        raise ValueError(f"{finding.setting} must be set in the configuration of the arm's driver")

    def read(self, deadline: float) -> AxisReading:
        """Return the first state measured after the call, and whether the joints are at rest."""
        asked = self._link.now()
        return self._reading(self._measured_after(asked, deadline), asked)

    def start_moves(self, moves: Sequence[StraightMove], deadline: float) -> None:
        """Send the moves as one trajectory from the arm's current position."""
        here = self._measured_after(self._link.now(), deadline)
        points = straight_points(here.positions, moves, self._settings.max_acceleration)
        if not points:
            return
        self._link.send(points)
        self._ends = self._link.now() + points[-1].time

    def finish_move(
        self, expected_end: float, deadline: float, within: Callable[[Axes], bool]
    ) -> AxisReading:
        """Wait until the trajectory's duration has passed, the joints are at rest, and the
        controller has reported the end of the trajectory's goal, if it reports goals.

        If no more states are received, the arm is commanded to brake, because the controller may
        still receive commands although its states no longer arrive.
        """
        try:
            return self._finished(expected_end, deadline)
        except HardwareFault as fault:
            if fault.reason is FaultReason.DISCONNECTED:
                self._link.brake()
            raise

    def _finished(self, expected_end: float, deadline: float) -> AxisReading:
        # The computed end of the trajectory is more accurate than `expected_end`, which assumes a
        # stop after every move.
        while self._link.now() < self._ends:
            self._receive()
            self._check_goal()
        while True:
            reading = self.read(max(deadline, self._link.now() + self._settings.state_timeout))
            goal = self._check_goal()
            if not reading.moving and goal is not GoalState.ACTIVE:
                return reading
            if self._link.now() >= deadline:
                self.counters.timeouts += 1
                raise HardwareFault(
                    FaultReason.TIMEOUT,
                    f"{self._link.name} "
                    + (
                        "still moves"
                        if reading.moving
                        else "has not reported the end of the trajectory"
                    ),
                )

    def idle(self, duration: float) -> None:
        """Process incoming states; raise if they stop arriving."""
        until = self._link.now() + duration
        while (left := until - self._link.now()) > 0:
            self._receive(left)

    def home(self, axes: Axes | None, deadline: float) -> None:
        """Raise HOMING_FAILED: the arm's own driver is responsible for homing."""
        raise HardwareFault(
            FaultReason.HOMING_FAILED,
            "an arm with its own ROS driver is homed by that driver: set arm.homing to none",
        )

    def set_position(self, axes: Axes, deadline: float) -> None:
        """Raise HOMING_FAILED as ``home`` does."""
        self.home(axes, deadline)

    def clear(self, deadline: float) -> None:
        """After a stop, wait until states arrive and the arm is at rest. The arm may then be
        homed."""
        self._ends = -math.inf
        while self.read(deadline).moving:
            if self._link.now() >= deadline:
                raise HardwareFault(
                    FaultReason.TIMEOUT,
                    f"{self._link.name} still moves after the stop: stop it with its own panel",
                )

    def _check_goal(self) -> GoalState:
        """Return the goal state of the trajectory; raise if it failed."""
        progress = self._link.progress()
        if progress.state is GoalState.FAILED:
            raise HardwareFault(
                FaultReason.REJECTED,
                f"{self._link.name} did not carry out a trajectory: {progress.words}: check "
                "for an obstacle, the controller's limits and tolerances, and another "
                "program that sends it trajectories",
            )
        return progress.state

    def _receive(self, longest: float = WAIT) -> None:
        """Wait for a short time; raise if no states have arrived for too long."""
        self._link.wait(min(longest, WAIT))
        if self._silence() > self._settings.state_timeout:
            raise self._silence_fault()

    def _silence(self) -> float:
        """Return the time since the newest state was measured, s."""
        samples = self._link.samples
        return self._link.now() - samples[-1].measured if samples else math.inf

    def _silence_fault(self) -> HardwareFault:
        self.counters.timeouts += 1
        samples = self._link.samples
        late = bool(samples) and self._link.now() - samples[-1].received < 0.1
        cause = (
            "messages still arrive, but with old time stamps, because the clock of the arm's "
            "computer differs or the network is slow; synchronise the clocks"
            if late
            else "check the arm's driver, its joint_state_broadcaster and the network"
        )
        silence = self._silence()
        since = f"{silence:.2f} s" if math.isfinite(silence) else "more than a second"
        return HardwareFault(
            FaultReason.DISCONNECTED,
            f"no joint states of {self._link.name} have been measured for {since} (limit"
            f" {self._settings.state_timeout:.2f} s): {cause}",
        )

    def _await_first(self, deadline: float) -> None:
        while not self._link.samples:
            if self._link.now() >= deadline:
                self.counters.timeouts += 1
                other = ", ".join(self._link.other_names)
                found = f", only messages with the joints {other}" if other else ""
                raise HardwareFault(
                    FaultReason.TIMEOUT,
                    f"no joint states of {', '.join(self._settings.joints)} have arrived for "
                    f"{self._link.name}{found}: check "
                    "arm.ros2_control.joint_states and .joints, and that the "
                    "joint_state_broadcaster is active",
                )
            self._link.wait(WAIT)

    def _measured_after(self, asked: float, deadline: float) -> JointSample:
        while True:
            samples = self._link.samples
            if samples and samples[-1].measured >= asked:
                return self._checked(samples[-1])
            waited = self._link.now() - asked
            if waited > self._settings.state_timeout and (
                self._silence() > self._settings.state_timeout or self._link.now() >= deadline
            ):
                raise self._silence_fault()
            self._link.wait(WAIT)

    def _checked(self, sample: JointSample) -> JointSample:
        for name, value in zip(self._names, sample.positions, strict=True):
            if not math.isfinite(value):
                raise HardwareFault(
                    FaultReason.POSITION_LOST,
                    f"the joint states of {self._link.name} give {value} for joint {name}: its"
                    " hardware is not active",
                )
        if sample.problem:
            raise HardwareFault(FaultReason.POSITION_LOST, f"{self._link.name}: {sample.problem}")
        if sample.ahead > CLOCK_LIMIT:
            raise HardwareFault(
                FaultReason.POSITION_LOST,
                f"the joint states of {self._link.name} have time stamps {sample.ahead:.2f} s "
                "in the future, so their age is unknown; synchronise the clocks (chrony, PTP)",
            )
        return sample

    def _reading(self, sample: JointSample, asked: float) -> AxisReading:
        return AxisReading(sample.positions, self._moving(sample), "", True, asked)

    def _moving(self, newest: JointSample) -> bool:
        """Return whether a joint moves or may move: True until the trajectory's end has passed and
        the joints have been constant for ``REST_WINDOW``."""
        if newest.measured < self._ends:
            return True
        if newest.velocities is not None and any(abs(v) > REST_SPEED for v in newest.velocities):
            return True
        samples = [s for s in self._link.samples if s.measured <= newest.measured]
        since = newest.measured - REST_WINDOW
        before = [s for s in samples if s.measured <= since]
        if not before:
            return True
        window = [before[-1], *(s for s in samples if s.measured > since)]
        columns = zip(*(s.positions for s in window), strict=True)
        return any(
            max(values) - min(values) > limit / 2
            for values, limit in zip(columns, self._settings.tolerance, strict=True)
        )
