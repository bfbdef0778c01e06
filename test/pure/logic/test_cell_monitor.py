"""What a client that does not know the cell file concludes from the boards' messages."""

from __future__ import annotations

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now
from tapping_cell.messages import TapperState


def at(steady: float) -> Now:
    return Now(steady, round(steady * 1e9))


def test_a_board_that_names_its_tappers_only_later_is_heard() -> None:
    """`up` met it: the first message came before the node had read its cell file."""
    monitor = CellMonitor(silence_limit=0.5)
    monitor.on_tapper(TapperState(state=TapperState.DISCONNECTED), at(1.0))
    monitor.on_tapper(TapperState(state=TapperState.SAFE, tappers=["east", "west"]), at(3.0))
    assert not monitor.silent("tapper", at(3.2))
    assert monitor.silent("tapper", at(3.6))


def test_the_silence_is_that_of_the_board_with_the_oldest_message() -> None:
    monitor = CellMonitor(silence_limit=0.5)
    monitor.on_tapper(TapperState(tappers=["east"]), at(1.0))
    monitor.on_tapper(TapperState(tappers=["west"]), at(3.0))
    assert monitor.silent("tapper", at(3.1))
