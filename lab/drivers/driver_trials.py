"""Taps that the real drivers make with emulated devices over faulty serial lines. The drivers'
results are checked against the devices' true states.

A tap consists of the jobs of the drivers' state machines (``logic.arm_jobs``,
``logic.tapper_jobs``): place the striker, charge, check again that the arm is in position, fire
once, withdraw. The drivers' reports are compared with the true states of the devices.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field, fields
from enum import Enum
from functools import cache, partial
from typing import Any, Protocol

import numpy as np

from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmSettings, HomingStrategy
from tapping_cell.hardware.dialect import ArmDialect
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.grbl_dialect import GrblDialect, GrblSettings
from tapping_cell.hardware.marlin_dialect import MarlinDialect
from tapping_cell.hardware.motion import MotionSettings, Waypoint, strike_path, withdraw_path
from tapping_cell.hardware.scara import Joints, ScaraGeometry, TipPose
from tapping_cell.hardware.tapper import FireOutcome, TapperDriver
from tapping_cell.hardware.tapper_protocol import State
from tapping_cell.hardware.transport import Transport
from tapping_cell.logic import arm_jobs, tapper_jobs
from tapping_cell.logic.arm_jobs import Reading
from tapping_cell.logic.clock import Now
from tapping_cell.simulation.fault_layer import (
    Direction,
    FaultKind,
    FaultLayer,
    LineFault,
    random_fault,
)
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.grbl_machine import GrblMachine
from tapping_cell.simulation.grbl_variants import VARIANTS
from tapping_cell.simulation.marlin_emulator import MarlinEmulator, MarlinMachine
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.virtual_line import HangError, VirtualClock, VirtualTransport

HOME = (0.0, np.pi / 2, 0.0, 0.0)
PARK = (0.6, 1.2, -0.020, 0.0)
TRUE_TOLERANCE = np.array([2e-3, 2e-3, 2e-4, 2e-3])
"""Maximum difference between the true joints and the joints of the strike pose when the striker is
released: rad, rad, m, rad."""
EXPIRY_NS = 600_000_000_000
"""Time limit in ns for the motion to the strike pose."""
CALL_LIMIT = 600.0
"""Simulated time in s after which a tap, with its recoveries, counts as hanging."""
RECOVERIES = 40
"""Number of recovery attempts after which the cell counts as hanging."""
FAULT_COUNTS = (0.35, 0.35, 0.2, 0.1)
"""Fractions of the taps with 0, 1, 2 and 3 planned faults."""


class Dialect(Enum):
    """Type of the arm's controller."""

    GRBL = "grbl"
    MARLIN = "marlin"
    GRBL_MEGA_5X = "grbl-mega-5x"
    GRBL_HAL = "grblhal"
    FLUID_NC_3 = "fluidnc3"
    FLUID_NC_4 = "fluidnc4"


@dataclass
class Tally:
    """Counts of the results. Two tallies can be added."""

    taps: int = 0
    fired: int = 0
    not_fired: int = 0
    unknown: int = 0
    double_fires: int = 0
    unsafe_fires: int = 0
    hangs: int = 0
    false_reports: int = 0
    board_resets_asked: int = 0
    """Number of times that the arm's driver requested a person to press the reset button."""
    faults_struck: int = 0
    cell_seconds: float = 0.0
    by_fault: dict[str, Counter[str]] = field(default_factory=partial(defaultdict, Counter))
    reasons: Counter[str] = field(default_factory=Counter)
    """Reasons why taps ended before the release was requested."""
    notes: list[str] = field(default_factory=list)
    """Descriptions of the first few errors."""

    def add(self, other: Tally) -> None:
        """Add the counts of another tally."""
        for each in fields(self):
            value = getattr(other, each.name)
            if isinstance(value, (int, float)):
                setattr(self, each.name, getattr(self, each.name) + value)
        self.reasons.update(other.reasons)
        for kind, counts in other.by_fault.items():
            self.by_fault[kind].update(counts)
        self.notes = (self.notes + other.notes)[:20]

    @property
    def clean(self) -> bool:
        """Whether no forbidden event occurred."""
        return not (self.double_fires or self.unsafe_fires or self.hangs or self.false_reports)


class Clock(Protocol):
    """Clock of the cell."""

    limit: float
    """Time, on this clock, after which a call counts as hanging, in s."""

    @property
    def now(self) -> float:
        """Current time in s."""


@dataclass(frozen=True, slots=True)
class _Direct:
    """``JobContext`` that runs the state machines' jobs immediately, without concurrency."""

    driver: Any
    transport: Transport

    def now(self) -> Now:
        """Return the time of the serial line, used both as steady time and as ROS time."""
        steady = self.transport.now()
        return Now(steady, round(1e9 * steady))

    def sleep(self, duration: float) -> None:
        """Sleep for ``duration`` s."""
        self.transport.sleep(duration)

    def abandoned(self) -> bool:
        """Return False: a job is never abandoned."""
        return False

    def post(self, content: object) -> None:
        """Discard the progress message."""

    def ask(self, query: Callable[[Now], Any]) -> Any:
        """Call ``query`` with the current time, and return its result."""
        return query(self.now())


class TrialCell:
    """Two emulated devices behind faulty serial lines, their drivers, and checks of the devices'
    true states."""

    def __init__(self, dialect: Dialect, seed: int, clock: Clock | None = None) -> None:
        self.dialect = dialect
        self.rng = np.random.default_rng([seed, list(Dialect).index(dialect)])
        self.clock: Clock = clock or VirtualClock()
        now = self._began = self.clock.now
        self.geometry = ScaraGeometry()
        self.motion = MotionSettings(park=PARK)
        self.tapper_device = TapperEmulator(on_fire=self._record_fire, now=now)
        self.arm_device: GrblEmulator | MarlinEmulator
        if dialect is Dialect.MARLIN:
            self.arm_device = MarlinEmulator(
                MarlinMachine(start_joints=PARK, home_joints=HOME), seed, now
            )
        else:
            machine = GrblMachine(
                start_joints=PARK, home_joints=HOME, variant=VARIANTS[dialect.value]
            )
            self.arm_device = GrblEmulator(machine, seed, now)
        self.arm_line = FaultLayer(self.arm_device)
        self.tapper_line = FaultLayer(self.tapper_device)
        arm_port, tapper_port = self._ports()
        language: ArmDialect
        if dialect is Dialect.MARLIN:
            language = MarlinDialect(arm_port, draw_number=self._draw)
        else:
            without = tuple(sorted(VARIANTS[dialect.value].unhomed_axes))
            language = GrblDialect(
                arm_port, GrblSettings(without_switch=without, needs_homing=True)
            )
        self.arm = ArmDriver(arm_port, language, self.geometry, ArmSettings(home_joints=HOME))
        self.tapper = TapperDriver(tapper_port, draw_number=self._draw)
        self._arm_context = _Direct(self.arm, arm_port)
        self._tapper_context = _Direct(self.tapper, tapper_port)
        self.goal: Joints | None = None
        self.shot = 0
        self.firing = False
        self.release_by = 0.0
        self.reported: dict[int, FireOutcome] = {}
        self.tally = Tally()
        self._seen = [0, 0]

    def _ports(self) -> tuple[Transport, Transport]:
        """Return the drivers' ends of both lines."""
        assert isinstance(self.clock, VirtualClock)
        return (
            VirtualTransport(self.arm_line, self.clock, "arm"),
            VirtualTransport(self.tapper_line, self.clock, "tapper"),
        )

    def _arm_held(self) -> AbstractContextManager[object]:
        """Return a context in which the emulated arm is paused."""
        return nullcontext()

    def _tapper_held(self) -> AbstractContextManager[object]:
        """Return a context in which the emulated tapper is paused."""
        return nullcontext()

    def _draw(self, below: int) -> int:
        return int(self.rng.integers(below))

    def lines(self) -> list[tuple[tuple[str, Direction], FaultLayer]]:
        """Return both lines, by name and direction."""
        return [
            ((name, direction), line)
            for name, line in (("arm", self.arm_line), ("tapper", self.tapper_line))
            for direction in Direction
        ]

    def plan_faults(self) -> None:
        """Plan random faults for this tap."""
        for _ in range(int(self.rng.choice(len(FAULT_COUNTS), p=FAULT_COUNTS))):
            (name, direction), line = self.lines()[int(self.rng.integers(4))]
            span = bytes_of_a_tap(self.dialect)[name, direction]
            with self._tapper_held(), self._arm_held():
                line.add(random_fault(self.rng, direction, line.count(direction), span))

    def tap(self) -> FireOutcome:
        """Recover from any state of the cell, then make one tap. Raises HangError."""
        self.shot += 1
        self.goal = None
        self.clock.limit = self.clock.now + CALL_LIMIT
        self.recover()
        try:
            outcome = self._tap()
        except HardwareFault as fault:
            # The drivers raise a fault only before FIRE is sent. A later fault is reported as the
            # outcome of the shot.
            outcome = FireOutcome.NOT_FIRED
            self.tally.reasons[fault.reason.value] += 1
        self._report(self.shot, outcome)
        # A fault while withdrawing does not change the outcome, because the shot is over. The next
        # tap begins with a recovery of the cell.
        with suppress(HardwareFault):
            arm_jobs.withdraw(
                self._arm_context,
                self._withdrawal,
                not_before=self.clock.now,
                free_at=lambda now: now.steady,
            )
        return outcome

    def _tap(self) -> FireOutcome:
        """Run the jobs of the drivers' state machines, one after another."""
        tip = self.random_tip()
        path = strike_path(self.geometry, self.arm.read_joints(), tip, self.motion)
        goal = path[-1].joints if path else self.arm.read_joints()
        now = self._arm_context.now()
        placed = arm_jobs.place(
            self._arm_context, tip, self.motion, now.ros + EXPIRY_NS, not_before=now.steady
        )
        self._check_place(placed.reading, goal)
        self.goal = goal
        energy = float(self.rng.uniform(0.001, 0.2))
        charged = tapper_jobs.charge(
            self._tapper_context, self.shot, energy, 0, lambda _: None, post_replies=False
        )
        reading = arm_jobs.read(self._arm_context)
        self._check_place(reading, goal)
        there = not reading.moving and self._near(reading.joints, goal)
        if not charged.charged or not reading.homed or not there:
            tapper_jobs.discharge(self._tapper_context)
            return FireOutcome.NOT_FIRED
        self.firing = True
        try:
            return tapper_jobs.fire(
                self._tapper_context, self.shot, self.check, post_replies=False
            ).outcome
        finally:
            self.firing = False

    def _withdrawal(self, here: Joints) -> Sequence[Waypoint]:
        return withdraw_path(self.geometry, here, self.motion)

    def check(self, release_by: float, now: Now) -> None:
        """Store the deadline of the release. The driver calls this function as the last check
        before FIRE."""
        self.release_by = release_by

    def recover(self) -> None:
        """Make both devices accept commands again. Simulate a person who presses the buttons that
        the devices require."""
        last = ""
        for _ in range(RECOVERIES):
            try:
                self._recover_arm()
                self._recover_tapper()
                return
            except HardwareFault as fault:
                last = str(fault)
        raise HangError(f"the cell did not recover in {RECOVERIES} rounds: {last}")

    def _recover_arm(self) -> None:
        try:
            if not self.arm.connected:
                self.arm.connect()
            if self.arm.fault is not None or self.arm.read().alarm:
                self.arm.clear_fault()
        except HardwareFault as fault:
            if fault.reason is FaultReason.NEEDS_PERSON:
                # The error asks an operator to reset the arm's controller. Simulate that.
                self.tally.board_resets_asked += 1
                with self._arm_held():
                    self.arm_device.power_cycle(self.clock.now)
            raise
        if not self.arm.homed:
            if self.dialect is Dialect.GRBL_MEGA_5X:
                self._turn_tool_to_its_mark()
            self.arm.home(HomingStrategy.FIRMWARE)

    def _turn_tool_to_its_mark(self) -> None:
        """Turn an axis without a home switch to its mark, as a person does before homing."""
        assert isinstance(self.arm_device, GrblEmulator)
        with self._arm_held():
            now = self.clock.now
            if not self.arm_device.moving(now):
                here = Joints(*self.arm_device.joints(now))
                self.arm_device.push(here._replace(tool=HOME[3]), now)

    def _recover_tapper(self) -> None:
        if not self.tapper.connected:
            self.tapper.connect()
        reply = self.tapper.status()
        if reply.stop_latched:
            with self._tapper_held():
                self.tapper_device.press_clear_button(self.clock.now)
            reply = self.tapper.clear()
        if reply.state is State.UNHOMED:
            self.tapper.home()

    def random_tip(self) -> TipPose:
        """Return a random tip pose on the table within the arm's reach, in ``arm_base``."""
        while True:
            x, y = self.rng.uniform((0.25, -0.3), (0.7, 0.3))
            tip = TipPose(float(x), float(y), 0.012, float(self.rng.uniform(-3.1, 3.1)))
            if self.geometry.inverse(tip, near=PARK).success:
                return tip

    def _near(self, joints: Joints, goal: Joints) -> bool:
        return bool(np.all(np.abs(np.subtract(joints, goal)) <= TRUE_TOLERANCE))

    def _true_place(self, now: float) -> tuple[Joints, bool]:
        """Return the true joints of the emulated arm, and whether the arm is moving."""
        with self._arm_held():
            return Joints(*self.arm_device.joints(now)), self.arm_device.moving(now)

    def _check_place(self, reading: Reading, goal: Joints) -> None:
        """If the arm's driver reports that the goal is reached, compare the report with the
        true joints."""
        if reading.moving or not self._near(reading.joints, goal):
            return
        truth, moving = self._true_place(self.clock.now)
        if moving or not self._near(truth, goal):
            self.tally.false_reports += 1
            self._note(f"the arm's driver reports {reading.joints}, but the arm is at {truth}")

    def _record_fire(self, shot: int, energy: float, now: float) -> float:
        """Check that a release of the striker is safe, and that it is the only release of its shot.
        Return the striker's speed in m/s."""
        earlier = [s for s, _, _ in self.tapper_device.fires[:-1]]
        if shot in earlier:
            self.tally.double_fires += 1
            self._note(f"shot {shot} was fired twice")
        truth, moving = self._true_place(now)
        why = ""
        if not self.firing or shot != self.shot:
            why = f"shot {shot} was fired outside its firing window (latest shot: {self.shot})"
        elif now > self.release_by:
            late = 1e3 * (now - self.release_by)
            why = f"released {late:.1f} ms after the end of the firing window"
        elif moving:
            why = "the arm was moving"
        elif self.goal is None or not self._near(truth, self.goal):
            why = f"the arm was at {truth}, not at {self.goal}"
        if why:
            self.tally.unsafe_fires += 1
            self._note(f"unsafe release at {now:.2f} s: {why}")
        return float(np.sqrt(energy * 20))

    def _report(self, shot: int, outcome: FireOutcome) -> None:
        self.reported[shot] = outcome
        setattr(self.tally, outcome.value, getattr(self.tally, outcome.value) + 1)

    def check_reports(self) -> None:
        """Compare every report with the tapper's actual shots, including shots fired after the
        report."""
        fired = {shot for shot, _, _ in self.tapper_device.fires}
        for shot, outcome in self.reported.items():
            if outcome is not FireOutcome.UNKNOWN and (
                (outcome is FireOutcome.FIRED) != (shot in fired)
            ):
                self.tally.false_reports += 1
                self._note(f"shot {shot} was wrongly reported as {outcome.value}")

    def final_tally(self) -> Tally:
        """Compare every report with the actual shots, and return all counts of this cell."""
        self.check_reports()
        self.tally.faults_struck = len(self.arm_line.happened) + len(self.tapper_line.happened)
        self.tally.cell_seconds = self.clock.now - self._began
        return self.tally

    def forget(self) -> None:
        """Discard the recorded faults, shots and reports, and cancel the scheduled faults."""
        for line in (self.arm_line, self.tapper_line):
            line.happened.clear()
            line.forget()
        self._seen = [0, 0]
        self.tapper_device.fires.clear()
        self.reported.clear()

    def struck(self) -> list[FaultKind]:
        """Return the kinds of the faults that occurred since the last call."""
        kinds: list[FaultKind] = []
        for index, line in enumerate((self.arm_line, self.tapper_line)):
            kinds += [fault.kind for _, fault in line.happened[self._seen[index] :]]
            self._seen[index] = len(line.happened)
        return kinds

    def _note(self, text: str) -> None:
        if len(self.tally.notes) < 20:
            self.tally.notes.append(text)


def virtual_cell(dialect: Dialect, seed: int) -> AbstractContextManager[TrialCell]:
    """Create a cell in simulated time."""
    return nullcontext(TrialCell(dialect, seed))


@cache
def bytes_of_a_tap(dialect: Dialect) -> dict[tuple[str, Direction], int]:
    """Return the number of bytes that a tap without faults sends on each line in each direction."""
    cell = TrialCell(dialect, 0)
    cell.recover()
    before = {key: line.count(key[1]) for key, line in cell.lines()}
    cell.tap()
    return {key: line.count(key[1]) - before[key] for key, line in cell.lines()}


def run_sweep(
    dialect: Dialect, kind: FaultKind, line: str, direction: Direction, places: range
) -> Tally:
    """For each given byte position, make one tap with a fault at that byte, then one tap without
    a fault."""
    total = Tally()
    for place in places:
        cell = TrialCell(dialect, 0)
        try:
            cell.recover()
            chosen = cell.arm_line if line == "arm" else cell.tapper_line
            at = chosen.count(direction) + place
            chosen.add(LineFault(kind, direction, at, duration=0.4))
            outcome = cell.tap()
            cell.tally.by_fault[kind.value][outcome.value] += 1
            cell.tap()
            cell.tally.taps += 2
        except HangError as hang:
            cell.tally.hangs += 1
            cell.tally.notes.append(f"{kind.value} at byte {place} {direction.value}: {hang}")
        total.add(cell.final_tally())
    return total


def run_taps(
    dialect: Dialect,
    taps: int,
    seed: int,
    prepare: Callable[[TrialCell], None] | None = None,
    make: Callable[[Dialect, int], AbstractContextManager[TrialCell]] = virtual_cell,
) -> Tally:
    """Make ``taps`` taps. ``prepare`` plans the faults before each tap (None: random faults)."""
    total = Tally()
    done = 0
    while done < taps:
        # After a hang, the state of the drivers is unknown, so the run continues with a new cell.
        with make(dialect, seed + 1_000_003 * total.hangs) as cell:
            try:
                while done < taps:
                    done += 1
                    cell.tally.taps += 1
                    (prepare or TrialCell.plan_faults)(cell)
                    outcome = cell.tap()
                    for kind in set(cell.struck()) or (None,):
                        name = kind.value if kind else "none"
                        cell.tally.by_fault[name][outcome.value] += 1
            except HangError as hang:
                cell.tally.hangs += 1
                cell.tally.notes.append(str(hang))
            total.add(cell.final_tally())
    return total
