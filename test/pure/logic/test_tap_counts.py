"""What arm and tapper report of a tap, and how taps that were not fired or had no effect count."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tapping_cell.logic import tap_counts
from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now
from tapping_cell.logic.confirmation import Confirmations
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.task import Shot, Task
from tapping_cell.messages import ArmState, ErrorCode, TapperState
from tapping_cell.se2 import Pose

NOW = Now(100.0, 10**18)
TAP = 7
SETTINGS = PlannerSettings(attempts=3, late_attempts=5)


def shot(**known: Any) -> Shot:
    given = {
        **{"tap_id": TAP, "outcome": TapperState.NONE, "in_position": False, "fired_at": None},
        **{"measured_speed": math.nan, "counted": False},
    }
    return cast(Shot, SimpleNamespace(**{**given, **known}))


def monitor(arm: ArmState | None = None, tapper: TapperState | None = None) -> CellMonitor:
    def tapper_of(tap_id: int) -> TapperState | None:
        return tapper if tapper is not None and tapper.tap_id == tap_id else None

    return cast(CellMonitor, SimpleNamespace(arm=arm, tapper_of=tapper_of))


@pytest.mark.parametrize(
    ("arm", "noted"),
    [
        (None, False),
        (ArmState(tap_id=TAP, state=ArmState.IN_POSITION), True),
        (ArmState(tap_id=TAP, state=ArmState.MOVING), False),
        (ArmState(tap_id=TAP - 1, state=ArmState.IN_POSITION), False),
    ],
)
def test_the_arm_was_in_position_if_it_said_so_for_this_tap(arm, noted):
    made = shot()
    tap_counts.note_position(made, monitor(arm))
    assert made.in_position == noted
    tap_counts.note_position(made, monitor(ArmState(tap_id=TAP, state=ArmState.WITHDRAWING)))
    assert made.in_position == noted, "what was reported stays true"


@pytest.mark.parametrize("code", [0, *sorted(tap_counts.LATE), ErrorCode.OBJECT_MOVED])
@pytest.mark.parametrize("outcome", [TapperState.NOT_FIRED, TapperState.FIRED])
def test_only_a_refusal_that_is_not_late_withdraws_the_confirmation(outcome, code):
    reasons: list[str] = []
    confirmations = cast(Confirmations, SimpleNamespace(withdraw=reasons.append))
    made = shot()
    tapper = TapperState(tap_id=TAP, outcome=outcome, error_code=code, error_msg="a reason")
    tapper.measured_speed = 0.5
    tap_counts.note_outcome(made, monitor(tapper=tapper), confirmations, NOW)
    withdrawn = outcome == TapperState.NOT_FIRED and code == ErrorCode.OBJECT_MOVED
    assert reasons == (["a reason"] if withdrawn else [])
    assert (made.outcome, made.measured_speed, made.fired_at) == (outcome, 0.5, NOW.ros)
    # A repeated report keeps the time, and an unknown speed does not replace the measured one.
    tapper.measured_speed = math.nan
    later = Now(101.0, NOW.ros + 10**9)
    tap_counts.note_outcome(made, monitor(tapper=tapper), confirmations, later)
    assert (made.measured_speed, made.fired_at) == (0.5, NOW.ros)


@pytest.mark.parametrize(
    "tapper", [None, TapperState(tap_id=TAP), TapperState(tap_id=TAP - 1, outcome=1)]
)
def test_a_report_without_an_outcome_of_this_tap_changes_nothing(tapper):
    made = shot()
    tap_counts.note_outcome(made, monitor(tapper=tapper), Confirmations(False), NOW)
    assert made == shot() or math.isnan(made.measured_speed)
    assert (made.outcome, made.fired_at) == (TapperState.NONE, None)


@pytest.mark.parametrize(
    ("outcome", "in_position", "has_arm", "may"),
    [
        (TapperState.FIRED, False, True, True),
        (TapperState.NOT_FIRED, True, True, False),
        (TapperState.UNKNOWN, True, True, True),
        (TapperState.UNKNOWN, False, True, False),
        (TapperState.UNKNOWN, False, False, True),
    ],
)
def test_a_tap_with_an_unknown_outcome_may_have_been_fired_in_position(
    outcome, in_position, has_arm, may
):
    made = shot(outcome=outcome, in_position=in_position)
    assert tap_counts.may_have_been_fired(made, has_arm) == may


@pytest.mark.parametrize("late", [True, False])
def test_taps_that_were_not_fired_are_counted_once_and_limited(late: bool) -> None:
    task = cast(Task, SimpleNamespace(late=0, not_fired=0))
    limit = SETTINGS.late_attempts if late else SETTINGS.attempts
    for number in range(1, limit + 1):
        made = shot()
        ended = tap_counts.count_unfired(task, made, SETTINGS, is_late=late)
        assert ended == (number == limit)
        assert not tap_counts.count_unfired(task, made, SETTINGS, is_late=late)
    assert (task.late, task.not_fired) == ((limit, 0) if late else (0, limit))


@pytest.mark.parametrize(
    ("without_effect", "taps", "code"),
    [
        (SETTINGS.attempts - 1, 9, ErrorCode.NONE),
        (SETTINGS.attempts, 9, ErrorCode.TAP_WITHOUT_EFFECT),
        (0, 10, ErrorCode.TAP_LIMIT_REACHED),
    ],
)
def test_no_further_tap_is_made_beyond_the_limits(without_effect, taps, code):
    residual = (0.0025, math.radians(3.0))
    task = SimpleNamespace(
        without_effect=without_effect, taps=taps, max_taps=10, residual=lambda pose: residual
    )
    error = tap_counts.tap_limit_error(cast(Task, task), SETTINGS, Pose(0.0, 0.0, 0.0))
    assert (error[0] if error else ErrorCode.NONE) == code
    if error and code == ErrorCode.TAP_LIMIT_REACHED:
        assert "2.50 mm and 3.00 deg" in error[1]
    if error and code == ErrorCode.TAP_WITHOUT_EFFECT:
        assert f"{SETTINGS.attempts} taps in a row" in error[1]
