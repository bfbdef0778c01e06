"""Marlin's codec: real answers, incomplete lines, noise; numbered lines and their checksum."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.hardware import marlin
from tapping_cell.hardware.text_line import LONGEST_LINE, Bad, Decoded


# Answers of real boards.
@pytest.mark.parametrize(
    ("line", "frame"),
    [
        (b"ok", marlin.Ok()),
        (b"ok N5 P15 B3", marlin.Ok()),
        (b"echo:busy: processing", marlin.Busy()),
        (b"start", marlin.Start()),
        (b"Resend: 2", marlin.Resend(2)),
        (b"Error:checksum mismatch, Last Line: 1", marlin.LineError("checksum mismatch", 1)),
        (
            b"Error:Line Number is not Last Line Number+1, Last Line: 1",
            marlin.LineError("Line Number is not Last Line Number+1", 1),
        ),
        (
            b"Error:No Checksum with line number, Last Line: 1",
            marlin.LineError("No Checksum with line number", 1),
        ),
        (b'echo:Unknown command: "M9999"', marlin.Unknown("M9999")),
        (b"Cap:EMERGENCY_PARSER:1", marlin.Capability("EMERGENCY_PARSER", True)),
        (
            b"echo:  M92 X80.00 Y80.00 Z400.00",
            marlin.AxisFigures("M92", {"X": 80.0, "Y": 80.0, "Z": 400.0}),
        ),
        (b"  M203 X115.00 Y143", marlin.AxisFigures("M203", {"X": 115.0, "Y": 143.0})),
        (
            b"Soft endstops: On  Min:   X-5.00 Y0.00  Max:   X220.00 Y200.00",
            marlin.SoftEndstops(True, {"X": -5.0, "Y": 0.0}, {"X": 220.0, "Y": 200.0}),
        ),
        (
            b"X:1.50 Y:-2.00 Z:0.00 A:90.00 Count X:300 Y:-400 Z:0 A:9000",
            marlin.Position(
                {"X": 1.5, "Y": -2.0, "Z": 0.0, "A": 90.0}, {"X": 300, "Y": -400, "Z": 0, "A": 9000}
            ),
        ),
        (
            b"ok X:0.0 Y:0.0 Z:0.0 E:0.0 Count: A:0 B:0 C:0",
            marlin.Position(
                {"X": 0.0, "Y": 0.0, "Z": 0.0, "E": 0.0}, {"A": 0, "B": 0, "C": 0}, with_ok=True
            ),
        ),
        (
            b"FIRMWARE_NAME:Marlin 2.1.2 (Jun  5 2023 12:00:00) SOURCE_CODE_URL:github.com/x"
            b" PROTOCOL_VERSION:1.0",
            marlin.FirmwareName("Marlin 2.1.2 (Jun  5 2023 12:00:00)"),
        ),
        (b"Error:Printer halted. kill() called!", marlin.Halted("Printer halted. kill() called!")),
    ],
)
def test_replies_of_real_boards_are_decoded(line: bytes, frame: marlin.Frame) -> None:
    assert marlin.decode(line + b"\r\n") == Decoded(frame, b"")


@pytest.mark.parametrize(
    "line", [b"okay", b"o", b"Resend: x", b"X:1.5 Y:2.0 Z:", b"X:nan Y:0.00", b"\xffok", b"ok\x00"]
)
def test_partly_valid_lines_are_invalid(line: bytes) -> None:
    assert isinstance(marlin.decode(line + b"\n").frame, Bad)


@given(st.binary(max_size=700))
def test_any_bytes_are_tolerated_and_consumed(data: bytes) -> None:
    while True:
        decoded = marlin.decode(data)
        if decoded.frame is None:
            assert b"\n" not in decoded.rest and len(decoded.rest) <= LONGEST_LINE
            return
        assert len(decoded.rest) < len(data)
        data = decoded.rest


def test_the_checksum_of_the_documentation() -> None:
    # Examples of the RepRap wiki, section "Checking": N3 T0*57 and N4 G92 E0*67.
    assert marlin.numbered(3, "T0") == b"N3 T0*57\n"
    assert marlin.numbered(4, "G92 E0") == b"N4 G92 E0*67\n"


def test_values_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError):
        marlin.move_code("XYZA", (0.0, float("inf"), 0.0, 0.0), 100.0)
    with pytest.raises(ValueError):
        marlin.move_code("XYZA", (0.0, 0.0, 0.0, 0.0), float("nan"))
