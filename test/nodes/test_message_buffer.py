"""Messages that the recorder keeps before a recording, also if the clock is set back."""

from __future__ import annotations

import pytest

from tapping_cell.nodes.recorder.reception import MessageBuffer
from tapping_cell.nodes.recorder.recording import ReceivedMessage

LEAD_S = 2.0


def add(buffer: MessageBuffer, *times: float) -> None:
    for time in times:
        message = ReceivedMessage("topic", round(1e9 * time), b"")
        buffer.add(message, latched=False, seldom=False)


def times(buffer: MessageBuffer) -> list[float]:
    """Return the times of the messages, without the notes of the recording."""
    return [1e-9 * message.stamp for message in buffer.take() if message.topic == "topic"]


def begin(buffer: MessageBuffer, now: float) -> None:
    buffer.begin(round(1e9 * now), "notes", b"")


def test_a_recording_begins_with_the_last_seconds() -> None:
    buffer = MessageBuffer(LEAD_S)
    add(buffer, 1.0, 5.0, 6.0)
    begin(buffer, 6.5)
    add(buffer, 7.0)
    assert times(buffer) == pytest.approx([5.0, 6.0, 7.0])


def test_the_clock_is_set_back_before_a_recording() -> None:
    buffer = MessageBuffer(LEAD_S)
    add(buffer, 3600.0, 10.0, 15.0, 16.0)
    begin(buffer, 16.5)
    add(buffer, 17.0)
    assert times(buffer) == pytest.approx([15.0, 16.0, 17.0])


def test_the_clock_is_set_back_a_little_before_a_recording() -> None:
    buffer = MessageBuffer(LEAD_S)
    add(buffer, 11.0, 10.0)
    begin(buffer, 10.5)
    add(buffer, 10.6)
    assert times(buffer) == pytest.approx([10.0, 10.6, 11.0])


def test_the_clock_is_set_back_during_a_recording() -> None:
    buffer = MessageBuffer(LEAD_S)
    add(buffer, 3600.0)
    begin(buffer, 3600.5)
    add(buffer, 3601.0, 10.0, 11.0)
    assert times(buffer) == pytest.approx([10.0, 11.0, 3600.0, 3601.0])
