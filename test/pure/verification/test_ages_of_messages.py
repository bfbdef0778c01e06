"""Test that a shot is detected for which all messages of another computer were late."""

from __future__ import annotations

import pytest

from tapping_cell.logic.clock import to_stamp
from tapping_cell.logic.peer_clock import SKEW_LIMIT_S
from tapping_cell.messages import Time
from tapping_cell.verification.host import HostClock
from tapping_cell.verification.peer_invariants import CAMERA, PeerChecker
from tapping_cell.verification.scheduler import Scheduler


def violations_of(delays: list[float], step: float = 0.0) -> list[str]:
    """Return the violations of a shot before which the tapper has received a message of the camera
    every 0.1 s. ``delays``: their delays in s; ``step``: step of the tapper's clock before the last
    of them, s."""
    scheduler, found = Scheduler(), list[str]()
    tapper = HostClock(scheduler)
    checker = PeerChecker(scheduler, lambda name, _: found.append(name), tapper, tapper)
    checker.on_stamp_received(CAMERA, Time())  # an object that was never measured
    for number, delay in enumerate(delays):
        if number == len(delays) - 1:
            tapper.offset += step
        stamp = to_stamp(tapper.now().ros - round(1e9 * delay))
        checker.on_stamp_received(CAMERA, stamp)
        scheduler.run(scheduler.now + 0.1)
    scheduler.run(scheduler.now + 0.05)
    checker.on_release(7)
    return found


@pytest.mark.parametrize("seconds", [1, 15])
def test_a_shot_on_late_messages_is_detected(seconds: int) -> None:
    late = [SKEW_LIMIT_S + 0.02] * 10 * seconds
    assert violations_of(late) == ["late stamps"]
    assert violations_of([*late, 0.4]) == []
    assert violations_of(late, step=1.0) == []
    assert violations_of([SKEW_LIMIT_S] * 10 * seconds) == []


def test_an_old_message_does_not_excuse_a_shot() -> None:
    late = [SKEW_LIMIT_S + 0.02] * 150
    assert violations_of([0.1, *late]) == ["late stamps"]
