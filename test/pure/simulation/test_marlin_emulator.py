"""The emulated Marlin behaves as real firmware does. The expected answers to incorrect lines were
measured on real firmware."""

from __future__ import annotations

from functools import reduce

import pytest

from tapping_cell.simulation.marlin_emulator import MarlinEmulator, MarlinMachine


def line(number: int, code: str) -> bytes:
    body = f"N{number} {code}"
    return f"{body}*{reduce(lambda a, b: a ^ b, body.encode())}\n".encode()


def exchange(board: MarlinEmulator, data: bytes, at: float, until: float) -> list[str]:
    board.receive(data, at)
    return board.take_output(until).decode().splitlines()


@pytest.fixture
def board() -> MarlinEmulator:
    emulator = MarlinEmulator()
    assert exchange(emulator, line(1, "G21"), 0.0, 1.0)[-1] == "ok"
    return emulator


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        (line(2, "G21").replace(b"G21", b"G20"), "checksum mismatch"),
        (line(4, "G21"), "Line Number is not Last Line Number+1"),
        (b"N2 G21\n", "No Checksum with line number"),
    ],
)
def test_wrong_lines(board: MarlinEmulator, sent: bytes, why: str) -> None:
    assert exchange(board, sent, 1.0, 2.0) == [f"Error:{why}, Last Line: 1", "Resend: 2", "ok"]


def test_a_duplicate_gets_no_reply_and_the_next_number_is_accepted(board: MarlinEmulator) -> None:
    assert exchange(board, line(1, "G21"), 1.0, 5.0) == []
    assert exchange(board, line(2, "G21"), 5.0, 6.0) == ["ok"]


def test_an_unknown_code(board: MarlinEmulator) -> None:
    assert exchange(board, line(2, "M9999"), 1.0, 2.0) == ['echo:Unknown command: "M9999"', "ok"]


def test_a_slow_move_reports_busy_and_m114_runs_ahead(board: MarlinEmulator) -> None:
    assert exchange(board, line(2, "G1 X100 F600"), 1.0, 1.1) == ["ok"]
    position = exchange(board, line(3, "M114"), 1.1, 1.2)[0]
    assert position.startswith("X:100.00") and " Count X:" in position
    assert int(position.split("Count X:")[1].split()[0]) < 100 * 200
    assert exchange(board, line(4, "M400"), 1.2, 10.0) == ["echo:busy: processing"] * 4
    assert exchange(board, b"", 10.0, 12.0) == ["ok"]


def test_a_kill_during_motion_silences_the_board_until_reset(board: MarlinEmulator) -> None:
    exchange(board, line(2, "G1 X100 F600"), 1.0, 1.1)
    exchange(board, b"M112\n", 2.0, 2.05)
    assert not board.moving(2.06)
    assert exchange(board, b"M999\n", 3.0, 5.0) == []
    board.power_cycle(5.0)
    assert exchange(board, line(1, "G21"), 5.0, 6.0)[-1] == "ok"


def test_a_numbered_kill_waits_in_the_queue() -> None:
    board = MarlinEmulator(MarlinMachine(emergency_parser=False))
    exchange(board, line(1, "G1 X100 F600"), 0.0, 0.1)
    exchange(board, line(2, "M112"), 0.5, 3.0)
    assert board.moving(3.0) and not board.halted
    board.advance(12.0)
    assert board.halted


@pytest.mark.parametrize("parser", [True, False])
def test_m410_stops_at_once_only_with_the_emergency_parser(parser: bool) -> None:
    board = MarlinEmulator(MarlinMachine(emergency_parser=parser))
    exchange(board, line(1, "G1 X100 F600"), 0.0, 0.1)
    board.receive(b"M410\n", 1.0)
    assert board.moving(1.1) is not parser
