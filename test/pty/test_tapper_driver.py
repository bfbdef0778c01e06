"""The tapper's driver against the emulated board on a real pseudo-terminal."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.hardware.tapper import FireOutcome, TapperDriver
from tapping_cell.hardware.tapper_protocol import State
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.tapper_emulator import TapperEmulator


class Cell:
    """One emulated tapper and its driver."""

    def __init__(self, plug: Callable[..., PseudoTerminal], **options: bool) -> None:
        self.emulator = TapperEmulator(
            on_fire=lambda shot, energy, at: 0.5, boot=4, now=time.monotonic()
        )
        self.port = plug(self.emulator, **options)
        self.driver = TapperDriver(SerialTransport(str(self.port.path)))

    def connected(self) -> TapperDriver:
        self.driver.connect()
        return self.driver

    def shots(self) -> list[int]:
        with self.port.lock:
            return [shot for shot, _, _ in self.emulator.fires]


def test_draw_fire_measure(plug: Callable[..., PseudoTerminal]) -> None:
    cell = Cell(plug)
    driver = cell.connected()
    assert driver.version.startswith("1.")
    assert driver.arm(3, 0.0125).state is State.DRAWN
    result = driver.fire(3)
    assert (result.outcome, result.shot, result.sentence) == (FireOutcome.FIRED, 3, "")
    assert cell.shots() == [3]
    assert cell.emulator.fires[0][1] == 0.0125
    assert driver.status().speed == 0.5


def test_a_shot_is_never_fired_twice(plug: Callable[..., PseudoTerminal]) -> None:
    cell = Cell(plug)
    driver = cell.connected()
    driver.arm(3, 0.01)
    driver.fire(3)
    for call in (lambda: driver.fire(3), lambda: driver.arm(3, 0.01), lambda: driver.arm(2, 0.01)):
        with pytest.raises(HardwareFault) as caught:
            call()
        assert caught.value.reason is FaultReason.SHOT_SPENT
    # A new driver knows nothing: the board refuses by itself.
    driver.close()
    second = TapperDriver(SerialTransport(str(cell.port.path)))
    second.connect()
    with pytest.raises(HardwareFault, match="has used that shot number") as caught:
        second.arm(3, 0.01)
    assert caught.value.reason is FaultReason.SHOT_SPENT
    assert cell.shots() == [3]


def test_not_drawn_is_not_fired(plug: Callable[..., PseudoTerminal]) -> None:
    cell = Cell(plug)
    result = cell.connected().fire(5)
    assert result.outcome is FireOutcome.NOT_FIRED and "NOT_DRAWN" in result.sentence
    assert cell.shots() == []


def test_silence_of_half_a_second_disarms(plug: Callable[..., PseudoTerminal]) -> None:
    cell = Cell(plug)
    driver = cell.connected()
    driver.arm(5, 0.01)
    for _ in range(16):
        time.sleep(0.05)
        assert driver.status().state is State.DRAWN
    time.sleep(0.6)
    with cell.port.lock:
        cell.emulator.advance(time.monotonic())
        assert cell.emulator.state == "SAFE"
    assert driver.fire(5).outcome is FireOutcome.NOT_FIRED


def test_the_arm_timeout_disarms(plug: Callable[..., PseudoTerminal]) -> None:
    driver = Cell(plug).connected()
    driver.arm(5, 0.01, timeout=0.6)
    end = time.monotonic() + 0.8
    while time.monotonic() < end:
        state = driver.status().state
        time.sleep(0.1)
    assert state is State.SAFE


def test_interlock(plug: Callable[..., PseudoTerminal]) -> None:
    cell = Cell(plug)
    driver = cell.connected()
    driver.arm(5, 0.01)
    with cell.port.lock:
        cell.emulator.set_interlock(False, time.monotonic())
    assert driver.fire(5).outcome is FireOutcome.NOT_FIRED
    with pytest.raises(HardwareFault, match="close the guard") as caught:
        driver.arm(6, 0.01)
    assert caught.value.reason is FaultReason.INTERLOCK


def test_stop_latches_until_a_person_acts(plug: Callable[..., PseudoTerminal]) -> None:
    cell = Cell(plug)
    driver = cell.connected()
    driver.arm(5, 0.01)
    assert driver.stop()
    with pytest.raises(HardwareFault) as caught:
        driver.fire(5)
    assert caught.value.reason is FaultReason.STOPPED
    with pytest.raises(HardwareFault, match="press the clear button") as caught:
        driver.clear()
    assert caught.value.reason is FaultReason.NEEDS_PERSON
    with cell.port.lock:
        cell.emulator.press_clear_button(time.monotonic())
    driver.clear()
    driver.arm(6, 0.01)
    assert driver.fire(6).outcome is FireOutcome.FIRED
    assert cell.shots() == [6]


def test_a_reset_while_drawn_is_unknown_not_fired_again(
    plug: Callable[..., PseudoTerminal],
) -> None:
    cell = Cell(plug)
    driver = cell.connected()
    driver.arm(5, 0.01)
    with cell.port.lock:
        cell.emulator.power_cycle(time.monotonic())
    result = driver.fire(5)
    assert result.outcome is FireOutcome.UNKNOWN and "restarted" in result.sentence
    with pytest.raises(HardwareFault) as caught:
        driver.status()
    assert caught.value.reason is FaultReason.DISCONNECTED
    assert driver.connect().boot == 5
    with pytest.raises(HardwareFault):
        driver.arm(5, 0.01)
    assert cell.shots() == []


def test_unplugged_at_the_shot_is_unknown_and_waits_out_the_danger(
    plug: Callable[..., PseudoTerminal],
) -> None:
    cell = Cell(plug)
    driver = cell.connected()
    driver.arm(5, 0.01)
    cell.port.hang_up()
    before = time.monotonic()
    result = driver.fire(5)
    assert result.outcome is FireOutcome.UNKNOWN
    assert time.monotonic() - before > 0.5
    cell.port.plug_in()
    driver.connect()
    driver.arm(6, 0.01)
    assert driver.fire(6).outcome is FireOutcome.FIRED
    assert cell.shots() == [6]


def test_another_session_takes_over(plug: Callable[..., PseudoTerminal]) -> None:
    cell = Cell(plug)
    driver = cell.connected()
    driver.arm(5, 0.01)
    with cell.port.lock:
        # Checksum by hand: binascii.crc_hqx(b"77,0,HELLO", 0xFFFF).
        import binascii

        check = binascii.crc_hqx(b"77,0,HELLO", 0xFFFF)
        cell.emulator.receive(b"@77,0,HELLO*%04X\n" % check, time.monotonic())
    assert driver.fire(5).outcome is FireOutcome.NOT_FIRED
    assert cell.shots() == []


@pytest.mark.parametrize(
    ("shot", "energy"), [(0, 0.01), (2**64, 0.01), (1, 0.0), (1, 11.0), (1, float("nan"))]
)
def test_orders_out_of_range_are_refused_before_the_line(
    plug: Callable[..., PseudoTerminal], shot: int, energy: float
) -> None:
    driver = Cell(plug).connected()
    with pytest.raises(HardwareFault) as caught:
        driver.arm(shot, energy)
    assert caught.value.reason is FaultReason.OUT_OF_RANGE


def test_more_energy_than_the_board_can_store(plug: Callable[..., PseudoTerminal]) -> None:
    driver = Cell(plug).connected()
    with pytest.raises(HardwareFault, match="out of its range") as caught:
        driver.arm(1, 2.0)
    assert caught.value.reason is FaultReason.OUT_OF_RANGE


def test_nobody_there(plug: Callable[..., PseudoTerminal]) -> None:
    from test_serial_transport import Silent

    port = plug(Silent())
    driver = TapperDriver(SerialTransport(str(port.path)))
    with pytest.raises(HardwareFault, match="answers like the tapper") as caught:
        driver.connect(timeout=0.3)
    assert caught.value.reason is FaultReason.UNKNOWN_FIRMWARE


def test_a_board_that_resets_on_open_is_handled(plug: Callable[..., PseudoTerminal]) -> None:
    cell = Cell(plug, reset_on_open=True)
    driver = cell.connected()
    driver.arm(9, 0.01)
    assert driver.fire(9).outcome is FireOutcome.FIRED
    assert cell.shots() == [9]
