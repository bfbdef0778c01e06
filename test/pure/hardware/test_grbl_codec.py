"""Grbl's codec: real lines, incomplete lines, noise."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.hardware import grbl
from tapping_cell.hardware.text_line import LONGEST_LINE, Bad


def all_frames(data: bytes) -> list[grbl.Frame]:
    frames = []
    while True:
        decoded = grbl.decode(data)
        data = decoded.rest
        if decoded.frame is None:
            return frames
        frames.append(decoded.frame)


# Lines from the documentation of Grbl 1.1.
@pytest.mark.parametrize(
    ("line", "frame"),
    [
        (b"ok", grbl.Ok()),
        (b"error:20", grbl.Error(20)),
        (b"ALARM:3", grbl.Alarm(3)),
        (b"Grbl 1.1h ['$' for help]", grbl.Banner("Grbl", "1.1h")),
        (b"$110=500.000", grbl.Setting(110, 500.0)),
        (b"[VER:1.1f.20170131:Some string]", grbl.Message("VER", "1.1f.20170131:Some string")),
        (b"[MSG:Caution: Unlocked]", grbl.Message("MSG", "Caution: Unlocked")),
        (
            b"<Idle|MPos:0.000,-12.500,3.000,90.000|FS:0.0,0|WCO:1.000,0.000,0.000,0.000>",
            grbl.Status("Idle", None, (0.0, -12.5, 3.0, 90.0), None, (1.0, 0.0, 0.0, 0.0)),
        ),
        (
            b"<Hold:1|WPos:1.000,2.000,3.000|Bf:15,128>",
            grbl.Status("Hold", 1, None, (1.0, 2.0, 3.0), None),
        ),
    ],
)
def test_lines_from_the_documentation_are_decoded(line: bytes, frame: grbl.Frame) -> None:
    assert all_frames(line + b"\r\n") == [frame]


@pytest.mark.parametrize(
    "line",
    [
        b"<Idle|MPos:0.000,0.000>",
        b"<Idle|FS:0,0>",
        b"<Idme|MPos:0.000,0.000,0.000>",
        b"<Idle|MPos:0.000,0.000,0.000",
        b"<Idle|MPos:0.000,0.000,0.000,0.000|WCO:0.000,0.000,0.000>",
        b"<Idle|MPos:nan,0.000,0.000>",
        b"<Idle|MPos:0.000,0.000,0.000|MPos:0.000,0.000,0.000>",
        b"error:",
        b"error:1e9",
        b"okk",
        b"\xff\xfe",
    ],
)
def test_partly_valid_lines_are_invalid(line: bytes) -> None:
    (frame,) = all_frames(line + b"\n")
    assert isinstance(frame, Bad)


@given(st.binary(max_size=700))
def test_any_bytes_are_tolerated_and_consumed(data: bytes) -> None:
    while True:
        decoded = grbl.decode(data)
        assert decoded.frame is None or len(decoded.rest) < len(data)
        data = decoded.rest
        if decoded.frame is None:
            assert b"\n" not in data and len(data) <= LONGEST_LINE
            return


positions = st.tuples(*[st.floats(-9999, 9999)] * 4)
lines = st.one_of(
    st.just(b"ok"),
    st.integers(1, 60).map(lambda n: b"error:%d" % n),
    positions.map(lambda p: ("<Run|MPos:" + ",".join(f"{v:.3f}" for v in p) + ">").encode()),
)


@given(st.lists(lines, max_size=8), st.lists(st.integers(1, 40), min_size=1))
def test_fragments_give_the_same_result_as_the_whole(parts: list[bytes], cuts: list[int]) -> None:
    whole = b"".join(part + b"\r\n" for part in parts)
    buffer, place, found, turn = b"", 0, [], 0
    while place < len(whole):
        size = cuts[turn % len(cuts)]
        turn += 1
        buffer += whole[place : place + size]
        place += size
        while (decoded := grbl.decode(buffer)).frame is not None:
            found.append(decoded.frame)
            buffer = decoded.rest
        buffer = decoded.rest
    assert found == all_frames(whole) and len(found) == len(parts)


@given(positions, st.floats(0.01, 99999))
def test_a_move_line_is_short_and_states_every_mode(position, feed):
    line = grbl.move_line("XYZA", position, feed)
    assert line.startswith(b"G21G90G94G1X") and line.endswith(b"\n")
    assert len(line) <= 80
    assert sum(line.count(letter) for letter in (b"X", b"Y", b"Z", b"A", b"F")) == 5


@pytest.mark.parametrize(("values", "feed"), [((math.nan, 0, 0, 0), 1), ((0, 0, 0, 0), 0)])
def test_non_finite_values_give_no_line(values: tuple[float, ...], feed: float) -> None:
    with pytest.raises(ValueError):
        grbl.move_line("XYZA", values, feed)
