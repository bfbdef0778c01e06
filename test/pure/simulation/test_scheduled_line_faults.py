"""Faults that wait in a ``FaultLayer`` for their byte."""

from tapping_cell.simulation.fault_layer import Direction, FaultKind, FaultLayer, LineFault
from tapping_cell.simulation.tapper_emulator import TapperEmulator


def test_a_fault_is_awaited_until_its_byte():
    layer = FaultLayer(TapperEmulator())
    assert not layer.awaits_fault
    layer.add(LineFault(FaultKind.DROP, Direction.TO_DEVICE, byte=3))
    layer.receive(b"abc", 0.0)
    assert layer.awaits_fault
    layer.receive(b"d", 0.0)
    assert not layer.awaits_fault
