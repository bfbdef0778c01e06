"""The arm's driver with each supported controller and its peculiarities, in virtual time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hardware_faults import expect_fault

from lab.drivers.controller_cell import (
    GRBL_NAMES,
    HOME,
    NAMES,
    START,
    ControllerCell,
)
from tapping_cell.hardware.arm_settings import ArmSettings, HomingStrategy
from tapping_cell.hardware.faults import LINE_LOST, FaultReason, HardwareFault
from tapping_cell.simulation.fault_layer import Direction, FaultKind, LineFault
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.grbl_machine import GrblMachine, default_settings
from tapping_cell.simulation.grbl_variants import GRBL_3_AXES
from tapping_cell.simulation.marlin_emulator import MarlinEmulator, MarlinMachine

REPORTED_NAME = {
    "grbl": "Grbl",
    "grbl-mega-5x": "grbl-Mega-5X",
    "grblhal": "grblHAL",
    "fluidnc3": "FluidNC",
    "fluidnc4": "FluidNC",
    "marlin": "Marlin",
}
FAR = (1.5, 0.5, -0.1, 1.0)


@pytest.mark.parametrize("name", NAMES)
def test_every_controller_is_recognised_homed_and_moved(name: str) -> None:
    cell = ControllerCell(name)
    driver = cell.ready()
    assert driver.firmware is not None and driver.firmware.name == REPORTED_NAME[name]
    rng = np.random.default_rng(3)
    for _ in range(6):
        goal = rng.uniform((-1.0, 0.4, -0.12, -1.5), (1.0, 2.0, 0.0, 1.5))
        reading = driver.move_to(goal, 1.0)
        assert np.allclose(reading.joints, goal, atol=1e-3)
        assert np.allclose(cell.truth(), goal, atol=1e-3)
    assert driver.line_counters.bad_lines == 0


@pytest.mark.parametrize("name", NAMES)
def test_a_stop_during_a_move_is_reported_as_a_stop_and_cleared_by_homing(name: str) -> None:
    cell = ControllerCell(name)
    driver = cell.ready()
    cell.during_the_next_move(0.4, driver.stop)
    with expect_fault(FaultReason.STOPPED):
        driver.move_to(FAR, 0.3)
    here = cell.truth()
    cell.wait(2.0)
    assert np.allclose(cell.truth()[:2], here[:2], atol=0.02) and not driver.homed
    assert (
        driver.fault is not None and "a quill without a brake then sinks" in driver.fault.sentence
    )
    driver.clear_fault()
    with expect_fault(FaultReason.NOT_HOMED):
        driver.move_to(HOME)
    if name == "grbl-mega-5x":
        # A person moves the axis without a home switch to its mark.
        cell.emulator.push(cell.truth()._replace(tool=0.0), cell.clock.now)  # type: ignore[union-attr]
    driver.home(HomingStrategy.FIRMWARE)
    driver.move_to((0.1, 1.4, -0.01, 0.1))
    assert np.allclose(cell.truth(), (0.1, 1.4, -0.01, 0.1), atol=1e-3)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("back", [True, False])
def test_an_unplug_before_a_stop_is_cleared_ends_with_homing(name: str, back: bool) -> None:
    """``back``: whether the port is present again when the stop is cleared."""
    cell = ControllerCell(name)
    driver = cell.ready()
    driver.stop()
    cell.unplug(0.3)
    if back:
        cell.wait(0.5)
    with pytest.raises(HardwareFault) as caught:
        driver.clear_fault(0.1)
    assert caught.value.reason in LINE_LOST
    cell.wait(1.0)
    driver.connect()
    with expect_fault(FaultReason.NOT_HOMED):
        driver.move_to(HOME)
    if name == "grbl-mega-5x":
        # A person moves the axis without a home switch to its mark.
        cell.emulator.push(cell.truth()._replace(tool=0.0), cell.clock.now)  # type: ignore[union-attr]
    driver.home(HomingStrategy.FIRMWARE)
    assert driver.homed and driver.fault is None


@pytest.mark.parametrize("name", NAMES)
def test_unplugging_during_a_move_drops_the_target(name: str) -> None:
    cell = ControllerCell(name)
    driver = cell.ready()
    cell.during_the_next_move(0.4, lambda: cell.unplug(0.3))
    with expect_fault(FaultReason.DISCONNECTED):
        driver.move_to(FAR, 0.3)
    cell.wait(10.0)
    driver.connect()
    with expect_fault(FaultReason.NOT_HOMED):
        driver.move_to(HOME)


@pytest.mark.parametrize("name", GRBL_NAMES)
def test_an_alarm_during_a_move_stays_the_cause_after_a_restart(name: str) -> None:
    """Real firmware sends its greeting after an alarm, and a driver could mistake this for a
    restart of the board."""
    cell = ControllerCell(name)
    driver = cell.ready()
    emulator = cell.emulator
    assert isinstance(emulator, GrblEmulator)

    def hit() -> None:
        emulator.hit_limit(cell.clock.now)
        emulator.receive(b"\x18", cell.clock.now)

    cell.during_the_next_move(0.4, hit)
    with pytest.raises(HardwareFault, match="a limit switch was hit"):
        driver.move_to(FAR, 0.3)
    for _ in range(5):
        with expect_fault(FaultReason.ALARM, "a limit switch was hit"):
            driver.read()
            driver.read_joints()
    driver.clear_fault()
    assert driver.fault is None and not driver.homed


@pytest.mark.parametrize("name", NAMES)
def test_a_restart_is_detected_and_requires_homing(name: str) -> None:
    cell = ControllerCell(name)
    driver = cell.ready()
    cell.emulator.power_cycle(cell.clock.now)
    with expect_fault(FaultReason.BOARD_RESET):
        driver.move_to(FAR, 0.3)
    driver.clear_fault()
    assert not driver.homed


# Holding torque of the motors.


def released(name: str) -> dict[int, float] | None:
    return {1: 25.0} if not name.startswith("fluidnc") else None


@pytest.mark.parametrize("name", GRBL_NAMES)
def test_a_controller_that_disables_its_motors_is_refused_with_the_remedy(name: str) -> None:
    cell = ControllerCell(name, released(name))
    emulator = cell.emulator
    assert isinstance(emulator, GrblEmulator)
    if name.startswith("fluidnc"):
        emulator.receive(b"$/stepping/idle_ms=25\n", 0.0)
    words = r"is 25, must be 255: .*torque.*\(send \$(1|/stepping/idle_ms)=255"
    with expect_fault(FaultReason.SETTINGS_MISMATCH, words):
        cell.driver.connect()


def test_an_arm_without_torque_sinks_undetected_by_its_controller() -> None:
    """Without holding torque, the emulated arm sinks. The previous test checks that the driver
    refuses a controller with such settings."""
    machine = GrblMachine(start_joints=START, settings=default_settings() | {1: 25.0, 22: 0.0})
    emulator = GrblEmulator(machine)
    emulator.advance(1.0)
    assert not emulator.holds
    assert emulator.joints(2.0)[2] < START[2] - 0.01
    emulator.receive(b"G21G90G94G1X5F5000\n?", 2.0)
    emulator.advance(5.0)
    emulator.take_output(5.0)
    emulator.receive(b"?", 5.0)
    assert b"MPos:5.000,0.000,0.000,0.000" in emulator.take_output(6.0)
    assert emulator.joints(5.0)[2] < START[2] - 0.01


def test_marlin_holds_the_arm_while_it_is_at_rest() -> None:
    cell = ControllerCell("marlin")
    driver = cell.ready()
    driver.move_to(FAR)
    cell.wait(1000.0)
    assert np.allclose(cell.truth(), FAR, atol=1e-3)
    alone = MarlinEmulator(MarlinMachine(start_joints=START))
    alone.advance(500.0)
    assert alone.joints(500.0)[2] < START[2] - 0.1


@pytest.mark.parametrize("name", GRBL_NAMES)
def test_a_controller_that_went_to_sleep_is_not_trusted(name: str) -> None:
    cell = ControllerCell(name)
    driver = cell.ready()
    cell.emulator.receive(b"$SLP\n", cell.clock.now)
    with expect_fault(FaultReason.POSITION_LOST, "asleep: its motors may have been"):
        driver.read()
    assert not driver.homed


# Peculiarities of single controllers.


def test_three_axes_are_refused_with_a_message() -> None:
    cell = ControllerCell("grbl", change=lambda machine: replace(machine, variant=GRBL_3_AXES))
    with expect_fault(FaultReason.UNKNOWN_FIRMWARE, r"has 3 axes \(XYZ\), but 4 are needed"):
        cell.driver.connect()


def test_an_axis_without_a_switch_must_be_named() -> None:
    cell = ControllerCell("grblhal", {46: 0.0})
    with pytest.raises(HardwareFault, match=r"leaves out axis A .*axes_without_switch"):
        cell.driver.connect()


@pytest.mark.parametrize("lost", [b"[FIRMWARE:grblHAL]", b"[AXS:4:XYZA]"])
def test_one_corrupt_line_does_not_change_the_detected_controller(lost: bytes) -> None:
    """A grblHAL whose line [FIRMWARE:grblHAL] is lost could be mistaken for grbl-Mega-5X. If the
    line [AXS:4:XYZA] is lost as well, it could be mistaken for Grbl."""
    cell = ControllerCell("grblhal", {22: 9.0})
    original = cell.emulator.take_output
    spoilt: list[bytes] = []

    def take(now: float) -> bytes:
        out = original(now)
        if lost in out and not spoilt:
            spoilt.append(out)
            out = out.replace(lost, b"[FIRM:" + lost[-5:])
        return out

    cell.emulator.take_output = take  # type: ignore[method-assign]
    driver = cell.ready()
    assert spoilt and driver.firmware is not None and driver.firmware.name == "grblHAL"


def test_homing_ends_at_a_forced_origin() -> None:
    cell = ControllerCell("grblhal", {22: 9.0})
    cell.ready().move_to(FAR, 1.0)
    assert np.allclose(cell.truth(), FAR, atol=1e-3)


def test_an_unhomed_tool_axis_is_where_the_operator_placed_it() -> None:
    cell = ControllerCell("grbl-mega-5x")
    driver = cell.ready()
    assert driver.read_joints().tool == 0.0
    driver.move_to((0.1, 1.4, -0.01, 0.7))
    assert cell.truth().tool == pytest.approx(0.7, abs=1e-3)


def test_a_moving_arm_is_not_homed_if_the_operator_must_place_its_tool() -> None:
    """A move of another program ends far from the mark of the axis without a switch."""
    cell = ControllerCell("grbl-mega-5x")
    driver = cell.ready()
    cell.emulator.receive(b"G1X80Y30F1000\n", cell.clock.now)
    with expect_fault(FaultReason.HOMING_FAILED, "axis A, which has no home switch"):
        driver.home(HomingStrategy.FIRMWARE)
    assert not driver.homed
    cell.wait(60.0)
    # The operator moves the tool axis to its mark and homes again, as the message says. There is no
    # fault to clear.
    assert isinstance(cell.emulator, GrblEmulator)
    cell.emulator.push(cell.truth()._replace(tool=HOME[3]), cell.clock.now)
    driver.home(HomingStrategy.FIRMWARE)
    driver.move_to((0.1, 1.4, -0.01, 0.7))
    assert np.allclose(cell.truth(), (0.1, 1.4, -0.01, 0.7), atol=1e-3)


@pytest.mark.parametrize("name", GRBL_NAMES)
def test_a_controller_moving_after_an_unplug_is_connected_once_it_is_at_rest(name):
    """Grbl answers ``$I`` and ``$$`` only at rest, as measured with grblHAL's simulator."""
    cell = ControllerCell(name)
    driver = cell.ready()
    cell.during_the_next_move(0.4, lambda: cell.unplug(0.3))
    with pytest.raises(HardwareFault):
        driver.move_to(FAR, 0.1)
    cell.wait(0.4)
    with expect_fault(FaultReason.TIMEOUT, "still moving after .* wait until it stops"):
        driver.connect(1.0)
    assert not driver.connected
    driver.connect(30.0)
    assert not cell.emulator.moving(cell.clock.now) and not driver.homed


@pytest.mark.parametrize("state", ["Sleep", "Hold"])
def test_a_controller_that_connects_in_a_locked_state_can_be_cleared(state: str) -> None:
    cell = ControllerCell("grbl")
    driver = cell.ready()
    cell.during_the_next_move(0.4, lambda: cell.unplug(0.3))
    with pytest.raises(HardwareFault):
        driver.move_to(FAR, 0.1)
    cell.emulator.receive(b"!" if state == "Hold" else b"", cell.clock.now)
    if state == "Sleep":
        assert isinstance(cell.emulator, GrblEmulator)
        cell.emulator.enter_sleep(cell.clock.now)
    cell.wait(1.0)
    words = "is (in a feed hold|asleep).*then clear"
    with expect_fault(FaultReason.REJECTED, words):
        driver.connect(2.0)
    # Clearing by a person resets the controller, which ends the feed hold or the sleep.
    driver.clear_fault()
    assert driver.connected and not driver.homed
    driver.home(HomingStrategy.FIRMWARE)
    driver.move_to(FAR)
    assert np.allclose(cell.truth(), FAR, atol=1e-3)


def test_a_report_without_an_axis_is_invalid_even_after_a_fault_was_cleared() -> None:
    cell = ControllerCell("grblhal")
    driver = cell.ready()
    driver.clear_fault()
    driver.stop()
    driver.clear_fault()
    driver.home(HomingStrategy.FIRMWARE)
    original = cell.emulator.take_output
    spoilt: list[bytes] = []

    def take(now: float) -> bytes:
        out = original(now)
        if b"MPos:" in out and not spoilt:
            spoilt.append(out)
            head, _, rest = out.partition(b"MPos:")
            out = head + b"MPos:0" + rest[rest.index(b",") + 1 :]
        return out

    cell.emulator.take_output = take  # type: ignore[method-assign]
    before = driver.line_counters.bad_lines
    driver.move_to(FAR, 1.0)
    assert spoilt and driver.line_counters.bad_lines == before + 1


# Refusals and warnings, and when they are reported.


def test_reports_of_the_work_position_are_refused_at_connect() -> None:
    cell = ControllerCell("grbl", {10: 0.0})
    with pytest.raises(HardwareFault, match=r"\$10 is 0, must be odd.*send \$10=1"):
        cell.driver.connect()
    assert cell.clock.now < 5.0


@pytest.mark.parametrize("delay", [0.6, 1.0, 1.4, 1.9])
def test_a_late_answer_is_never_credited_to_another_line(delay: float) -> None:
    """Regression test: the `ok` of a move arrived 0.5 s late and was taken for the `ok` of the next
    line."""
    for place in range(0, 12, 3):
        cell = ControllerCell("grbl")
        driver = cell.ready()
        at = cell.line.count(Direction.TO_HOST) + 40 + place
        cell.line.add(LineFault(FaultKind.DELAY, Direction.TO_HOST, at, duration=delay))
        for number in range(4):
            goal = (0.2 * number, 1.2, -0.02, 0.1 * number)
            reading = driver.move_to(goal, 1.0)
            assert not cell.emulator.moving(cell.clock.now)
            assert np.allclose(reading.joints, goal, atol=1e-3)
            assert np.allclose(cell.truth(), goal, atol=1e-3)
        assert driver.fault is None


def test_a_slowed_move_is_stopped_and_reported_with_its_override() -> None:
    cell = ControllerCell("grbl")
    driver = cell.ready()
    driver.read()
    cell.emulator.receive(b"\x92" * 9, cell.clock.now)
    with expect_fault(FaultReason.TIMEOUT, "override of 10 %.*the arm was stopped"):
        driver.move_to(FAR, 0.5)
    cell.wait(0.5)
    assert not cell.emulator.moving(cell.clock.now)
    assert not driver.homed


def test_an_override_is_reset_at_connect() -> None:
    cell = ControllerCell("grbl")
    cell.emulator.receive(b"\x92" * 9, 0.0)
    cell.ready().move_to(FAR, 1.0)


@pytest.mark.parametrize("name", NAMES)
def test_homing_that_does_not_end_is_stopped_and_reported(name: str) -> None:
    cell = ControllerCell(name, arm=ArmSettings(home_joints=HOME, homing_timeout=1.0))
    cell.driver.connect()
    if cell.driver.read().alarm:
        cell.driver.clear_fault()
    if name == "marlin":
        assert isinstance(cell.emulator, MarlinEmulator)
        cell.emulator.machine = replace(cell.emulator.machine, homing_rate=2.0)
    else:
        cell.emulator._settings.update({24: 60.0, 25: 60.0})  # type: ignore[union-attr]
    words = "homing has not ended within .* s .*arm.homing_timeout.*the arm was stopped"
    with expect_fault(FaultReason.TIMEOUT, words):
        cell.driver.home(HomingStrategy.FIRMWARE)
    cell.wait(0.5)
    assert not cell.emulator.moving(cell.clock.now)


def test_a_halted_marlin_keeps_reporting_it() -> None:
    cell = ControllerCell("marlin")
    driver = cell.ready()
    cell.emulator.receive(b"\nM112\n", cell.clock.now)
    with pytest.raises(HardwareFault, match="halted"):
        driver.read()
    with pytest.raises(HardwareFault, match="probably halted .*M112.*press the reset button"):
        driver.read()


def test_a_controller_that_stays_locked_until_it_is_homed_is_cleared() -> None:
    """Bit 2 of grblHAL's ``$22``: homing on startup required. ``$X`` is then refused."""
    cell = ControllerCell("grblhal", {22: 5.0})
    driver = cell.ready()  # clears the alarm after power-up first
    cell.during_the_next_move(0.4, driver.stop)
    with pytest.raises(HardwareFault):
        driver.move_to(FAR, 0.3)
    driver.clear_fault()
    assert driver.fault is None and not driver.homed
    driver.home(HomingStrategy.FIRMWARE)
    driver.move_to(FAR)
    assert np.allclose(cell.truth(), FAR, atol=1e-3)


def test_reports_without_the_work_offset_are_refused() -> None:
    cell = ControllerCell("grblhal", {10: 1.0})
    with expect_fault(
        FaultReason.SETTINGS_MISMATCH, r"\$10 is 1, bits 0 and 5 must be set.*\$10=33"
    ):
        cell.driver.connect()
    assert ControllerCell("grblhal", {10: 33.0}).ready().homed


@pytest.mark.parametrize("name", GRBL_NAMES)
def test_homing_that_fails_can_be_repeated_at_once(name: str) -> None:
    """The controller resets itself after the alarm; this reset is no fault of its own."""
    cell = ControllerCell(name)
    driver = cell.ready()
    assert isinstance(cell.emulator, GrblEmulator)
    cell.emulator.finds_switches = False
    with expect_fault(FaultReason.HOMING_FAILED, "homing failed.*found no limit switch"):
        driver.home(HomingStrategy.FIRMWARE)
    cell.wait(0.5)
    assert driver.read().alarm and driver.fault is None
    cell.emulator.finds_switches = True
    if name == "grbl-mega-5x":
        cell.emulator.push(cell.truth()._replace(tool=0.0), cell.clock.now)
    driver.home(HomingStrategy.FIRMWARE)
    driver.move_to(FAR)
    assert np.allclose(cell.truth(), FAR, atol=1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_no_joint_moves_faster_than_asked(name: str) -> None:
    """The feed of a controller refers to the length of the move through all axes, or only to the
    part of some of the axes."""
    cell = ControllerCell(name)
    driver = cell.ready()
    units, speeds = np.array(cell.dialect.units), np.array(driver.geometry.max_speed)
    move, fastest = cell.emulator._axes.move, list[Any]()

    def note(target: Any, now: float, speed: float, pull: float) -> float:
        way = np.abs(target - cell.emulator._axes.motors(now))
        if np.linalg.norm(way) > 0.1:  # a displacement of a few steps reaches no speed
            fastest.append(speed * way / np.linalg.norm(way) / units)
        return move(target, now, speed, pull)

    cell.emulator._axes.move = note  # type: ignore[method-assign]
    rng = np.random.default_rng(5)
    here = np.array(HOME)
    for tool in (1.5, -1.5, 0.0):
        for way in (0.5, 0.05, 0.008, 1e-5, 0.0):
            goal = here + np.array([*rng.uniform(-way, way, 2), 0.0, 0.0])
            goal[3] = -tool if here[3] == tool else tool
            share = float(rng.uniform(0.1, 0.5))
            fastest[:] = [np.zeros(4)]
            began = cell.clock.now
            driver.move_to(goal, share)
            took = cell.clock.now - began
            assert np.max(np.array(fastest) / speeds) <= 1.02 * share
            least = float(np.max(np.abs(goal - here) / speeds)) / share
            assert took < least + 1.5
            assert np.allclose(cell.truth(), goal, atol=1e-3)
            here = goal
