"""The tapper's spring carriage: its counted steps and its true motion.

The model follows the rules of ``firmware/tapper/drive.c``, but computes whole movements instead of
single steps. Positions are in steps from the point where the front switch closes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

LEAVE_STEPS = 400
"""Maximum number of steps to move off a closed front switch before homing fails."""
HYSTERESIS_LIMIT = 50
"""Step count at and above which the front switch must be open when charging."""
SLACK = 6
"""Maximum difference between the positions at which the switch closes on a return and at homing,
steps."""
SETTLE_TIME = 0.002
"""Time for which the switch level must be constant to count, s; no steps are made meanwhile."""
WAKE_TIME = 0.010
"""Time from enabling the motor to its first step, s."""


@dataclass(frozen=True, slots=True)
class SpringMechanism:
    """Parameters of the spring, its carriage and its motor."""

    stiffness: float = 500.0
    """Spring constant, N/m."""
    step_length: float = 5e-6
    """Travel per step, m: 8 mm lead, 200 full steps per turn, 8 microsteps per full step."""
    step_rate: float = 4000.0
    """Step rate, 1/s."""
    longest_draw: int = 12000
    """Maximum position of the carriage when charging, steps."""
    switch_hysteresis: float = 24.0
    """Distance between the switch's closing and opening positions, steps."""
    back_drive: float = 4000.0
    """Speed at which the spring pushes the carriage back while the motor is off, steps/s."""

    def steps_for(self, energy: float) -> int:
        """Return the number of whole steps whose energy is nearest to ``energy`` in J."""
        return math.floor(math.sqrt(2 * energy / self.stiffness) / self.step_length + 0.5)

    def energy_at(self, place: float) -> float:
        """Return the spring's energy in J with the carriage at ``place`` in steps."""
        return 0.5 * self.stiffness * (place * self.step_length) ** 2

    def can_store(self, energy: float) -> bool:
        """Return whether whole steps store ``energy`` in J to within 3 %."""
        steps = self.steps_for(energy)
        return (
            0 < steps <= self.longest_draw and abs(self.energy_at(steps) - energy) <= 0.03 * energy
        )


class Status(Enum):
    """Status of the last movement."""

    THERE = "there"
    MOVING = "moving"
    UNKNOWN = "unknown"
    """The motor is off, and the carriage's position is unknown."""


class Phase(Enum):
    """Phase of the drive."""

    OFF = "off"
    LEAVING = "leaving"
    SEEKING = "seeking"
    OUT = "out"
    BACK = "back"
    HOLDING = "holding"


@dataclass(frozen=True, slots=True)
class _End:
    """End of the current movement: time, number of steps, next phase, and step count at the end."""

    at: float
    steps: int
    phase: Phase
    count: int


class SpringDrive:
    """The spring's carriage in simulated time; ``now`` in s must not decrease between calls."""

    def __init__(self, mechanism: SpringMechanism, now: float, place: float = 0.0) -> None:
        self.mechanism = mechanism
        self._phase = Phase.OFF
        self._count = 0
        self._target = 0
        self._opened = False
        self._leave_steps = LEAVE_STEPS
        self._place = place
        self._closed = place <= 0.0
        self._powered = True
        self._stuck: bool | None = None
        self._lose = 0
        self._since = now
        self._end: _End | None = None

    @property
    def status(self) -> Status:
        """Status of the last movement."""
        if self._phase is Phase.OFF:
            return Status.UNKNOWN
        return Status.THERE if self._phase is Phase.HOLDING else Status.MOVING

    def place(self, now: float) -> float:
        """Return the true position of the carriage, in steps from the point where the front switch
        closes."""
        self.advance(now)
        self._take(now)
        return self._place

    # Firmware commands.

    def can_store(self, energy: float) -> bool:
        """Return whether whole steps store ``energy`` in J to within 3 %."""
        return self.mechanism.can_store(energy)

    def charge(self, energy: float, now: float) -> None:
        """Charge the spring with ``energy`` in J."""
        self.out(self.mechanism.steps_for(energy), now)

    def stored(self, now: float) -> float:
        """Return the energy that the spring stores, J."""
        return self.mechanism.energy_at(self.place(now))

    def at_mounts(self, now: float) -> int:
        """Return 0: a tapper on an arm has no mount switches."""
        return 0

    def released(self, channel: int, now: float) -> None:
        """Do nothing on a release, because ``back`` returns the carriage."""

    def start(self) -> None:
        """Do nothing when the board is powered on."""

    def home(self, now: float) -> None:
        """Leave the front switch if it is closed, then seek it."""
        wake = WAKE_TIME if self._phase is Phase.OFF else 0.0
        self._leave_steps = LEAVE_STEPS
        self._begin(Phase.LEAVING, now, wake)

    def out(self, steps: int, now: float) -> None:
        """Charge the spring by moving the carriage to the position ``steps``; do nothing if the
        carriage moves or its position is unknown."""
        if self._phase is Phase.HOLDING:
            self._target, self._opened = steps, False
            self._begin(Phase.OUT, now)

    def back(self, now: float) -> None:
        """Return to the front switch; do nothing while the position is unknown."""
        if self._phase in (Phase.LEAVING, Phase.SEEKING):
            self.halt(now)
        elif self._phase is not Phase.OFF and not (
            self._phase is Phase.HOLDING and self._count == 0
        ):
            self._take(now)
            # The switch has not confirmed a short motion, so steps may be missing: find its edge.
            self._leave_steps = 2 * HYSTERESIS_LIMIT
            self._begin(Phase.BACK if self._opened else Phase.LEAVING, now)

    def halt(self, now: float) -> None:
        """Switch the motor off."""
        self._begin(Phase.OFF, now)

    # Faults.

    def set_power(self, on: bool, now: float) -> None:
        """Switch the motor's supply on or off; the emergency stop switches it off."""
        self._take(now)
        self._powered = on
        self._begin(self._phase, now)

    def set_switch(self, stuck: bool | None, now: float) -> None:
        """Set the front switch to stuck closed (True), stuck open (False), or working (None)."""
        self._take(now)
        self._stuck = stuck
        self._begin(self._phase, now)

    def lose_steps(self, count: int, now: float) -> None:
        """Make the motor lose the next ``count`` steps."""
        self._take(now)
        self._lose = count
        self._begin(self._phase, now)

    # Time.

    def next_event(self) -> float | None:
        """Return the end time of the current movement; None if there is none."""
        return None if self._end is None else self._end.at

    def advance(self, now: float) -> None:
        """End every movement that is due by ``now``."""
        while self._end is not None and self._end.at <= now:
            end = self._end
            self._move(end.steps)
            self._count = end.count
            self._begin(end.phase, end.at, taken=True)

    def _begin(self, phase: Phase, now: float, wake: float = 0.0, taken: bool = False) -> None:
        if not taken:
            self._take(now)
        self._phase = phase
        self._since = now + wake
        if phase is Phase.LEAVING and not self._switch():
            self._phase = Phase.SEEKING
        self._end = self._plan()

    def _direction(self) -> int:
        return {Phase.LEAVING: 1, Phase.OUT: 1, Phase.SEEKING: -1, Phase.BACK: -1}.get(
            self._phase, 0
        )

    def _take(self, now: float) -> None:
        """Update the position and the step count to ``now``."""
        if self._phase is Phase.OFF:
            if now > self._since and self._place > 0.0:
                slip = self.mechanism.back_drive * (now - self._since)
                self._place = max(0.0, self._place - slip)
            self._since = max(self._since, now)
        elif self._direction() and now > self._since:
            steps = math.floor((now - self._since) * self.mechanism.step_rate + 1e-9)
            if self._end is not None:
                steps = min(steps, self._end.steps)
            self._move(steps)
            self._count += self._direction() * steps
            if self._phase is Phase.LEAVING:
                self._leave_steps -= steps
            self._since = now
        self._closed = self._switch_after(0)

    def _effective(self, steps: int) -> int:
        return max(0, steps - self._lose) if self._powered else 0

    def _move(self, steps: int) -> None:
        self._closed = self._switch_after(steps)
        self._opened |= self._phase is Phase.OUT and not self._closed
        self._place += self._direction() * self._effective(steps)
        self._lose = max(0, self._lose - steps)

    def _switch_after(self, steps: int) -> bool:
        """Return whether a working front switch is closed after ``steps`` more steps."""
        place = self._place + self._direction() * self._effective(steps)
        return place < self.mechanism.switch_hysteresis if self._closed else place <= 0.0

    def _switch(self) -> bool:
        return self._closed if self._stuck is None else self._stuck

    def _shows_closed_after(self, steps: int) -> bool:
        """Return whether the front switch, which may be stuck, shows closed after ``steps`` more
        steps."""
        return self._switch_after(steps) if self._stuck is None else self._stuck

    def _steps_until(self, distance: float) -> float:
        """Return the number of motor steps until the switch changes; inf if it never changes.
        ``distance``: steps that the carriage must move until then."""
        if not self._powered or self._stuck is not None:
            return math.inf
        return self._lose + max(0.0, math.ceil(distance))

    def _plan(self) -> _End | None:
        """Return the end of the current phase; None if the phase does not end by itself."""
        rate, hysteresis = self.mechanism.step_rate, self.mechanism.switch_hysteresis

        def after(steps: float, phase: Phase, count: int, settle: float = 0.0) -> _End:
            whole = int(steps)
            return _End(self._since + whole / rate + settle, whole, phase, count)

        if self._phase is Phase.LEAVING:
            needed = self._steps_until(hysteresis - self._place)
            if needed <= self._leave_steps:
                return after(needed, Phase.SEEKING, 0, SETTLE_TIME)
            return after(self._leave_steps, Phase.OFF, 0)
        if self._phase is Phase.SEEKING:
            needed = 0 if self._switch() else self._steps_until(self._place)
            longest = self.mechanism.longest_draw + LEAVE_STEPS
            if needed <= longest:
                return after(needed, Phase.HOLDING, 0, SETTLE_TIME)
            return after(longest, Phase.OFF, 0)
        at_front = self._count == 0 and self._phase in (Phase.OUT, Phase.HOLDING)
        if at_front and not self._switch():  # the carriage was moved by hand, or the switch sticks
            return after(0, Phase.OFF, 0, SETTLE_TIME)
        if self._phase is Phase.OUT:
            check = max(0, HYSTERESIS_LIMIT - self._count)
            steps = self._target - self._count
            if check <= steps and self._shows_closed_after(check):
                return after(check, Phase.OFF, self._count + check)
            crossing = self._switch() and steps >= self._steps_until(hysteresis - self._place)
            return after(steps, Phase.HOLDING, self._target, SETTLE_TIME if crossing else 0.0)
        if self._phase is Phase.BACK:
            return self._plan_back(after)
        return None

    def _plan_back(self, after: Callable[..., _End]) -> _End:
        needed = 0.0 if self._switch() else self._steps_until(self._place)
        closes_at = self._count - needed
        if closes_at > SLACK:
            return after(needed, Phase.OFF, self._count, SETTLE_TIME)
        if closes_at > -SLACK:
            return after(needed, Phase.HOLDING, 0, SETTLE_TIME)
        return after(self._count + SLACK, Phase.OFF, -SLACK)
