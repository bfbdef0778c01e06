"""In set-up mode, the board discharges more than its set-up energy when the switch is released; the
driver names this cause."""

from __future__ import annotations

import pytest

from tapping_cell.hardware.faults import FaultReason
from tapping_cell.hardware.tapper import FireOutcome, TapperDriver, TapperSettings
from tapping_cell.hardware.tapper_protocol import Mode, State
from tapping_cell.simulation.fault_layer import FaultLayer
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.virtual_line import VirtualClock, VirtualTransport


@pytest.mark.parametrize(
    ("energy", "expected"), [(0.02, FaultReason.NOT_ENABLED), (0.002, FaultReason.REJECTED)]
)
def test_a_shot_that_the_switch_discharged_is_not_enabled(energy, expected):
    clock = VirtualClock()
    clock.limit = float("inf")
    board = TapperEmulator(now=clock.now)
    transport = VirtualTransport(FaultLayer(board), clock, "tapper")
    driver = TapperDriver(transport, TapperSettings(mode=Mode.SETUP), draw_number=lambda below: 1)
    driver.connect()
    board.set_enabling_switch(True, clock.now)
    assert driver.charge(1, energy).state is State.CHARGED
    board.set_enabling_switch(False, clock.now)
    if expected is FaultReason.REJECTED:
        driver.discharge()
    result = driver.fire(1, 0.045, lambda release_by: True)
    assert result.outcome is FireOutcome.NOT_FIRED
    assert result.fault is not None
    assert result.fault.reason is expected, result.sentence
