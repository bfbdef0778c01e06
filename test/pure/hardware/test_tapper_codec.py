"""The tapper's codec: checksum, incomplete frames, noise; corrupted frames are never accepted."""

from __future__ import annotations

import binascii

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.hardware import tapper_protocol as protocol
from tapping_cell.hardware.tapper_protocol import (
    Bad,
    Command,
    Mode,
    OtherFirmware,
    Reply,
    Result,
    State,
)

GOOD = b"7,12,OK,CHARGED,9,12500,1,0,8,350000,3,4294967295,RUN,1"


def framed(body: bytes) -> bytes:
    # Independent reference: binascii.crc_hqx with start value 0xFFFF is CRC-16/CCITT-FALSE.
    return b"@%s*%04X\n" % (body, binascii.crc_hqx(body, 0xFFFF))


def test_the_checksum_has_its_published_check_value() -> None:
    assert protocol.crc16(b"123456789") == 0x29B1


@given(st.binary(max_size=80))
def test_the_checksum_matches_the_library(data: bytes) -> None:
    assert protocol.crc16(data) == binascii.crc_hqx(data, 0xFFFF)


def test_a_request_can_be_typed_by_hand() -> None:
    assert protocol.encode(7, 12, Command.CHARGE, 9, 12500, 3000) == framed(
        b"7,12,CHARGE,9,12500,3000"
    )
    assert protocol.encode(7, 13, Command.MODE, Mode.RUN) == framed(b"7,13,MODE,RUN")


def test_a_reply_in_si_units() -> None:
    decoded = protocol.decode(framed(GOOD))
    assert decoded.rest == b""
    assert decoded.frame == Reply(
        7,
        12,
        Result.OK,
        State.CHARGED,
        9,
        0.0125,
        True,
        False,
        8,
        0.35,
        3,
        2**32 - 1,
        Mode.RUN,
        True,
    )


@pytest.mark.parametrize(
    ("body", "version"),
    [
        (b"7,12,WELCOME,SAFE,0,0,1,0,0,0,3,1.0.0", "1.0.0"),
        (b"7,12,WELCOME,whatever,comes,later,3.1.0-rc1", "3.1.0-rc1"),
    ],
)
def test_the_greeting_of_another_version_is_distinguished_from_noise(body, version):
    assert protocol.decode(framed(body)).frame == OtherFirmware(7, 12, version)


@given(st.integers(0, 2**32 - 1), st.floats(0.001, 0.1))
def test_a_deadline_is_never_later_than_its_window(time_ms: int, window: float) -> None:
    ahead = (protocol.deadline_after(time_ms, window) - time_ms) % 2**32
    assert window * 1e3 - 1 < ahead <= window * 1e3


def test_no_keyword_is_both_command_and_result() -> None:
    assert not {c.value for c in Command} & {r.value for r in Result}


@given(st.sampled_from(list(Command)), st.integers(1, 65535), st.integers(0, 65535))
def test_an_echoed_request_is_not_a_reply(command: Command, session: int, sequence: int) -> None:
    decoded = protocol.decode(protocol.encode(session, sequence, command))
    assert isinstance(decoded.frame, Bad)


@given(st.binary(max_size=400))
def test_any_bytes_are_tolerated_and_consumed(data: bytes) -> None:
    while data:
        decoded = protocol.decode(data)
        if decoded.frame is None:
            assert data.startswith(b"@") and len(data) <= protocol.LONGEST_FRAME
            return
        assert len(decoded.rest) < len(data)
        data = decoded.rest


@given(st.data())
def test_a_frame_with_one_or_two_bit_errors_is_never_accepted(data: st.DataObject) -> None:
    frame = bytearray(framed(GOOD))
    count = data.draw(st.integers(1, 2))
    bits = data.draw(
        st.lists(st.integers(0, 8 * len(frame) - 1), min_size=count, max_size=count, unique=True)
    )
    for bit in bits:
        frame[bit // 8] ^= 1 << bit % 8
    rest = bytes(frame)
    while rest:
        decoded = protocol.decode(rest)
        if decoded.frame is None:
            return
        if isinstance(decoded.frame, Reply):
            # A corrupted reply must not be accepted.
            pytest.fail(f"{bytes(frame)!r} was taken for {decoded.frame}")
        rest = decoded.rest


@given(st.lists(st.integers(1, 30), min_size=1), st.binary(max_size=20))
def test_fragments_and_noise_before_the_frame_are_tolerated(cuts: list[int], noise: bytes) -> None:
    stream = noise.replace(b"@", b"").replace(b"\n", b"") + framed(GOOD) * 2
    buffer, place, turn = b"", 0, 0
    replies = []
    while place < len(stream):
        size = cuts[turn % len(cuts)]
        turn += 1
        buffer += stream[place : place + size]
        place += size
        while True:
            decoded = protocol.decode(buffer)
            buffer = decoded.rest
            if decoded.frame is None:
                break
            if isinstance(decoded.frame, Reply):
                replies.append(decoded.frame)
    assert len(replies) == 2


@pytest.mark.parametrize(
    ("session", "sequence", "arguments"), [(0, 0, ()), (65536, 0, ()), (1, -1, ()), (1, 1, (-5,))]
)
def test_numbers_out_of_range_are_refused(session, sequence, arguments):
    with pytest.raises(ValueError):
        protocol.encode(session, sequence, Command.FIRE, *arguments)
