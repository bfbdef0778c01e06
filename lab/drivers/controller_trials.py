"""Trials of the arm driver with every emulated controller: moves, and faults during moves.

After each fault, the reason and the message must be correct, the arm must stand still, no move may
succeed before homing, and the move after homing must be exact.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from lab.drivers.controller_cell import GRBL_NAMES, HOME, NAMES, ControllerCell
from tapping_cell.hardware.arm_settings import ArmSettings, HomingStrategy
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.scara import Joints
from tapping_cell.simulation.fault_layer import Direction, FaultKind, LineFault
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.grbl_variants import GRBL_3_AXES
from tapping_cell.simulation.marlin_emulator import MarlinEmulator

FAR = (1.5, 0.5, -0.1, 1.0)
FAR_SPEED = 0.3
LATEST = 0.7
"""Maximum time from the start of a move to ``FAR`` to a fault during this move, s. The whole move
takes longer than this time."""
CLOSE = 1e-3
"""Maximum difference between the true joints and their target, rad or m."""
STILL = 0.02
"""Maximum rotation of shoulder and elbow after the driver has reported a fault, rad. The arm must
then stand still."""
LOW, HIGH = (-1.0, 0.4, -0.12, -1.5), (1.0, 2.0, 0.0, 1.5)
"""Range of the targets."""


class WrongError(Exception):
    """The driver returned a wrong result, or the arm is at a wrong position."""


@dataclass(slots=True)
class Outcome:
    """Trials of one kind on one controller."""

    tried: int = 0
    wrong: list[str] = field(default_factory=list)


def run_moves(name: str, count: int, seed: int) -> Outcome:
    """Connect, home, and make ``count`` random moves, each compared with the true joints."""
    rng = np.random.default_rng([seed, NAMES.index(name)])
    cell = ControllerCell(name, seed=seed)
    cell.ready()
    outcome = Outcome()
    for _ in range(count):
        outcome.tried += 1
        try:
            _move(cell, rng)
        except (WrongError, HardwareFault) as error:
            outcome.wrong.append(str(error))
            cell.home_again()
    return outcome


def run_faults(name: str, kind: str, count: int, seed: int) -> Outcome:
    """Run ``count`` trials of one kind of fault."""
    rng = np.random.default_rng([seed, NAMES.index(name), list(FAULTS).index(kind)])
    outcome = Outcome()
    for number in range(count):
        outcome.tried += 1
        cell = ControllerCell(name, seed=seed + number)
        try:
            FAULTS[kind].run(cell, rng)
        except (WrongError, HardwareFault) as error:
            outcome.wrong.append(str(error))
    return outcome


@dataclass(frozen=True, slots=True)
class Fault:
    """One kind of fault. ``findings``: label of the review finding that the fault reproduces, as
    shown in the benchmark's results; empty if there is none."""

    run: Callable[[ControllerCell, np.random.Generator], None]
    findings: str = ""
    controllers: tuple[str, ...] = NAMES


def _move(cell: ControllerCell, rng: np.random.Generator) -> None:
    goal = rng.uniform(LOW, HIGH)
    reading = cell.driver.move_to(goal, 1.0)
    if not np.allclose(reading.joints, goal, atol=CLOSE):
        raise WrongError(f"a move to {goal} ended, but the driver reads {reading.joints}")
    _check_truth(cell, Joints(*goal.tolist()))


def _check_truth(cell: ControllerCell, goal: Joints) -> None:
    """Raise if a move that was reported as successful did not end at its target, or ended without
    holding torque."""
    if not cell.emulator.holds:
        raise WrongError(f"after a successful move to {goal} the motors hold no torque")
    if not np.allclose(cell.truth(), goal, atol=CLOSE):
        raise WrongError(f"a move to {goal} succeeded, but the arm is at {cell.truth()}")


def _expect(act: Callable[[], object], reason: FaultReason, words: str) -> None:
    """Raise WrongError unless ``act`` raises a fault with this ``reason`` and a message that
    matches the pattern ``words``."""
    try:
        act()
    except HardwareFault as fault:
        if fault.reason is reason and re.search(words, str(fault)):
            return
        raise WrongError(f"{fault.reason.value}: {fault}") from fault
    raise WrongError(f"no fault, but {reason.value} was expected")


def _far(cell: ControllerCell) -> Callable[[], object]:
    return partial(cell.driver.move_to, FAR, FAR_SPEED)


def _start_far(
    cell: ControllerCell, rng: np.random.Generator, act: Callable[[], object]
) -> Callable[[], object]:
    """Home and make a move. Return a function that makes a long move, during which ``act`` is
    called."""
    cell.ready()
    _move(cell, rng)
    cell.during_the_next_move(float(rng.uniform(0.02, LATEST)), act)
    return _far(cell)


def _recover(cell: ControllerCell, rng: np.random.Generator) -> None:
    """Check that the arm stands still and that moves remain refused, then home and move."""
    here = cell.truth()
    cell.wait(2.0)
    if not np.allclose(cell.truth()[:2], here[:2], atol=STILL):
        raise WrongError(f"the arm kept moving, from {here} to {cell.truth()}")
    if cell.driver.homed:
        raise WrongError("the arm still counts as homed after the fault")
    _home_and_move(cell, rng)


def _home_and_move(cell: ControllerCell, rng: np.random.Generator) -> None:
    cell.driver.clear_fault()
    _expect(_far(cell), FaultReason.NOT_HOMED, "the arm is not homed: home it first")
    cell.home_again()
    _move(cell, rng)


def _stop(cell: ControllerCell, rng: np.random.Generator) -> None:
    move = _start_far(cell, rng, cell.driver.stop)
    words = "the arm was stopped: make the cell safe.*home again.*quill without a brake then sinks"
    _expect(move, FaultReason.STOPPED, words)
    _recover(cell, rng)


def _unplug(cell: ControllerCell, rng: np.random.Generator) -> None:
    absence = float(rng.uniform(0.1, 3.0))
    move = _start_far(cell, rng, lambda: cell.unplug(absence))
    _expect(move, FaultReason.DISCONNECTED, "went away")
    cell.driver.connect()
    _expect(_far(cell), FaultReason.NOT_HOMED, "the arm is not homed: home it first")
    # Wait until the controller has finished the move that it received before the disconnection.
    cell.wait(10.0)
    _home_and_move(cell, rng)


def _alarm(cell: ControllerCell, rng: np.random.Generator) -> None:
    """The controller raises an alarm during a move. With Grbl, a limit switch is hit and the board
    restarts afterwards. With Marlin, another sender sends M112."""
    emulator = cell.emulator

    def hit() -> None:
        if isinstance(emulator, GrblEmulator):
            emulator.hit_limit(cell.clock.now)
            emulator.receive(b"\x18", cell.clock.now)
        else:
            emulator.receive(b"\nM112\n", cell.clock.now)

    is_grbl = isinstance(emulator, GrblEmulator)
    words = "a limit switch was hit" if is_grbl else "halted"
    _expect(_start_far(cell, rng, hit), FaultReason.ALARM, words)
    for _ in range(3):
        _expect(cell.driver.read_joints, FaultReason.ALARM, words)
    if not is_grbl:
        _expect(
            lambda: cell.driver.clear_fault(1.0), FaultReason.NEEDS_PERSON, "press the reset button"
        )
        emulator.power_cycle(cell.clock.now)
    _recover(cell, rng)


def _restart(cell: ControllerCell, rng: np.random.Generator) -> None:
    move = _start_far(cell, rng, lambda: cell.emulator.power_cycle(cell.clock.now))
    _expect(move, FaultReason.BOARD_RESET, "restarted.*clear the fault and home again")
    _recover(cell, rng)


def _sleep(cell: ControllerCell, rng: np.random.Generator) -> None:
    """A sleep command switches the motors off while the arm stands still."""
    cell.ready()
    _move(cell, rng)
    cell.emulator.receive(b"$SLP\n", cell.clock.now)
    words = "asleep: its motors may have been without power"
    _expect(cell.driver.read, FaultReason.POSITION_LOST, words)
    _expect(_far(cell), FaultReason.POSITION_LOST, words)
    _recover(cell, rng)


def _late_answer(cell: ControllerCell, rng: np.random.Generator) -> None:
    """An answer is so late that the next line may have been sent before it arrives."""
    cell.ready()
    at = cell.line.count(Direction.TO_HOST) + int(rng.integers(0, 120))
    delay = float(rng.uniform(0.55, 1.9))
    cell.line.add(LineFault(FaultKind.DELAY, Direction.TO_HOST, at, duration=delay))
    for _ in range(4):
        _move(cell, rng)
        if cell.emulator.moving(cell.clock.now):
            raise WrongError("a move was reported as successful while the arm was still moving")


def _feed_override(cell: ControllerCell, rng: np.random.Generator) -> None:
    cell.ready()
    cell.driver.move_to(HOME, 1.0)
    cell.driver.read()
    cell.emulator.receive(b"\x92" * 9, cell.clock.now)
    words = "override of 10 %.*the arm was stopped"
    _expect(lambda: cell.driver.move_to(FAR, 0.5), FaultReason.TIMEOUT, words)
    cell.wait(0.5)
    _recover(cell, rng)


def _endless_homing(cell: ControllerCell, rng: np.random.Generator) -> None:
    cell.driver.settings = ArmSettings(home_joints=HOME, homing_timeout=1.0)
    cell.driver.connect()
    if cell.driver.read().alarm:
        cell.driver.clear_fault()
    emulator = cell.emulator
    if isinstance(emulator, MarlinEmulator):
        emulator.machine = replace(emulator.machine, homing_rate=2.0)
    else:
        emulator.receive(b"$24=60\n$25=60\n", cell.clock.now)
        cell.wait(0.1)
    words = "homing has not ended within .* s .*arm.homing_timeout.*the arm was stopped"
    homing = partial(cell.driver.home, HomingStrategy.FIRMWARE)
    _expect(homing, FaultReason.TIMEOUT, words)
    cell.wait(0.5)
    if cell.emulator.moving(cell.clock.now):
        raise WrongError("homing continued")


def _no_holding_torque(cell: ControllerCell, rng: np.random.Generator) -> None:
    for line in (b"$1=25\n", b"$/stepping/idle_ms=25\n"):
        cell.emulator.receive(line, cell.clock.now)
    words = r"is 25, must be 255: .*torque.*\(send \$(1|/stepping/idle_ms)=255"
    _expect(cell.driver.connect, FaultReason.SETTINGS_MISMATCH, words)


def _work_position(cell: ControllerCell, rng: np.random.Generator) -> None:
    cell.emulator.receive(b"$10=0\n", cell.clock.now)
    began = cell.clock.now
    words = r"\$10 is 0, (must be odd.*send \$10=1|bits 0 and 5 must be set.*send \$10=33)"
    _expect(cell.driver.connect, FaultReason.SETTINGS_MISMATCH, words)
    if cell.clock.now - began > 5.0:
        raise WrongError(f"connecting failed only after {cell.clock.now - began:.1f} s (limit 5 s)")


def _three_axes(cell: ControllerCell, rng: np.random.Generator) -> None:
    three = ControllerCell("grbl", change=lambda machine: replace(machine, variant=GRBL_3_AXES))
    words = r"has 3 axes \(XYZ\), but 4 are needed"
    _expect(three.driver.connect, FaultReason.UNKNOWN_FIRMWARE, words)


def _unswitched_axis(cell: ControllerCell, rng: np.random.Generator) -> None:
    """The tool's axis is not homed, and axes_without_switch in the cell file does not list it."""
    emulator = cell.emulator
    emulator.receive(b"$46=0\n$/axes/a/homing/cycle=0\n", cell.clock.now)
    words = "homing leaves out axis A .*axes_without_switch"
    _expect(cell.driver.connect, FaultReason.SETTINGS_MISMATCH, words)


def _forced_origin(cell: ControllerCell, rng: np.random.Generator) -> None:
    cell.emulator.receive(b"$22=9\n", cell.clock.now)
    cell.wait(0.1)
    cell.ready()
    _move(cell, rng)


FAULTS = {
    "stop in mid-move": Fault(_stop),
    "unplugged in mid-move": Fault(_unplug),
    "alarm in mid-move": Fault(_alarm, "C6"),
    "restart in mid-move": Fault(_restart),
    "motors asleep": Fault(_sleep, "C1", GRBL_NAMES),
    "no holding torque": Fault(_no_holding_torque, "C1", GRBL_NAMES),
    "three axes": Fault(_three_axes, "C3", ("grbl",)),
    "unswitched tool": Fault(_unswitched_axis, "C3", ("grblhal", "fluidnc3", "fluidnc4")),
    "forced origin": Fault(_forced_origin, "C3", ("grblhal",)),
    "work position in reports": Fault(_work_position, "C4", GRBL_NAMES),
    "late answer": Fault(_late_answer, "C5"),
    "slowed by an override": Fault(_feed_override, "C7", GRBL_NAMES),
    "homing does not end": Fault(_endless_homing, "C7"),
}
"""Kinds of faults, by name."""
