"""The arm's driver with the emulated Grbl controller on a real pseudo-terminal."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from emulated_arm import HOME, NEAR_HOME, EmulatedArm

from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmSettings, HomingStrategy
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.grbl_dialect import GrblDialect, GrblSettings
from tapping_cell.hardware.motion import MotionSettings, path_duration, strike_path
from tapping_cell.hardware.scara import Joints, ScaraGeometry, TipPose
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.grbl_machine import GrblMachine
from tapping_cell.simulation.joint_motion import AxisErrors
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal

MACHINE = GrblMachine(start_joints=NEAR_HOME, home_joints=HOME)


def emulated(
    plug: Callable[..., PseudoTerminal],
    machine: GrblMachine = MACHINE,
    expected: dict[int, float] | None = None,
    **options: bool,
) -> EmulatedArm:
    """Return an emulated Grbl arm and its driver."""
    emulator = GrblEmulator(machine, seed=1, now=time.monotonic())
    port = plug(emulator, **options)
    transport = SerialTransport(str(port.path))
    dialect = GrblDialect(transport, GrblSettings(expected=expected or {13: 0.0}))
    return EmulatedArm(emulator, port, transport, dialect)


def test_nothing_moves_before_homing(plug: Callable[..., PseudoTerminal]) -> None:
    cell = emulated(plug)
    firmware = cell.driver.connect()
    assert (firmware.name, firmware.continued) == ("Grbl", False)
    before = cell.truth()
    for call in (lambda: cell.driver.move_to(HOME), cell.driver.read_joints):
        with pytest.raises(HardwareFault) as caught:
            call()
        assert caught.value.reason is FaultReason.NOT_HOMED
    assert cell.truth() == before


def test_home_move_read_back(plug: Callable[..., PseudoTerminal]) -> None:
    cell = emulated(plug)
    driver = cell.ready()
    assert driver.read_joints() == pytest.approx(HOME, abs=1e-6)
    goal = Joints(0.3, 1.2, -0.02, -0.5)
    reading = driver.move_to(goal, speed=0.8)
    assert not reading.moving and reading.measured
    assert np.allclose(reading.joints, goal, atol=1e-3)
    assert np.allclose(cell.truth(), goal, atol=1e-3)


def test_a_path_ends_on_the_strike_pose_and_rests_there(
    plug: Callable[..., PseudoTerminal],
) -> None:
    """The time that the driver adds to the moves is measured by benchmarks/drivers.py."""
    cell = emulated(plug)
    driver = cell.ready()
    tip = TipPose(0.40, 0.35, 0.01, 0.6)
    settings = MotionSettings(travel_speed=1.0, near_speed=1.0)
    path = strike_path(driver.geometry, driver.read_joints(), tip, settings)
    least = path_duration(driver.geometry, HOME, path) + driver.settings.settle_time
    before = time.monotonic()
    driver.follow(path)
    assert time.monotonic() - before > least - 0.01
    found = driver.geometry.forward(cell.truth())
    assert np.allclose(found[:3], tip[:3], atol=2e-4)


def test_the_driver_reports_the_controller_position_not_the_true_position(
    plug: Callable[..., PseudoTerminal],
) -> None:
    offset = (0.002, -0.001, 0.0, 0.003)
    cell = emulated(
        plug, GrblMachine(start_joints=HOME, home_joints=HOME, errors=AxisErrors(offset=offset))
    )
    reading = cell.ready().move_to((0.2, 1.4, -0.01, 0.2))
    assert np.allclose(np.subtract(cell.truth(), reading.joints), offset, atol=1e-9)


@pytest.mark.parametrize(
    ("joints", "speed"),
    [((9, 0, 0, 0), 0.5), ((0, 1, 0, math.nan), 0.5), ((0, 1, 0, 0), 0.0), ((0, 1, 0, 0), 1.5)],
)
def test_targets_out_of_range_send_nothing(
    plug: Callable[..., PseudoTerminal], joints: tuple[float, ...], speed: float
) -> None:
    cell = emulated(plug)
    driver = cell.ready()
    before = cell.truth()
    with pytest.raises(HardwareFault) as caught:
        driver.move_to(joints, speed)
    assert caught.value.reason is FaultReason.OUT_OF_RANGE
    assert cell.truth() == before and driver.fault is None


def test_stop_from_another_thread_halts_the_arm_and_latches(
    plug: Callable[..., PseudoTerminal],
) -> None:
    cell = emulated(plug)
    driver = cell.ready()
    caught: list[HardwareFault] = []

    def move() -> None:
        try:
            driver.move_to((1.5, 0.5, -0.1, 1.0), speed=0.2)
        except HardwareFault as fault:
            caught.append(fault)

    worker = threading.Thread(target=move)
    worker.start()
    cell.wait_moving(True)
    assert driver.stop()  # it must not wait for the other thread, or the move ends at 1.5 rad
    worker.join(60)
    assert [fault.reason for fault in caught] == [FaultReason.STOPPED]
    cell.wait_moving(False)
    here = cell.truth()
    assert here.shoulder < 1.4
    time.sleep(0.2)
    assert cell.truth() == here
    assert not driver.homed
    with pytest.raises(HardwareFault) as refused:
        driver.move_to(HOME)
    assert refused.value.reason is FaultReason.STOPPED
    driver.clear_fault()
    with pytest.raises(HardwareFault) as refused:
        driver.move_to(HOME)
    assert refused.value.reason is FaultReason.NOT_HOMED
    driver.home(HomingStrategy.FIRMWARE)
    driver.move_to((0.1, 1.4, 0.0, 0.0))
    assert np.allclose(cell.truth(), (0.1, 1.4, 0.0, 0.0), atol=1e-3)


def test_a_reset_board_must_be_homed_again(plug: Callable[..., PseudoTerminal]) -> None:
    cell = emulated(plug)
    driver = cell.ready()
    with cell.port.lock:
        cell.emulator.power_cycle(time.monotonic())
    with pytest.raises(HardwareFault) as caught:
        for _ in range(3):
            driver.move_to((0.2, 1.2, -0.02, 0.1))
    assert caught.value.reason is FaultReason.BOARD_RESET
    assert not driver.homed
    driver.clear_fault()
    driver.home(HomingStrategy.FIRMWARE)


def test_homing_survives_a_disconnected_cable_but_not_a_reset(
    plug: Callable[..., PseudoTerminal],
) -> None:
    cell = emulated(plug)
    driver = cell.ready()
    for reset in (False, True):
        cell.port.hang_up()
        if reset:
            with cell.port.lock:
                cell.emulator.power_cycle(time.monotonic())
        with pytest.raises(HardwareFault) as caught:
            driver.move_to((0.2, 1.2, -0.02, 0.1))
        assert caught.value.reason is FaultReason.DISCONNECTED
        assert not driver.connected
        cell.port.plug_in()
        driver.connect()
        assert driver.homed is not reset


def test_an_arm_pushed_while_unplugged_is_detected(plug: Callable[..., PseudoTerminal]) -> None:
    """The controller does not notice if somebody pushes the arm. The driver can only notice that
    the reported position has changed. In this test a move of another program changes the reported
    position."""
    cell = emulated(plug)
    driver = cell.ready()
    with cell.port.lock:
        cell.emulator.receive(b"G21G90G94G1X5F5000\n", time.monotonic())
    time.sleep(0.5)
    with pytest.raises(HardwareFault, match="last confirmed position") as caught:
        driver.move_to((0.2, 1.2, -0.02, 0.1))
    assert caught.value.reason is FaultReason.POSITION_LOST


def test_an_alarm_during_a_move(plug: Callable[..., PseudoTerminal]) -> None:
    cell = emulated(plug)
    driver = cell.ready()

    def hit() -> None:
        cell.wait_moving(True)
        with cell.port.lock:
            cell.emulator.hit_limit(time.monotonic())

    threading.Thread(target=hit).start()
    with pytest.raises(HardwareFault, match="a limit switch was hit") as caught:
        driver.move_to((1.5, 0.5, -0.1, 1.0), speed=0.2)
    assert caught.value.reason is FaultReason.ALARM
    assert not driver.homed
    driver.clear_fault()
    driver.home(HomingStrategy.FIRMWARE)


def test_settings_that_differ_are_refused_by_name(plug: Callable[..., PseudoTerminal]) -> None:
    cell = emulated(plug, expected={13: 0.0, 110: 1234.0, 999: 1.0})
    with pytest.raises(
        HardwareFault, match=r"\$110 is 6900, must be 1234 \(send \$110=1234\); \$999 is miss"
    ) as caught:
        cell.driver.connect()
    assert caught.value.reason is FaultReason.SETTINGS_MISMATCH


class NoisyDevice:
    """A device that is not a Grbl controller."""

    def __init__(self) -> None:
        self.out = b""

    def receive(self, data: bytes, now: float) -> None:
        self.out += b"start\necho: Marlin 2.1.2\nok\n"

    def advance(self, now: float) -> None: ...

    def take_output(self, now: float) -> bytes:
        out, self.out = self.out, b""
        return out

    def next_event(self) -> float | None:
        return None

    def power_cycle(self, now: float) -> None: ...


def test_unknown_firmware_is_refused(plug: Callable[..., PseudoTerminal]) -> None:
    port = plug(NoisyDevice())
    transport = SerialTransport(str(port.path))
    driver = ArmDriver(transport, GrblDialect(transport), ScaraGeometry())
    with pytest.raises(HardwareFault, match="check the port, the baud") as caught:
        driver.connect(timeout=1)
    assert caught.value.reason is FaultReason.UNKNOWN_FIRMWARE


def test_homing_that_did_not_run_is_not_accepted(plug: Callable[..., PseudoTerminal]) -> None:
    """A single wrong bit changes $H (home) to $X (unlock), to which Grbl, if not locked, answers
    ok."""
    cell = emulated(plug)
    cell.driver.connect()
    cell.driver.clear_fault()
    original = cell.emulator.receive

    def garbled(data: bytes, now: float) -> None:
        original(data.replace(b"$H", b"$X"), now)

    with cell.port.lock:
        cell.emulator.receive = garbled  # type: ignore[method-assign]
    with pytest.raises(HardwareFault, match="after homing the controller reports") as caught:
        cell.driver.home(HomingStrategy.FIRMWARE)
    assert caught.value.reason is FaultReason.HOMING_FAILED
    assert not cell.driver.homed


@pytest.mark.parametrize("strategy", [HomingStrategy.MANUAL_POSE, HomingStrategy.NONE])
def test_homing_without_switches(
    plug: Callable[..., PseudoTerminal], strategy: HomingStrategy
) -> None:
    settings = {22: 0.0}
    # With MANUAL_POSE, the arm is homed at its marked pose. With the strategy NONE, the controller
    # takes its position at the start as zero.
    place = HOME if strategy is HomingStrategy.MANUAL_POSE else (0.0, 0.0, 0.0, 0.0)
    cell = emulated(plug, GrblMachine(start_joints=place, settings=settings))
    cell.driver.connect()
    assert cell.driver.home(strategy) == pytest.approx(place, abs=1e-6)
    cell.driver.move_to((0.2, 1.2, -0.02, 0.3))
    assert np.allclose(cell.truth(), (0.2, 1.2, -0.02, 0.3), atol=1e-3)


def test_a_board_that_resets_when_the_port_opens(plug: Callable[..., PseudoTerminal]) -> None:
    cell = emulated(plug, reset_on_open=True)
    driver = cell.ready()
    driver.move_to((0.2, 1.4, -0.01, 0.3))
    driver.close()
    time.sleep(0.1)
    driver.connect()
    assert not driver.homed


def test_connecting_waits_for_the_last_move_of_a_killed_driver(
    plug: Callable[..., PseudoTerminal],
) -> None:
    cell = emulated(plug)
    old = cell.ready()

    def move() -> None:
        with pytest.raises(HardwareFault):
            old.move_to((1.2, 0.6, -0.01, 1.0), 0.12)

    moving = threading.Thread(target=move)
    moving.start()
    cell.wait_moving(True)
    cell.transport.close()
    moving.join()
    transport = SerialTransport(str(cell.port.path))
    new = ArmDriver(
        transport,
        GrblDialect(transport, GrblSettings(expected={13: 0.0})),
        ScaraGeometry(),
        ArmSettings(home_joints=HOME),
    )
    new.connect(60.0)
    assert not new.read().moving and not new.homed
    assert new.home(HomingStrategy.FIRMWARE) == pytest.approx(HOME, abs=1e-3)
    assert np.allclose(cell.truth(), HOME, atol=1e-3)
