"""Replies that are unreadable for a long time, because of a wrong baud rate, interference or other
firmware."""

from __future__ import annotations

import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from wrong_baud import WrongBaud, sampled

from lab.trial import shipped_cell
from tapping_cell.configuration.arm_assembly import make_arm_driver
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.marlin_dialect import MarlinDialect
from tapping_cell.hardware.tapper import TapperDriver
from tapping_cell.logic.error_codes import of_arm, of_tapper
from tapping_cell.messages import ErrorCode
from tapping_cell.simulation.device_emulator import DeviceEmulator
from tapping_cell.simulation.devices import arm_emulator
from tapping_cell.simulation.fault_layer import Direction, FaultKind, FaultLayer, LineFault
from tapping_cell.simulation.marlin_emulator import MarlinEmulator, MarlinMachine
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.truth import ArmTruth
from tapping_cell.simulation.virtual_line import VirtualClock, VirtualTransport

DIALECTS = ("grbl", "marlin")
OTHER_RATES = (9600, 57600, 230400, 250000)


class Line:
    """A board on a line in virtual time."""

    def __init__(self, board: DeviceEmulator) -> None:
        self.layer = FaultLayer(board)
        self.clock = VirtualClock()
        self.transport = VirtualTransport(self.layer, self.clock, "the port")

    def disturb(self, every: int, count: int = 4000, start: int = 0) -> None:
        """Flip a bit in every ``every``-th byte from the board, after ``start`` bytes."""
        way = Direction.TO_HOST
        first = self.layer.count(way) + start
        for number in range(count):
            byte = first + every * number
            self.layer.add(LineFault(FaultKind.FLIP, way, byte, bit=number % 7))


def board_of(dialect: str) -> DeviceEmulator:
    return arm_emulator(shipped_cell(dialect).arm, ArmTruth(), 1, 0.0)


def arm_on(line: Line, dialect: str, number: int = 10**7) -> ArmDriver:
    """Return the driver of an arm. ``number`` is added to Marlin's lowest first line number."""
    return make_arm_driver(shipped_cell(dialect).arm, line.transport, lambda below: number)


@given(st.binary(max_size=60), st.sampled_from((9600.0, 115200.0, 250000.0)))
def test_equal_baud_rates_change_no_byte(data: bytes, rate: float) -> None:
    assert sampled(data, rate, rate) == data


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("rate", OTHER_RATES)
def test_an_arm_at_another_baud_rate_is_unreadable(dialect: str, rate: int) -> None:
    board = board_of(dialect)
    board.power_cycle(0.0)  # opening the port restarts most boards, which then send a greeting
    line = Line(WrongBaud(board, 115200, rate))
    with pytest.raises(HardwareFault) as caught:
        arm_on(line, dialect).connect(1.0)
    assert of_arm(caught.value) == ErrorCode.ARM_REPLY_GARBLED, caught.value
    assert "not text" in str(caught.value) and "check arm.baud" in str(caught.value)


@pytest.mark.parametrize("rate", OTHER_RATES)
def test_a_tapper_at_another_baud_rate_never_looks_like_a_tapper(rate: int) -> None:
    """The board does not answer lines that it cannot read, so most baud rates result in a
    timeout."""
    line = Line(WrongBaud(TapperEmulator(), 115200, rate))
    with pytest.raises(HardwareFault) as caught:
        TapperDriver(line.transport).connect(1.0)
    assert caught.value.reason in (FaultReason.PROTOCOL, FaultReason.UNKNOWN_FIRMWARE)


@given(st.sampled_from(DIALECTS), st.integers(1, 8), st.integers(0, 2))
@example("marlin", 6, 0)  # the damage to the line ends leaves only two lines
def test_interference_on_the_line_of_a_connected_arm_is_reported(dialect, digits, phase):
    line = Line(board_of(dialect))
    driver = arm_on(line, dialect, 10**digits - 10**digits // 3)
    driver.connect()
    line.disturb(3, start=phase)
    with pytest.raises(HardwareFault) as caught:
        driver.read()
    assert of_arm(caught.value) == ErrorCode.ARM_REPLY_GARBLED, caught.value
    assert re.search(
        r"lines from the arm's controller on the port were unreadable|"
        r"bytes from the arm's controller on the port contained no readable line",
        str(caught.value),
    )


@pytest.mark.parametrize("every", [3, 5, 7])
def test_interference_on_the_line_of_a_connected_tapper_is_reported(every: int) -> None:
    line = Line(TapperEmulator())
    driver = TapperDriver(line.transport)
    driver.connect()
    line.disturb(every)
    with pytest.raises(HardwareFault) as caught:
        driver.status()
    assert of_tapper(caught.value) == ErrorCode.TAPPER_REPLY_GARBLED
    assert "of 5 requests were damaged" in str(caught.value)
    assert "check tapper.baud" in str(caught.value)


def test_interference_during_the_tapper_greeting_is_reported() -> None:
    line = Line(TapperEmulator())
    line.disturb(7)
    with pytest.raises(HardwareFault) as caught:
        TapperDriver(line.transport).connect(1.0)
    assert of_tapper(caught.value) == ErrorCode.TAPPER_REPLY_GARBLED


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_silent_or_foreign_board_is_not_reported_as_unreadable(dialect: str) -> None:
    other = DIALECTS[1 - DIALECTS.index(dialect)]
    for board in (TapperEmulator(), board_of(other)):
        with pytest.raises(HardwareFault) as caught:
            arm_on(Line(board), dialect).connect(1.0)
        assert of_arm(caught.value) == ErrorCode.ARM_FIRMWARE_UNKNOWN, caught.value
    with pytest.raises(HardwareFault) as caught:
        TapperDriver(Line(board_of(dialect)).transport).connect(1.0)
    assert of_tapper(caught.value) == ErrorCode.TAPPER_FIRMWARE_UNKNOWN, caught.value


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_few_damaged_lines_are_tolerated_and_a_lost_line_is_a_timeout(dialect: str) -> None:
    line = Line(board_of(dialect))
    driver = arm_on(line, dialect)
    driver.connect()
    line.disturb(1, count=2)
    driver.read()
    assert driver.line_counters.bad_lines > 0
    way = Direction.TO_HOST
    line.layer.add(LineFault(FaultKind.DROP, way, line.layer.count(way), 10**6))
    with pytest.raises(HardwareFault) as caught:
        driver.read()
    assert of_arm(caught.value) == ErrorCode.ARM_TIMEOUT


class UnreliableMarlin(MarlinEmulator):
    """A board whose replies to one line are lost, or whose next reply requests an earlier line."""

    def __init__(self) -> None:
        super().__init__(MarlinMachine())
        self.number = 0
        """Number of the last line received."""
        self.lost: int | None = None
        """Number of the line whose replies are lost."""
        self.requests: int | None = None

    def receive(self, data: bytes, now: float) -> None:
        """Execute the line and remember its number."""
        numbers = re.findall(rb"N(\d+)", data)
        self.number = int(numbers[-1]) if numbers else self.number
        super().receive(data, now)

    def take_output(self, now: float) -> bytes:
        """Return the replies, or what replaces them in this test."""
        output = super().take_output(now)
        if self.number == self.lost:
            return b""
        if output and self.requests is not None:
            output, self.requests = b"Resend: %d\nok\n" % self.requests, None
        return output


@given(st.integers(0, 9))
def test_a_marlin_that_requests_any_earlier_line_is_answered(age: int) -> None:
    """A wrong digit in a Resend can name any line that was sent earlier."""
    board = UnreliableMarlin()
    line = Line(board)
    dialect = MarlinDialect(line.transport)
    line.transport.open(1.0)
    dialect.connect(60.0)
    for _ in range(4):
        dialect.read(60.0)
    # After a lost answer, the driver sends the same command again with a new line number.
    board.lost = board.number + 1
    dialect.read(60.0)
    board.requests = board.number - age
    assert dialect.read(60.0).axes == dialect.read(60.0).axes
