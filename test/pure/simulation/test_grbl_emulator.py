"""The emulated Grbl answers according to Grbl's documentation, and its arm moves according to
physics."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.grbl_machine import GrblMachine, default_settings
from tapping_cell.simulation.joint_motion import AxisErrors

UNLOCKED = default_settings() | {22: 0.0}


def board(**machine: object) -> GrblEmulator:
    options: dict[str, object] = {"settings": UNLOCKED, "start_joints": (0.0, 0.0, 0.0, 0.0)}
    emulator = GrblEmulator(GrblMachine(**(options | machine)))  # type: ignore[arg-type]
    emulator.take_output(0.5)
    return emulator


def exchange(emulator: GrblEmulator, data: bytes, at: float, until: float) -> list[str]:
    emulator.receive(data, at)
    return emulator.take_output(until).decode().split("\r\n")[:-1]


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"G1X5\n", 22),
        (b"G5\n", 20),
        (b"G1 X1 X2 F10\n", 25),
        (b"10\n", 1),
        (b"GX\n", 2),
        (b"$Q\n", 3),
        (b"$H\n", 5),
        (b"G1" + b" X1" * 40 + b"\n", 14),
        (b"$110=1.2.3\n", 2),
    ],
)
def test_error_numbers_match_grbl(line: bytes, code: int) -> None:
    assert exchange(board(), line, 1.0, 2.0) == [f"error:{code}"]


def test_locked_at_power_up_until_unlocked() -> None:
    emulator = board(settings=default_settings())
    assert exchange(emulator, b"G1X5F100\n", 1.0, 2.0) == ["error:9"]
    assert exchange(emulator, b"$X\nG1X5F100\n", 2.0, 3.0) == [
        "[MSG:Caution: Unlocked]",
        "ok",
        "ok",
    ]


def test_a_move_is_a_trapezoid_within_rate_and_acceleration() -> None:
    emulator = board()
    rate, pull = UNLOCKED[110] / 60, UNLOCKED[120]
    exchange(emulator, b"G1X90F100000\n", 1.0, 1.01)
    times = np.linspace(1.0, 1.0 + 90 / rate + rate / pull + 0.1, 2000)
    places = np.degrees([emulator.joints(t)[0] for t in times])
    speeds = np.gradient(places, times)
    pulls = np.gradient(speeds, times)
    assert np.max(speeds) == pytest.approx(rate, rel=1e-3)
    assert np.max(np.abs(pulls)) == pytest.approx(pull, rel=2e-2)
    assert places[-1] == pytest.approx(90)
    end = times[np.argmax(places > 90 - 1e-6)] - 1.0
    assert end == pytest.approx(90 / rate + rate / pull, abs=2e-3)


def test_hold_brakes_and_resume_continues() -> None:
    emulator = board()
    exchange(emulator, b"G1X90F1200\n", 1.0, 2.0)
    emulator.receive(b"!", 2.0)
    assert exchange(emulator, b"?", 2.01, 2.03)[0].startswith("<Hold:1|")
    assert exchange(emulator, b"?", 3.0, 3.1)[0].startswith("<Hold:0|")
    held = emulator.joints(3.0)[0]
    assert math.degrees(20 * 1.0) > held and emulator.joints(4.0)[0] == held
    emulator.receive(b"~", 4.0)
    emulator.advance(20.0)
    assert math.degrees(emulator.joints(20.0)[0]) == pytest.approx(90)


def test_reset_in_motion_is_alarm_3_and_loses_the_position() -> None:
    emulator = board()
    exchange(emulator, b"G1X90F1200\n", 1.0, 2.0)
    replies = exchange(emulator, b"\x18", 2.0, 2.1)
    assert replies[0] == "ALARM:3" and any(line.startswith("Grbl 1.1") for line in replies)
    (report,) = [t for t in exchange(emulator, b"?", 3.0, 3.1) if t.startswith("<")]
    assert report.startswith("<Alarm|")
    position = float(report.split("MPos:")[1].split(",")[0])
    assert abs(position - math.degrees(emulator.joints(3.0)[0])) > 0.01
    assert not emulator.moving(3.0)


def test_reset_at_rest_keeps_the_position_and_resets_the_modes() -> None:
    emulator = board()
    exchange(emulator, b"G92X7\nG18\nG91\n", 1.0, 2.0)
    assert "G18" in exchange(emulator, b"$G\n", 2.0, 2.1)[0]
    exchange(emulator, b"\x18", 3.0, 3.1)
    modes = exchange(emulator, b"$G\n", 4.0, 4.1)[0]
    assert "G17" in modes and "G90" in modes
    assert "[G92:0.000,0.000,0.000,0.000]" in exchange(emulator, b"$#\n", 5.0, 5.1)


def test_the_offset_is_reported_after_a_change_and_periodically() -> None:
    emulator = board()
    first = [exchange(emulator, b"?", 1 + i * 0.1, 1.05 + i * 0.1)[0] for i in range(40)]
    shown = [i for i, report in enumerate(first) if "WCO" in report]
    assert len(shown) >= 2 and max(np.diff(shown)) <= 31
    exchange(emulator, b"G92X3\n", 10.0, 10.1)
    assert "WCO:-3.000" in exchange(emulator, b"?", 11.0, 11.1)[0]


def test_lines_wait_for_buffer_space_and_all_are_executed() -> None:
    emulator = board()
    sent = b"".join(b"G1X%dF6000\n" % (i % 2) for i in range(1, 9))
    replies = exchange(emulator, sent, 1.0, 30.0)
    assert replies == ["ok"] * 8
    long = b"".join(b"G1X%dF600\n" % (i % 2) for i in range(1, 12))
    exchange(emulator, long, 30.0, 30.05)
    answers = exchange(emulator, long, 30.1, 60.0)
    assert answers.count("ok") >= 11 - 4  # bytes beyond the buffer of 128 were lost
    assert not emulator.moving(60.0)


def test_backlash_and_offset_affect_only_the_true_position() -> None:
    play = math.radians(0.5)
    emulator = board(errors=AxisErrors(offset=(0.01, 0, 0, 0), backlash=(play, 0, 0, 0)))
    exchange(emulator, b"G1X30F6000\n", 1.0, 5.0)
    assert emulator.joints(5.0)[0] == pytest.approx(math.radians(30) - play / 2 + 0.01)
    exchange(emulator, b"G1X20F6000\n", 5.0, 9.0)
    assert emulator.joints(9.0)[0] == pytest.approx(math.radians(20) + play / 2 + 0.01)
    assert "MPos:20.000" in exchange(emulator, b"?", 9.0, 9.1)[0]


def test_repeatability_has_its_own_spread_and_is_seeded() -> None:
    spread = 1e-3
    errors = AxisErrors(repeatability=(spread, spread, 0, 0))
    ends = []
    emulator = board(errors=errors)
    for i in range(400):
        exchange(emulator, b"G1X%dF6000\n" % (i % 2), 1 + i, 1.99 + i)
        ends.append(emulator.joints(1.99 + i)[0] - math.radians(i % 2))
    # The first end is excluded: the arm was at this target from the start and did not move.
    assert np.std(ends[1:]) == pytest.approx(spread, rel=0.15)


def test_homing_finds_the_switches_from_anywhere() -> None:
    home = (0.3, 1.2, -0.01, 0.4)
    emulator = board(settings=default_settings(), home_joints=home, start_joints=(1, 0, -0.1, 2))
    assert exchange(emulator, b"$H\n", 1.0, 60.0) == ["ok"]
    assert emulator.joints(60.0) == pytest.approx(home)
    assert exchange(emulator, b"?", 60.0, 60.1)[0].startswith(
        "<Idle|MPos:-1.000,-1.000,-1.000,-1.000"
    )
