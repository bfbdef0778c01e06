"""Connecting identifies the board and compares its settings with the cell file, tested with the
real drivers and emulated boards in virtual time."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hardware_faults import expect_fault

from tapping_cell.configuration.arm_assembly import make_arm_driver
from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import HomingStrategy
from tapping_cell.hardware.controller_needs import ControllerNeeds, needs_of
from tapping_cell.hardware.controllers import CONTROLLERS
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.grbl_dialect import GrblDialect, GrblSettings
from tapping_cell.hardware.marlin_dialect import MarlinDialect, MarlinSettings
from tapping_cell.hardware.scara import ScaraGeometry
from tapping_cell.hardware.tapper import TapperDriver
from tapping_cell.simulation.arm_emulator import ArmEmulator
from tapping_cell.simulation.device_emulator import DeviceEmulator
from tapping_cell.simulation.devices import arm_emulator
from tapping_cell.simulation.fault_layer import FaultLayer
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.grbl_machine import GrblMachine, default_settings
from tapping_cell.simulation.marlin_emulator import MarlinEmulator, MarlinMachine
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.truth import ArmTruth
from tapping_cell.simulation.virtual_line import VirtualClock, VirtualTransport

MILD = ControllerNeeds(
    speed=(100.0, 100.0, 200.0, 300.0),
    acceleration=(400.0, 500.0, 1500.0, 1500.0),
    travel=(100.0, 100.0, 100.0, 100.0),
    steps=(200.0, 200.0, 400.0, 100.0),
)


def line_to(board: DeviceEmulator) -> VirtualTransport:
    clock = VirtualClock()
    clock.limit = 120.0
    return VirtualTransport(FaultLayer(board), clock, "port")


def grbl(needs: ControllerNeeds, **settings: float) -> ArmDriver:
    values = default_settings() | {int(name[1:]): value for name, value in settings.items()}
    line = line_to(GrblEmulator(GrblMachine(settings=values)))
    return ArmDriver(line, GrblDialect(line, GrblSettings(needs=needs)), ScaraGeometry())


def marlin(needs: ControllerNeeds, machine: MarlinMachine | None = None) -> ArmDriver:
    line = line_to(MarlinEmulator(machine or MarlinMachine()))
    return ArmDriver(line, MarlinDialect(line, MarlinSettings(needs=needs)), ScaraGeometry())


@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_controller_of_the_folder_connects_to_its_emulator(name: str) -> None:
    arm = replace(load_cell().arm, dialect=name)
    line = line_to(arm_emulator(arm, ArmTruth(), 1, 0.0))
    assert make_arm_driver(arm, line).connect().name.lower().startswith(name)


def test_settings_that_allow_the_moves_are_accepted() -> None:
    assert grbl(MILD).connect().name == "Grbl"
    assert marlin(MILD).connect().remarks == ()


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("s100", 88.9, r"\$100 is 88.9, must be 200"),
        ("s111", 5000.0, r"\$111 is 5000, must be at least 6000"),
        ("s122", 20.0, r"\$122 is 20, must be at least 1500"),
    ],
)
def test_a_grbl_with_other_settings_is_refused_with_both_values(setting, value, words):
    with expect_fault(FaultReason.SETTINGS_MISMATCH, words):
        grbl(MILD, **{setting: value}).connect()


def test_soft_limits_of_grbl_count_only_if_enabled() -> None:
    assert grbl(MILD, s130=50.0).connect()
    with pytest.raises(HardwareFault, match=r"\$130 is 50, must be at least 100"):
        grbl(MILD, s130=50.0, s20=1.0).connect()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"steps": (80.0, 200.0, 400.0, 100.0)}, "M92 X is 80, must be 200"),
        ({"max_rate": (115.0, 50.0, 250.0, 345.0)}, "M203 Y is 50, must be at least 100"),
        ({"acceleration": (458.0, 573.0, 20.0, 1720.0)}, "M201 Z is 20, must be at least 1500"),
        (
            {"soft_endstops": True, "soft_high": (60.0,) * 4},
            "M211 range A is 60, must be at least 100",
        ),
        (
            {"soft_endstops": True, "soft_high": (60.0,) * 4, "two_lines": True},
            "M211 range A is 60, must be at least 100",
        ),
        (
            {"soft_endstops": True, "soft_high": (60.0,) * 3, "two_lines": True},
            "M211 is on, must be off",
        ),
    ],
    ids=["steps", "rate", "acceleration", "soft end stops", "since 2.0.9", "unknown limits"],
)
def test_a_marlin_with_other_settings_is_refused_with_both_values(change, words):
    with expect_fault(FaultReason.SETTINGS_MISMATCH, words):
        marlin(MILD, replace(MarlinMachine(), **change)).connect()  # type: ignore[arg-type]


def without_first(board: ArmEmulator, lost: bytes) -> None:
    """Make the first line with ``lost`` that the board sends unreadable."""
    original, spoilt = board.take_output, list[bytes]()

    def take(now: float) -> bytes:
        output = original(now)
        if lost in output and not spoilt:
            spoilt.append(output)
            output = output.replace(lost, b"\x7f" * len(lost), 1)
        return output

    board.take_output = take  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("number", "lost"), [(n, n) for n in (100, 103, 111, 113, 120, 122, 130, 133)] + [(130, 20)]
)
def test_a_lost_line_does_not_hide_an_unsuitable_setting_of_grbl(number: int, lost: int) -> None:
    values = default_settings() | {20: 1.0, number: 1.0}
    board = GrblEmulator(GrblMachine(settings=values))
    without_first(board, b"$%d=" % lost)
    line = line_to(board)
    driver = ArmDriver(line, GrblDialect(line, GrblSettings(needs=MILD)), ScaraGeometry())
    with pytest.raises(HardwareFault, match=rf"\${number} is 1, must be"):
        driver.connect()


@pytest.mark.parametrize("lost", [100, 101, 112, 123, 131, 20])
def test_a_lost_line_of_suitable_settings_of_grbl_is_asked_for_again(lost: int) -> None:
    board = GrblEmulator(GrblMachine(settings=default_settings() | {20: 1.0}))
    without_first(board, b"$%d=" % lost)
    line = line_to(board)
    driver = ArmDriver(line, GrblDialect(line, GrblSettings(needs=MILD)), ScaraGeometry())
    assert driver.connect().name == "Grbl"


@pytest.mark.parametrize(
    ("change", "words", "lost"),
    [
        ({"steps": (80.0, 200.0, 400.0, 100.0)}, "M92 X is 80", b"M92 "),
        ({"max_rate": (115.0, 50.0, 250.0, 345.0)}, "M203 Y is 50", b"M203 "),
        ({"acceleration": (458.0, 573.0, 20.0, 1720.0)}, "M201 Z is 20", b"M201 "),
        ({"soft_endstops": True, "soft_high": (60.0,) * 4}, "M211 range A is 60", b"Soft end"),
    ],
    ids=["steps", "rate", "acceleration", "soft end stops"],
)
def test_a_lost_line_does_not_hide_an_unsuitable_setting_of_marlin(change, words, lost):
    board = MarlinEmulator(replace(MarlinMachine(), **change))  # type: ignore[arg-type]
    without_first(board, lost)
    line = line_to(board)
    driver = ArmDriver(line, MarlinDialect(line, MarlinSettings(needs=MILD)), ScaraGeometry())
    with pytest.raises(HardwareFault, match=words):
        driver.connect()


def test_a_marlin_that_can_only_be_killed_is_reported() -> None:
    (remark,) = marlin(MILD, MarlinMachine(emergency_parser=False)).connect().remarks
    assert "EMERGENCY_PARSER" in remark and "M112" in remark


class OneBadAnswer(MarlinEmulator):
    """A Marlin whose first report about its emergency parser is lost or has one wrong bit."""

    def __init__(self, present: bool, spoilt: bytes) -> None:
        super().__init__(MarlinMachine(emergency_parser=present))
        self._true = b"Cap:EMERGENCY_PARSER:%d\n" % present
        self._spoilt: bytes | None = spoilt

    def take_output(self, now: float) -> bytes:
        out = super().take_output(now)
        if self._spoilt is not None and self._true in out:
            out, self._spoilt = out.replace(self._true, self._spoilt), None
        return out


@pytest.mark.parametrize(
    ("present", "spoilt"),
    [
        (True, b"Cap:EMERPARSER:1\n"),
        (True, b"Cap:EMERGENCY_PARSER:0\n"),
        (False, b"Cap:EMERGENCY_PARSER:1\n"),
    ],
)
def test_one_corrupt_line_does_not_change_how_marlin_is_stopped(present, spoilt):
    """A board with the emergency parser must be stopped by M410, because M112 would halt it
    permanently. A board without this parser would not be stopped by M410."""
    line = line_to(OneBadAnswer(present, spoilt))
    dialect = MarlinDialect(line)
    ArmDriver(line, dialect, ScaraGeometry()).connect()
    assert dialect.stop_bytes == (b"\nM410\n" if present else b"\nM112\n")


def test_a_marlin_silent_after_reconnection_requires_its_reset_button() -> None:
    board = MarlinEmulator()
    line = line_to(board)
    driver = ArmDriver(line, MarlinDialect(line), ScaraGeometry())
    driver.connect()
    board.receive(b"M112\n", line.now())
    driver.close()
    for _ in range(2):
        with expect_fault(FaultReason.NEEDS_PERSON, "press the reset button"):
            driver.connect(2.0)
        assert not line.is_open
    board.power_cycle(line.now())
    assert not driver.connect().continued
    assert driver.fault is None and not driver.homed


def test_the_required_settings_follow_from_the_geometry_in_degrees_and_mm() -> None:
    needs = needs_of(ScaraGeometry(max_speed=(math.pi, 1.0, 0.25, 1.0)), (1.0, 2.0, 3.0, 4.0))
    assert needs.speed is not None and needs.steps == (1.0, 2.0, 3.0, 4.0)
    assert needs.speed[0] == pytest.approx(180.0) and needs.speed[2] == pytest.approx(250.0)


def noise(now: float) -> bytes:
    return np.random.default_rng(int(1000 * now)).bytes(40)


class NoisyDevice:
    """A device that answers each message with lines of noise."""

    def __init__(self) -> None:
        self._out = b""

    def receive(self, data: bytes, now: float) -> None:
        self._out += noise(now) + b"\nok\n@1,1,OK*0000\n<Idle|>\nResend: 7\n"

    def advance(self, now: float) -> None:
        """Do nothing: the device sends nothing by itself."""

    def take_output(self, now: float) -> bytes:
        out, self._out = self._out, b""
        return out

    def next_event(self) -> float | None:
        return None

    def power_cycle(self, now: float) -> None:
        """Do nothing: the device has no state to lose."""


DRIVERS: dict[str, Callable[[VirtualTransport], ArmDriver | TapperDriver]] = {
    "grbl": lambda line: ArmDriver(line, GrblDialect(line), ScaraGeometry()),
    "marlin": lambda line: ArmDriver(line, MarlinDialect(line), ScaraGeometry()),
    "tapper": TapperDriver,
}
BOARDS: dict[str, Callable[[], DeviceEmulator]] = {
    "grbl": GrblEmulator,
    "marlin": MarlinEmulator,
    "tapper": TapperEmulator,
    "noise": NoisyDevice,
}


@pytest.mark.parametrize(("driver", "board"), [(d, b) for d in DRIVERS for b in BOARDS if b != d])
def test_a_board_of_another_kind_is_refused_in_time_without_motion(driver: str, board: str) -> None:
    device = BOARDS[board]()
    line = line_to(device)
    with pytest.raises(HardwareFault) as caught:
        DRIVERS[driver](line).connect(5.0)
    if board == "noise":
        assert caught.value.reason is FaultReason.PROTOCOL
    else:
        assert caught.value.reason in (FaultReason.UNKNOWN_FIRMWARE, FaultReason.TIMEOUT)
    assert "port" in str(caught.value) or "power" in str(caught.value)
    # The port is closed, so that another program can use it.
    assert not line.is_open
    assert line.now() < 20.0
    if isinstance(device, GrblEmulator | MarlinEmulator):
        assert not device.moving(line.now())
    if isinstance(device, TapperEmulator):
        assert device.fires == [] and device.state == "UNHOMED"


def in_a_long_move(
    make: Callable[[ControllerNeeds], ArmDriver],
) -> tuple[ArmDriver, VirtualTransport, ArmEmulator]:
    """Return a homed driver, its line, and its board 0.5 s after the begin of a move of 10 s."""
    driver = make(MILD)
    driver.connect()
    driver.home(HomingStrategy.FIRMWARE)
    line = driver._transport
    assert isinstance(line, VirtualTransport)
    board = line.layer.emulator
    assert isinstance(board, ArmEmulator)
    line.write(b"G90\nG1 X20 F120\n")  # 10 s at 2 degrees a second
    line.sleep(0.5)
    return driver, line, board


@pytest.mark.parametrize("latched", [True, False])
@pytest.mark.parametrize("make", [grbl, marlin])
def test_a_stop_before_the_port_is_open_ends_the_move_of_an_earlier_process(make, latched):
    """If a node exits during a move, the controller continues the move. If a stop is requested
    before the next node has opened the port, the stop is sent as soon as the port is open."""
    earlier, line, board = in_a_long_move(make)
    line.close()
    assert board.moving(line.now())
    driver = ArmDriver(line, type(earlier._dialect)(line), ScaraGeometry())
    if latched:
        assert not driver.stop()
        with expect_fault(FaultReason.STOPPED):
            driver.connect()
    else:
        driver.stop_when_opened()
        driver.connect()
        assert not driver.homed
    line.sleep(0.5)
    assert not board.moving(line.now())


@pytest.mark.parametrize("make", [grbl, marlin])
def test_a_stop_while_the_port_is_away_is_sent_before_the_stop_is_cleared(make):
    driver, line, board = in_a_long_move(make)
    line.layer.hang_up(line.now(), 0.5)
    assert not driver.stop() and driver.stops_when_opened
    line.sleep(1.0)
    assert board.moving(line.now())
    began = line.now()
    driver.clear_fault()
    assert line.now() < began + 2.0, "the controller would refuse queries until the move has ended"
    assert not board.moving(line.now())
    assert not driver.stops_when_opened and not driver.homed and driver.fault is None
    assert driver.home(HomingStrategy.FIRMWARE)


@pytest.mark.parametrize("make", [grbl, marlin])
def test_a_stop_that_the_opened_port_did_not_accept_completely_is_sent_at_the_next_connection(
    make: Callable[[ControllerNeeds], ArmDriver], monkeypatch: pytest.MonkeyPatch
) -> None:
    earlier, line, board = in_a_long_move(make)
    line.close()
    driver = ArmDriver(line, type(earlier._dialect)(line), ScaraGeometry())
    driver.stop_when_opened()
    with monkeypatch.context() as full, suppress(HardwareFault):
        full.setattr(line, "stop", lambda data: False)
        driver.connect(timeout=0.1)
    assert driver.stops_when_opened and board.moving(line.now())
    driver.connect()
    line.sleep(0.5)
    assert not board.moving(line.now()) and not driver.stops_when_opened
