"""The stop latch: which sources hold a stop, and what a person has confirmed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.logic import tapper_jobs
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import JobContext, StopLevels
from tapping_cell.logic.stops import CONFIRM_WITHIN_S, StopLatch

QUIET = StopLevels(asserted=False, publishers=(), gone=())


def reset(latch: StopLatch, levels: StopLevels, steady: float) -> str:
    latch.begin_reset()
    return latch.try_reset(levels, Now(steady, 0))


def test_a_confirmation_counts_for_the_stops_before_it_only() -> None:
    """A second panel that stops and disappears after the first refusal must be reported, too."""
    latch = StopLatch()
    latch.receive(True)
    assert "(a)" in reset(latch, StopLevels(False, (), ("a",)), 10.0)
    latch.receive(True)
    assert "(b)" in reset(latch, StopLevels(False, (), ("b",)), 20.0)
    assert latch.stopped
    assert reset(latch, StopLevels(False, (), ("b",)), 21.0) == ""
    assert not latch.stopped


def test_a_confirmation_does_not_outlast_its_time() -> None:
    latch = StopLatch()
    latch.receive(True)
    gone = StopLevels(False, (), ("a",))
    assert reset(latch, gone, 10.0)
    assert reset(latch, gone, 10.1 + CONFIRM_WITHIN_S)


def test_a_level_that_is_not_repeated_requires_an_operator_confirmation() -> None:
    latch = StopLatch()
    latch.receive(True)
    latch.receive(False)
    silent = StopLevels(False, ("a", "b"), (), ("a",))
    assert "its last message (a)" in reset(latch, silent, 10.0)
    assert latch.stopped
    assert reset(latch, silent, 11.0) == ""


def test_no_confirmation_ends_a_stop_that_is_still_held() -> None:
    latch = StopLatch()
    latch.receive(True)
    for steady in (10.0, 11.0, 12.0):
        assert "still held; publishers of emergency_stop: a" in reset(
            latch, StopLevels(True, ("a",), ()), steady
        )
    assert latch.stopped
    latch.receive(False)
    assert reset(latch, QUIET, 13.0) == ""


def test_a_clear_that_was_overtaken_by_a_new_stop_leaves_the_stop_latched() -> None:
    """The job was queued behind a slow one, and the new stop arrived meanwhile."""
    now = Now(10.0, 1_800_000_000_000_000_000)
    cleared: list[bool] = []
    driver = SimpleNamespace(clear=lambda: cleared.append(True))
    context = cast(JobContext, SimpleNamespace(driver=driver, ask=lambda query: query(now)))
    with pytest.raises(HardwareFault) as met:
        tapper_jobs.clear(context, is_stopped=lambda _: True)
    assert met.value.reason is FaultReason.STOPPED
    assert not cleared
