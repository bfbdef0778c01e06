"""The stop latch: which sources hold a stop, and what a person has confirmed."""

from __future__ import annotations

from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import StopLevels
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
