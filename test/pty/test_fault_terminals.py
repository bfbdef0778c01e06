"""A few taps over disturbed lines on real pseudo-terminals; ``faults --pty`` runs any number of
them."""

from __future__ import annotations

import pytest

from tapping_cell.cli.fault_terminals import terminal_cell
from tapping_cell.cli.fault_trials import Dialect, TrialCell, run_taps
from tapping_cell.simulation.fault_layer import Direction, FaultKind, LineFault


def pull_a_cable(cell: TrialCell) -> None:
    """Alternately disconnect the cable of the arm and of the tapper in the middle of a tap's
    messages."""
    line = cell.arm_line if cell.tally.taps % 2 else cell.tapper_line
    middle = line.count(Direction.TO_HOST) + 150
    line.add(LineFault(FaultKind.HANG_UP, Direction.TO_HOST, middle, duration=0.3))


@pytest.mark.parametrize("dialect", Dialect)
def test_cables_disconnected_during_a_tap(dialect: Dialect) -> None:
    tally = run_taps(dialect, 2, 5, pull_a_cable, terminal_cell)
    assert tally.clean, tally.notes
    assert tally.taps == 2 == tally.fired + tally.not_fired + tally.unknown
    assert tally.by_fault.get("hang_up"), tally.by_fault
