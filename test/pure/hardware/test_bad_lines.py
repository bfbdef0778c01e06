"""The drivers over disturbed lines in virtual time: no tap is fired twice or unsafely, no wrong
result is reported, and nothing hangs."""

from __future__ import annotations

import argparse
import json

import numpy as np
import pytest

from lab.commands import drivers
from lab.drivers.driver_trials import Dialect, TrialCell, bytes_of_a_tap, run_sweep, run_taps
from tapping_cell.hardware.tapper import FireOutcome
from tapping_cell.simulation.fault_layer import (
    Direction,
    FaultKind,
    FaultLayer,
    LineFault,
    random_fault,
)

THOROUGH = (Dialect.GRBL, Dialect.MARLIN)
"""Dialects with complete tests."""
TAPS = 30
"""Number of taps of the tests with random faults."""


@pytest.mark.parametrize("dialect", Dialect)
def test_random_faults(dialect: Dialect) -> None:
    tally = run_taps(dialect, TAPS, seed=20)
    assert tally.clean, tally.notes
    assert tally.taps == TAPS == tally.fired + tally.not_fired + tally.unknown
    assert tally.faults_struck > TAPS / 3
    # Most taps must still be fired: a driver that refuses everything would be safe but useless.
    assert tally.fired > TAPS / 2


@pytest.mark.parametrize(
    ("dialect", "seed"),
    [(Dialect.MARLIN, 1_000_003), (Dialect.GRBL, 1_000_048), (Dialect.MARLIN, 2_000_073)],
)
def test_seeds_that_once_gave_a_false_report_or_an_unreset_board(dialect, seed):
    """Regression tests for three cases: one line number was used for two lines; a wrong bit changed
    a move line to G92; after a corrupted answer to M115, a stop halted the board while its cable
    was disconnected."""
    tally = run_taps(dialect, 100, seed)
    assert tally.clean, tally.notes


@pytest.mark.parametrize("dialect", THOROUGH)
@pytest.mark.parametrize("kind", [FaultKind.RESET, FaultKind.HANG_UP])
def test_a_reset_or_an_unplugged_cable_during_a_tap(dialect: Dialect, kind: FaultKind) -> None:
    """A fault occurs at one byte of a tap. About four bytes of each line and direction are tested
    here; `lab drivers --every-byte` tests all bytes."""
    for (line, direction), count in bytes_of_a_tap(dialect).items():
        step = max(41, count // 4)
        tally = run_sweep(dialect, kind, line, direction, range(0, count, step))
        assert tally.clean, tally.notes
        assert tally.faults_struck > 0


def test_lost_replies_to_fire_are_resolved_without_a_second_shot() -> None:
    """If FIRE arrives but its answers are lost, the next request reports that the shot was
    fired."""
    cell = TrialCell(Dialect.GRBL, 1)
    cell.recover()
    line = cell.tapper_line
    original = cell.tapper_device.on_fire

    def lose_answers(shot: int, energy: float, now: float) -> float | None:
        first = line.count(Direction.TO_HOST)
        line.add(LineFault(FaultKind.DROP, Direction.TO_HOST, first, length=200))
        return original(shot, energy, now) if original else None

    cell.tapper_device.on_fire = lose_answers
    assert cell.tap() is FireOutcome.FIRED
    assert len(cell.tapper_device.fires) == 1
    assert cell.tally.clean, cell.tally.notes


def test_a_board_reset_after_fire_is_unknown() -> None:
    cell = TrialCell(Dialect.GRBL, 1)
    cell.recover()
    line = cell.tapper_line
    original = cell.tapper_device.on_fire

    def restart(shot: int, energy: float, now: float) -> float | None:
        line.add(LineFault(FaultKind.RESET, Direction.TO_HOST, line.count(Direction.TO_HOST)))
        line.add(
            LineFault(FaultKind.DROP, Direction.TO_HOST, line.count(Direction.TO_HOST) + 1, 90)
        )
        return original(shot, energy, now) if original else None

    cell.tapper_device.on_fire = restart
    assert cell.tap() is FireOutcome.UNKNOWN
    assert len(cell.tapper_device.fires) == 1


def test_the_monitor_detects_unsafe_and_double_shots() -> None:
    """The checks used by these tests detect an unsafe shot and a double shot."""
    cell = TrialCell(Dialect.GRBL, 1)
    cell.recover()
    assert cell.tap() is FireOutcome.FIRED
    cell._record_fire(1, 0.01, cell.clock.now)
    assert cell.tally.unsafe_fires == 1
    cell.tapper_device.fires.append((1, 0.01, cell.clock.now))
    cell._record_fire(1, 0.01, cell.clock.now)
    assert cell.tally.double_fires >= 1
    cell.reported[1] = FireOutcome.NOT_FIRED
    cell.check_reports()
    assert cell.tally.false_reports == 1
    assert not cell.tally.clean


class Echo:
    """A device that sends back what it receives."""

    def __init__(self) -> None:
        self.data = b""
        self.starts = 0

    def receive(self, data: bytes, now: float) -> None:
        self.data += data

    def advance(self, now: float) -> None: ...

    def take_output(self, now: float) -> bytes:
        data, self.data = self.data, b""
        return data

    def next_event(self) -> float | None:
        return 0.0 if self.data else None

    def power_cycle(self, now: float) -> None:
        self.starts += 1
        self.data = b""


def through(fault: LineFault, *times: float) -> list[bytes]:
    line = FaultLayer(Echo(), [fault])
    line.receive(b"0123456789", 0.0)
    return [line.take_output(time) for time in times]


TO = Direction.TO_DEVICE


@pytest.mark.parametrize(
    ("fault", "times", "out"),
    [
        (LineFault(FaultKind.DROP, TO, 2, length=3), (0.0,), [b"0156789"]),
        (LineFault(FaultKind.DUPLICATE, TO, 2, length=3), (0.0,), [b"0123423456789"]),
        (LineFault(FaultKind.FLIP, TO, 2, bit=0), (0.0,), [b"0133456789"]),
        (LineFault(FaultKind.DELAY, TO, 2, duration=1.0), (0.5, 1.0), [b"01", b"23456789"]),
        (LineFault(FaultKind.SPLIT, TO, 9, duration=0.1), (0.0, 0.1), [b"012345678", b"9"]),
        (LineFault(FaultKind.STALL, TO, 2, duration=1.0), (0.9, 1.0), [b"", b"0123456789"]),
        (LineFault(FaultKind.HANG_UP, TO, 2, duration=1.0), (0.5, 1.5), [b"", b""]),
        (LineFault(FaultKind.RESET, TO, 2), (0.0,), [b"23456789"]),
    ],
)
def test_each_fault_has_its_stated_effect(fault, times, out):
    assert through(fault, *times) == out


def test_merged_bytes_arrive_with_the_following_bytes() -> None:
    line = FaultLayer(Echo(), [LineFault(FaultKind.MERGE, TO, 0, length=4, duration=5.0)])
    line.receive(b"01", 0.0)
    assert line.take_output(0.1) == b""
    line.receive(b"234", 0.2)
    assert line.take_output(0.2) == b"01234"


def test_a_port_that_vanishes_reappears() -> None:
    seen: list[bool] = []
    line = FaultLayer(Echo(), [LineFault(FaultKind.HANG_UP, TO, 0, duration=1.0)], seen.append)
    line.receive(b"x", 0.0)
    assert not line.plugged and seen == [False]
    line.advance(1.0)
    assert line.plugged and seen == [False, True] and line.absences == 1


def test_random_faults_are_repeatable_and_of_every_kind() -> None:
    drawn = [
        [random_fault(np.random.default_rng(i), TO, 0, 100) for i in range(300)] for _ in range(2)
    ]
    assert drawn[0] == drawn[1]
    assert {fault.kind for fault in drawn[0]} == set(FaultKind)


def run_command(*words: str) -> int:
    parser = argparse.ArgumentParser()
    drivers.add_arguments(parser)
    return drivers.run(parser.parse_args(words))


def test_the_command_prints_json_and_is_repeatable(capsys: pytest.CaptureFixture[str]) -> None:
    results = []
    for jobs in ("1", "2"):
        assert run_command("--taps", "60", "--seed", "3", "--jobs", jobs, "--json") == 0
        result = json.loads(capsys.readouterr().out)
        result.pop("wall_time")
        results.append(result)
    assert results[0]["taps"] == 60
    for key in ("double_fires", "unsafe_fires", "hangs", "false_reports"):
        assert results[0][key] == 0
    order = [json.dumps(result, sort_keys=True) for result in results]
    assert order[0] == order[1]


def test_the_command_refuses_invalid_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command("--taps", "0") == 2
    assert "--taps" in capsys.readouterr().err
