"""A driver that tries to connect to its device is silent for seconds; the planner names the reason
that the driver gave before, not its silence."""

from __future__ import annotations

import pytest

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now
from tapping_cell.logic.device import LONGEST_TIMEOUT_S
from tapping_cell.messages import ArmState, ErrorCode, TapperState

SILENCE_S = 0.5
ASLEEP = "the arm's controller is asleep: clear"


def at(time: float) -> Now:
    return Now(steady=100.0 + time, ros=round(1e9 * (100.0 + time)))


def monitor(error: int) -> CellMonitor:
    """Return a monitor whose arm reported ``error`` at time 0 and whose tapper is ready."""
    made = CellMonitor(SILENCE_S)
    state = ArmState(state=ArmState.DISCONNECTED, error_code=error, error_msg=ASLEEP)
    made.on_arm(state, at(0.0))
    return made


@pytest.mark.parametrize("age", [0.0, SILENCE_S + 0.1, LONGEST_TIMEOUT_S])
def test_the_reason_for_the_missing_connection_is_named_during_an_attempt(age: float) -> None:
    assert monitor(ErrorCode.ARM_ALARM).why_not_ready(at(age)) == (ErrorCode.ARM_ALARM, ASLEEP)


def test_after_the_longest_attempt_the_node_counts_as_silent() -> None:
    late = at(LONGEST_TIMEOUT_S + SILENCE_S + 0.1)
    missing = monitor(ErrorCode.ARM_ALARM).why_not_ready(late)
    assert missing is not None and missing[0] == ErrorCode.ARM_SILENT


def test_the_reason_of_a_silent_tapper_is_named_too() -> None:
    made = CellMonitor(SILENCE_S)
    made.expect(has_arm=False, name="disk")
    state = TapperState(state=TapperState.DISCONNECTED, error_code=ErrorCode.TAPPER_NOT_CONNECTED)
    state.error_msg = "no port"
    made.on_tapper(state, at(0.0))
    assert made.why_not_ready(at(2.0)) == (ErrorCode.TAPPER_NOT_CONNECTED, "no port")


@pytest.mark.parametrize("state", [ArmState.IDLE, ArmState.MOVING, ArmState.FAULT])
def test_a_driver_that_was_connected_is_silent_after_the_limit(state: int) -> None:
    made = CellMonitor(SILENCE_S)
    made.on_arm(ArmState(state=state, error_code=ErrorCode.ARM_ALARM), at(0.0))
    missing = made.why_not_ready(at(SILENCE_S + 0.1))
    assert missing is not None and missing[0] == ErrorCode.ARM_SILENT
