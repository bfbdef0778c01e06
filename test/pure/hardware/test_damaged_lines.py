"""One damaged byte on the line of the arm's controller. Grbl's lines and the replies of Grbl and
Marlin have no checksum, but a damaged digit must not be taken for the position of the arm."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hardware_faults import expect_fault

from lab.drivers.controller_cell import HOME, ControllerCell
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import HomingStrategy
from tapping_cell.hardware.dialect import StraightMove
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.marlin_dialect import MarlinDialect
from tapping_cell.hardware.motion import MotionSettings, withdraw_path
from tapping_cell.hardware.scara import Joints, ReachCode
from tapping_cell.simulation.fault_layer import Direction, FaultKind, LineFault

DIALECTS = ("grbl", "marlin")
START = Joints(-0.9, 2.2, -0.02, 0.0)
GOAL = Joints(-0.4, 1.9, -0.02, 0.7)
BITS = 7
"""Bits of a byte of ASCII text; a flip of the eighth makes the line unreadable."""


def replies(cell: ControllerCell, act: Callable[[], object]) -> bytes:
    """Return the bytes that the controller sends while ``act`` runs."""
    original, sent = cell.emulator.take_output, bytearray()

    def take(now: float) -> bytes:
        output = original(now)
        sent.extend(output)
        return output

    cell.emulator.take_output = take  # type: ignore[method-assign]
    act()
    cell.emulator.take_output = original  # type: ignore[method-assign]
    return bytes(sent)


def flip(cell: ControllerCell, byte: int, bit: int) -> None:
    """Flip a bit of a byte that the controller sends, counted from now."""
    first = cell.line.count(Direction.TO_HOST)
    cell.line.add(LineFault(FaultKind.FLIP, Direction.TO_HOST, first + byte, bit=bit))


def send_damaged(cell: ControllerCell, old: bytes, new: bytes) -> None:
    """Replace ``old`` by ``new`` in the next line to the controller that contains it."""
    original, done = cell.transport.write, list[bytes]()

    def write(data: bytes, timeout: float = 1.0) -> None:
        if old in data and not done:
            done.append(data)
            data = data.replace(old, new)
        original(data, timeout)

    cell.transport.write = write  # type: ignore[method-assign]


def test_an_arm_sent_beyond_a_joint_limit_must_be_homed() -> None:
    """A real arm has hit its end stop there, so its controller's step count is false."""
    cell = ControllerCell("grbl")
    driver = cell.ready()
    driver.move_to(START)
    send_damaged(cell, b"Y148.", b"Y149.")
    with pytest.raises(HardwareFault, match="elbow is beyond its limit") as caught:
        driver.move_to(START._replace(elbow=2.598))
    fault = caught.value
    assert fault.reason is FaultReason.POSITION_LOST and "was stopped" not in str(fault)
    assert not driver.homed and driver.fault is fault
    with pytest.raises(HardwareFault, match="beyond its limit"):
        driver.move_to(HOME)
    driver.clear_fault()
    with expect_fault(FaultReason.NOT_HOMED):
        driver.move_to(HOME)
    driver.home(HomingStrategy.FIRMWARE)
    driver.move_to(GOAL)


@pytest.mark.parametrize("speed", [0.05, 0.5, 1.0])
def test_an_arm_on_its_way_beyond_a_joint_limit_is_stopped(speed: float) -> None:
    """Otherwise it would push against its end stop until the time limit of the move."""
    cell = ControllerCell("grbl")
    driver = cell.ready()
    driver.move_to(START)
    send_damaged(cell, b"Y133.", b"Y333.")
    with expect_fault(FaultReason.POSITION_LOST, "the arm was stopped"):
        driver.move_to(START._replace(elbow=2.328), speed)
    assert not driver.homed
    cell.wait(1.0)
    assert driver.geometry.upper[1] < cell.truth().elbow < driver.geometry.upper[1] + 0.6


def test_an_arm_sent_elsewhere_within_its_limits_stays_homed() -> None:
    """Nothing has stopped the arm on its way, so its controller's step count is true."""
    cell = ControllerCell("grbl")
    driver = cell.ready()
    send_damaged(cell, b"Y108.", b"Y100.")
    with expect_fault(FaultReason.POSITION_MISMATCH):
        driver.move_to(GOAL)
    assert driver.homed
    driver.move_to(GOAL)
    assert np.allclose(cell.truth(), GOAL, atol=1e-3)


def at_rest(dialect: str) -> tuple[ControllerCell, ArmDriver, bytes]:
    """Return a cell whose arm rests at GOAL, its driver, and the undamaged replies of a reading."""
    cell = ControllerCell(dialect)
    driver = cell.ready()
    driver.move_to(GOAL)
    cell.wait(0.5)
    return cell, driver, replies(cell, driver.read)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_no_flip_of_one_bit_of_a_position_reply_changes_the_reading(dialect: str) -> None:
    cell, driver, reply = at_rest(dialect)
    false = Counter[str]()
    for byte in range(len(reply)):
        for bit in range(byte % 3, BITS, 3):
            cell.wait(0.2)
            flip(cell, byte, bit)
            try:
                reading = driver.read()
            except HardwareFault as fault:
                false[fault.reason.name] += 1
                continue
            if reading.moving or not np.allclose(reading.joints, GOAL, atol=1e-3):
                false[f"{reading}"] += 1
    assert not false


def test_an_undamaged_reply_of_marlin_at_rest_is_asked_for_once() -> None:
    cell = ControllerCell("marlin")
    driver = cell.ready()
    driver.move_to(GOAL)
    assert replies(cell, driver.read).count(b"Count") == 1


@pytest.mark.parametrize("dialect", DIALECTS)
def test_no_flip_of_one_digit_at_the_start_of_a_move_loses_the_position(dialect: str) -> None:
    cell, driver, reply = at_rest(dialect)
    digits = [n for n, byte in enumerate(reply) if chr(byte).isdigit()]
    for n, byte in enumerate(digits):
        cell.wait(0.5)
        flip(cell, byte, n % 4)
        driver.move_to(HOME if n % 2 else GOAL)
    assert driver.homed


@pytest.mark.parametrize("dialect", DIALECTS)
def test_no_flip_of_one_bit_during_homing_gives_a_false_position(dialect: str) -> None:
    """A flip may make homing fail, but homing that succeeds is right and the arm can be moved."""
    cell = ControllerCell(dialect)
    driver = cell.ready()
    sent = replies(cell, lambda: driver.home(HomingStrategy.FIRMWARE))
    after_the_settings = sent.rfind(b"$") + len("$133=123.456")
    digits = [n for n in range(after_the_settings, len(sent)) if chr(sent[n]).isdigit()]
    assert (b"WCO:" if dialect == "grbl" else b"Count") in sent[after_the_settings:]
    for n, byte in enumerate(digits[::5]):
        flip(cell, byte, n % 4)
        driver.home(HomingStrategy.FIRMWARE)
        assert not driver.read().moving
        driver.move_to(GOAL)
        assert np.allclose(driver.read_joints(), cell.truth(), atol=3e-5), (sent, byte)


def test_a_damaged_declaration_of_the_position_is_reported() -> None:
    cell = ControllerCell("grbl")
    driver = cell.ready()
    send_damaged(cell, b"Y90.", b"Y80.")
    with expect_fault(FaultReason.POSITION_MISMATCH):
        driver.home(HomingStrategy.FIRMWARE)
    assert not driver.homed


def test_no_flip_of_one_bit_hides_the_offset_that_marlin_has_kept() -> None:
    """The offset that an earlier program declared is measured while connecting."""
    cell = ControllerCell("marlin")
    driver = cell.ready()
    driver.move_to(GOAL)
    driver.close()

    def connect() -> ArmDriver:
        dialect = MarlinDialect(cell.transport, draw_number=lambda below: below // 3)
        again = ArmDriver(cell.transport, dialect, driver.geometry, driver.settings)
        again.connect()
        return again

    sent = replies(cell, connect)
    first = sent.index(b"Count")
    for byte in range(sent.rindex(b"\n", 0, first), sent.index(b"\n", first), 3):
        flip(cell, byte, byte % 7)
        assert not connect().read().moving, byte


@pytest.mark.parametrize("dialect", DIALECTS)
def test_joints_are_read_at_rest(dialect: str) -> None:
    """A path that is planned from a moving arm would begin where the arm no longer is."""
    cell = ControllerCell(dialect)
    driver = cell.ready()
    target = tuple(unit * joint for unit, joint in zip(cell.dialect.units, GOAL, strict=True))
    cell.dialect.start_moves([StraightMove(target, 6000.0)], cell.clock.now + 5.0)
    cell.wait(0.1)
    assert driver.read().moving
    assert np.allclose(driver.read_joints(), GOAL, atol=1e-3)


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("margin", [0.0, 1e-7, 5e-6])
def test_an_arm_at_a_joint_limit_can_withdraw(dialect: str, margin: float) -> None:
    """The position is reported in thousandths of a degree or in steps, and so a little beyond the
    limit."""
    cell = ControllerCell(dialect)
    driver = cell.ready()
    driver.geometry = replace(driver.geometry, upper=(2.3, 2.4, 0.0, 3.5))
    driver.move_to(Joints(0.1, 2.4 - margin, -0.14, -1.36))
    assert driver.geometry.limit_excess(driver.read().joints)[0] is ReachCode.ELBOW_LIMIT
    driver.follow(withdraw_path(driver.geometry, driver.read_joints(), MotionSettings()))
    with expect_fault(FaultReason.OUT_OF_RANGE):
        driver.move_to(Joints(0.1, 2.4001, -0.02, 0.0))
