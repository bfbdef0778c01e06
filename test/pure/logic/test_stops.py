"""The stop latch: which sources hold a stop, and what a person has confirmed."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.logic import tapper_jobs
from tapping_cell.logic.clock import Now
from tapping_cell.logic.device import STOP_AGAIN_S
from tapping_cell.logic.effects import JobContext, StopLevels, StopWire
from tapping_cell.logic.stops import CONFIRM_WITHIN_S, SERVICE, TOPIC, StopLatch
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
from tapping_cell.messages import Bool

QUIET = StopLevels(asserted=False, publishers=(), gone=())


def reset(latch: StopLatch, levels: StopLevels, steady: float) -> str:
    """Request a reset, and answer the request at once."""
    now = Now(steady, 0)
    return latch.try_reset(latch.begin_reset(now), levels, now)


@given(st.lists(st.sampled_from([True, False, SERVICE, "another source"]), max_size=6))
@example([True, False, True])
def test_every_change_of_the_latch_is_reported_and_restored_after_a_restart(operations):
    latch = StopLatch()
    for operation in operations:
        before, sources = latch.content(), latch.sources
        is_level = isinstance(operation, bool)
        changed = latch.receive(operation) if is_level else latch.press(operation)
        assert changed == (latch.content() != before)
        source = TOPIC if is_level else operation
        added = operation is not False and source not in sources
        assert latch.sources == (*sources, source) if added else latch.sources == sources
        asserted = (latch.content() or {}).get("asserted", False)
        assert bool(latch.advice()) == latch.stopped
        assert latch.advice().startswith("release the emergency stop") == asserted
    restored = StopLatch()
    restored.recall(latch.content())
    assert restored.content() == latch.content()


def test_a_stop_received_before_the_stored_one_is_recalled_stays_asserted() -> None:
    latch = StopLatch()
    latch.receive(True)
    latch.recall({"sources": [SERVICE], "asserted": False})
    assert latch.content() == {"sources": [TOPIC, SERVICE], "asserted": True}


def test_no_reset_without_an_answer_of_the_publishers() -> None:
    latch = StopLatch()
    latch.press()
    for steady in (10.0, 11.0):
        request = latch.begin_reset(Now(steady, 0))
        assert "could not be determined" in latch.try_reset(request, None, Now(steady, 0))
    assert latch.stopped


def test_a_level_found_by_a_reset_is_remembered_until_the_reset_succeeds() -> None:
    """The publisher that asserts the stop disappears before the next request to reset."""
    latch = StopLatch()
    latch.press()
    assert "still held" in reset(latch, StopLevels(True, ("a",), ()), 10.0)
    assert "without releasing it" in reset(latch, QUIET, 11.0)
    assert reset(latch, QUIET, 12.0) == ""
    latch.press()
    assert reset(latch, QUIET, 13.0) == "", "the reset has ended the doubt"


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
    assert CONFIRM_WITHIN_S == 30.0, "the limit of docs/safety.md"
    assert reset(latch, gone, 10.0)
    assert reset(latch, gone, 10.1 + CONFIRM_WITHIN_S)


def test_a_request_made_before_the_refusal_was_answered_is_no_confirmation() -> None:
    """A double click, or two people at two pages: nobody has read the refusal yet."""
    latch = StopLatch()
    latch.receive(True)
    gone = StopLevels(False, (), ("a",))
    first, second = latch.begin_reset(Now(10.0, 0)), latch.begin_reset(Now(10.3, 0))
    assert "(a)" in latch.try_reset(first, gone, Now(10.5, 0))
    assert "(a)" in latch.try_reset(second, gone, Now(10.8, 0))
    assert latch.stopped
    assert reset(latch, gone, 11.0) == ""


def test_a_stop_between_two_requests_also_refuses_the_first() -> None:
    latch = StopLatch()
    latch.press()
    first = latch.begin_reset(Now(10.0, 0))
    latch.press()
    second = latch.begin_reset(Now(10.2, 0))
    assert "a stop occurred during clear_fault" in latch.try_reset(first, QUIET, Now(10.5, 0))
    assert latch.stopped
    assert latch.try_reset(second, QUIET, Now(10.7, 0)) == ""


@pytest.mark.parametrize("released_before", [False, True])
@given(st.lists(st.booleans(), max_size=4))
def test_a_stop_of_the_topic_that_outlived_a_restart_requires_a_confirmation(
    released_before: bool, levels: list[bool]
) -> None:
    """The restarted node does not know which publisher asserted the stop, so a False of another
    publisher, before or after the restart, does not show that the stop was released."""
    before = StopLatch()
    before.receive(True)
    if released_before:
        before.receive(False)
    latch = StopLatch()
    latch.recall(before.content())
    for level in [*levels, False]:
        latch.receive(level)
    assert "restarted" in reset(latch, QUIET, 10.0)
    assert latch.stopped
    again = StopLatch()
    again.recall(latch.content())
    assert "restarted" in reset(again, QUIET, 10.0)
    assert reset(latch, QUIET, 11.0) == ""
    latch.receive(True)
    latch.receive(False)
    assert reset(latch, QUIET, 12.0) == "", "the reset has ended the doubt about the old stop"


@pytest.mark.parametrize("content", [{}, {"sources": "?"}, {"sources": [], "asserted": False}])
def test_a_stored_stop_that_cannot_be_read_requires_a_confirmation(content: dict[str, Any]) -> None:
    latch = StopLatch()
    latch.recall(content)
    again = StopLatch()
    again.recall(latch.content())
    for each in (latch, again):
        each.receive(False)
        assert "restarted" in reset(each, QUIET, 10.0)
        assert reset(each, QUIET, 11.0) == ""


@given(st.one_of(st.none(), st.just(True), st.integers(), st.text()))
def test_a_stored_level_that_is_not_false_counts_as_asserted(level: Any) -> None:
    latch = StopLatch()
    latch.recall({"sources": [SERVICE], "asserted": level})
    assert "without releasing it" in reset(latch, QUIET, 10.0)
    assert latch.stopped
    assert reset(latch, QUIET, 11.0) == ""


def test_a_stop_of_the_service_needs_no_confirmation_after_a_restart() -> None:
    before = StopLatch()
    before.press()
    latch = StopLatch()
    latch.recall(before.content())
    assert reset(latch, QUIET, 10.0) == ""


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


def test_a_repeated_emergency_stop_is_sent_to_the_tapper_again_but_not_at_every_message() -> None:
    """A board that lost its power, or the first STOP, must stop when a person presses again."""
    device, sent = TapperLogic(TapperOptions()), []
    for count in range(31):
        time = 10.0 + 0.1 * count
        effects = device.on_message("emergency_stop", Bool(data=True), Now(time, 0))
        if any(isinstance(effect, StopWire) for effect in effects):
            sent.append(time)
    assert sent[0] == 10.0 and len(sent) in (3, 4)
    assert all(later - earlier >= STOP_AGAIN_S for earlier, later in itertools.pairwise(sent))
    effects = device.on_message("emergency_stop", Bool(data=False), Now(20.0, 0))
    assert not any(isinstance(effect, StopWire) for effect in effects)


def test_a_refusal_that_was_not_answered_is_confirmed_by_no_request() -> None:
    """An internal error in the handler that refuses: the operator has not read the refusal."""
    tapper, gone = TapperLogic(TapperOptions()), StopLevels(False, (), ("a",))
    latch = tapper._stops
    latch.receive(True)
    now = Now(10.0, 10_000_000_000)
    assert "(a)" in latch.try_reset(latch.begin_reset(now), gone, now)
    tapper.on_defect(ZeroDivisionError(), now)
    assert "(a)" in reset(latch, gone, 11.0)
    assert latch.stopped
