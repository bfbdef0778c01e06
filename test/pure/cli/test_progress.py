"""Progress of long commands, in a terminal and in a pipe."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from tapping_cell.cli import progress as module
from tapping_cell.cli.progress import progress


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def test_a_pipe_gets_a_line_every_few_seconds(clock: list[float]) -> None:
    output = io.StringIO()
    with progress("trials", 60, completed=2, console=Console(file=output)) as advance:
        for _ in range(50):
            clock[0] += 0.3 * module.PERIOD_S
            advance(note="[3]")
    lines = output.getvalue().splitlines()
    assert len(lines) == 50 // 4
    assert lines[0] == "trials: 6 of 60 after 12 s, [3]"


def test_a_short_command_prints_no_progress(clock: list[float]) -> None:
    output = io.StringIO()
    with progress("trials", 60, console=Console(file=output)) as advance:
        advance(60)
    assert output.getvalue() == ""


def test_a_terminal_shows_a_bar_that_disappears() -> None:
    output = io.StringIO()
    terminal = Console(file=output, force_terminal=True, width=80)
    with progress("trials", 60, console=terminal) as advance:
        advance(30, note="far")
    assert "trials" in output.getvalue()
    assert not output.getvalue().endswith("\n")
