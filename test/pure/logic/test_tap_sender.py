"""Ids of tap commands, and when a withdrawal is repeated."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now, to_nanoseconds
from tapping_cell.logic.peer_clock import SKEW_LIMIT_S
from tapping_cell.logic.tap_commands import LARGEST_JUMP
from tapping_cell.logic.tap_sender import WITHDRAW_AGAIN_S, TapSender
from tapping_cell.logic.task import Shot
from tapping_cell.messages import TapCommand

START = 100.0
CLOCK = 10**9
TAP = CLOCK - 5


def at(steady: float) -> Now:
    return Now(steady, 10**9 * CLOCK + round(1e9 * (steady - START)))


class Monitor:
    """What arm and tapper have reported."""

    def __init__(self, used: int = 0, orphan: int = 0, has_arm: bool = True) -> None:
        self.used, self.orphan, self.has_arm = used, orphan, has_arm
        self.is_silent = False

    def last_tap_id(self, largest: int) -> int:
        return self.used if self.used <= largest else 0

    def orphaned_tap_id(self) -> int:
        return self.orphan

    def silent(self, device: str, now: Now) -> bool:
        return device == "arm" and self.is_silent


def sender(monitor: Monitor) -> TapSender:
    return TapSender(cast(CellMonitor, monitor))


def requests(effects) -> list[tuple[int, int]]:
    commands = [cast(TapCommand, effect.message) for effect in effects]
    return [(command.request, command.tap_id) for command in commands]


@given(
    steps=st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=6),
    used=st.integers(0, 2 * CLOCK),
)
def test_no_id_is_used_twice_even_if_the_clock_is_set_back(steps, used):
    monitor = Monitor(used=used)
    made = sender(monitor)
    clock, ids = 10**9 * CLOCK, []
    for step in steps:
        clock += round(1e9 * step)
        ids.append(made.next_id(Now(START, clock)))
    assert ids == sorted(set(ids))
    if used <= CLOCK + LARGEST_JUMP:
        assert ids[0] > used
    assert ids[0] == max(used + 1, (10**9 * CLOCK + round(1e9 * steps[0])) // 10**9) or (
        used > CLOCK + LARGEST_JUMP - 10
    )


def test_an_id_that_nobody_can_have_used_is_ignored() -> None:
    assert sender(Monitor(used=CLOCK + LARGEST_JUMP + 1)).next_id(at(START)) == CLOCK


def test_a_tap_is_withdrawn_once() -> None:
    made = sender(Monitor())
    assert requests(made.withdraw(TAP, at(START))) == [(TapCommand.WITHDRAW, TAP)]
    assert requests(made.withdraw(TAP, at(START + 1))) == []
    assert made.is_withdrawn(cast(Shot, SimpleNamespace(tap_id=TAP)))
    assert not made.is_withdrawn(cast(Shot, SimpleNamespace(tap_id=TAP + 1)))
    assert requests(made.withdraw(TAP + 1, at(START + 1))) == [(TapCommand.WITHDRAW, TAP + 1)]


@pytest.mark.parametrize("orphan", [0, TAP])
def test_a_tap_of_an_earlier_planner_is_withdrawn(orphan: int) -> None:
    made = sender(Monitor(orphan=orphan))
    found = requests(made.withdraw_orphan(at(START)))
    assert found == ([(TapCommand.WITHDRAW, TAP)] if orphan else [])
    list(made.withdraw(TAP + 1, at(START)))
    assert requests(made.withdraw_orphan(at(START))) == found


@pytest.mark.parametrize(
    ("later", "orphan", "silent", "repeated"),
    [
        (WITHDRAW_AGAIN_S - 0.01, TAP, False, False),
        (WITHDRAW_AGAIN_S + 0.01, TAP, False, True),
        (WITHDRAW_AGAIN_S + 0.01, TAP, True, False),
        (WITHDRAW_AGAIN_S + 0.01, TAP + 1, False, False),
        (WITHDRAW_AGAIN_S + 0.01, 0, False, False),
    ],
)
def test_a_withdrawal_is_repeated_while_the_arm_serves_its_tap(later, orphan, silent, repeated):
    monitor = Monitor(orphan=orphan)
    made = sender(monitor)
    assert requests(made.repeat_withdrawal(at(START + 99.0))) == [], "nothing was withdrawn"
    list(made.withdraw(TAP, at(START)))
    monitor.is_silent = silent
    found = requests(made.repeat_withdrawal(at(START + later)))
    assert found == ([(TapCommand.WITHDRAW, TAP)] if repeated else [])
    if repeated:
        assert requests(made.repeat_withdrawal(at(START + later + WITHDRAW_AGAIN_S / 2))) == []


@pytest.mark.parametrize("has_arm", [True, False])
def test_a_withdrawn_arm_is_parked_once(has_arm: bool) -> None:
    made = sender(Monitor(has_arm=has_arm))
    assert not made.may_park and requests(made.park(at(START))) == []
    list(made.withdraw(TAP, at(START)))
    assert made.may_park == has_arm
    assert requests(made.park(at(START))) == ([(TapCommand.WITHDRAW, TAP)] if has_arm else [])
    assert not made.may_park and requests(made.park(at(START))) == []


def test_a_command_to_clear_the_view_expires_soon() -> None:
    now = at(START)
    command = cast(TapCommand, sender(Monitor()).clear_view(now).message)
    assert (command.request, command.tap_id) == (TapCommand.CLEAR_VIEW, CLOCK)
    assert command.header.frame_id == "table" and to_nanoseconds(command.header.stamp) == now.ros
    left = 1e-9 * (to_nanoseconds(command.expiry) - now.ros)
    assert left == pytest.approx(0.5 + SKEW_LIMIT_S)


def test_a_tap_expires_after_its_allowance() -> None:
    asked: list[tuple[int, int, float]] = []

    def command(now: int, expiry: int, height: float) -> TapCommand:
        asked.append((now, expiry, height))
        return TapCommand(tap_id=TAP)

    made = sender(Monitor()).tap(cast(Shot, SimpleNamespace(command=command)), 2.5, 0.01, at(START))
    assert (made.topic, cast(TapCommand, made.message).tap_id) == ("tap_command", TAP)
    assert asked == [(at(START).ros, at(START).ros + 2_500_000_000, 0.01)]
