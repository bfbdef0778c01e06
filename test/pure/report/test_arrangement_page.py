"""The report of an arrangement: the moves of each object, their order, and their reasons."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from tapping_cell.cli import main
from tapping_cell.report.arrangement_page import headline, page
from tapping_cell.report.arrangement_run import (
    SUMMARY,
    ArrangedObject,
    ArrangedTap,
    ArrangementRun,
    moves_of,
    read_arrangement,
    to_content,
)
from tapping_cell.report.run_folder import RunError
from tapping_cell.se2 import Pose

SQUARE = ((-0.02, -0.02), (0.02, -0.02), (0.02, 0.02), (-0.02, 0.02))
FINE, COARSE = (0.001, math.radians(1.0)), (0.002, math.radians(3.0))
ONE, OTHER, BUFFER = Pose(-0.1, 0.0, 0.0), Pose(0.1, 0.0, 0.5), Pose(0.0, 0.12, 0.0)
AWAY = "'<b> 2' makes way: it is in the way of 'disk'"
HOME = "'<b> 2' goes to its goal: its goal and a path to it are free"


def tap(number: int, name: str, before: Pose, after: Pose | None, purpose: str) -> ArrangedTap:
    end = after or before
    return ArrangedTap(number, name, before, end, after, before, 0.4, "fired", purpose, "")


@pytest.fixture
def run() -> ArrangementRun:
    """Return a run in which two objects exchange their places and one of them moves out of the way
    first."""
    middle = Pose(0.05, 0.06, 0.2)
    taps = (
        tap(1, "<b> 2", OTHER, middle, AWAY),
        tap(2, "<b> 2", middle, BUFFER, AWAY),
        tap(3, "disk", ONE, OTHER, "'disk' goes to its goal: its goal and a path to it are free"),
        tap(4, "<b> 2", BUFFER, None, HOME),
        tap(5, "<b> 2", BUFFER, ONE, HOME),
    )
    return ArrangementRun(
        name="run",
        began=1.7e9,
        seconds=42.0,
        table_size=(0.6, 0.44),
        objects=(
            ArrangedObject("disk", SQUARE, ONE, OTHER, OTHER, OTHER, "reached", 1, FINE),
            ArrangedObject("<b> 2", SQUARE, OTHER, ONE, ONE, None, "reached", 4, COARSE),
        ),
        taps=taps,
        contacts=(),
        error_code=0,
        error_msg="",
    )


def write(run: ArrangementRun, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    content = json.dumps({"reached": True, "run": to_content(run)}, allow_nan=False)
    (folder / SUMMARY).write_text(content)
    return folder


def test_the_file_preserves_every_value(run: ArrangementRun, tmp_path: Path) -> None:
    assert read_arrangement(write(run, tmp_path)) == run


def test_consecutive_taps_of_an_object_are_one_move(run: ArrangementRun) -> None:
    moves = moves_of(run)
    assert [(move.name, [tap.number for tap in move.taps]) for move in moves] == [
        ("<b> 2", [1, 2]),
        ("disk", [3]),
        ("<b> 2", [4, 5]),
    ]
    assert moves[0].before == {"disk": ONE, "<b> 2": OTHER}
    assert moves[0].after == {"disk": ONE, "<b> 2": BUFFER}
    assert moves[1].after == {"disk": OTHER, "<b> 2": BUFFER}
    assert moves[-1].after == {"disk": OTHER, "<b> 2": ONE}


def test_the_page_lists_each_object_and_each_reason(run: ArrangementRun) -> None:
    text = page(run)
    assert headline(run) == "Arrangement reached: 2 objects, 5 taps"
    assert "1. &#39;&lt;b&gt; 2&#39; makes way: it is in the way of &#39;disk&#39;." in text
    assert "Taps 1 to 2: moved by 156 mm; remaining error 156.20 mm, 0.00 deg." in text
    shown = text.replace("\u00a0", " ")
    assert "-100.0 mm, 0.0 mm, 0.0 deg" in shown and "100.0 mm, 0.0 mm, 28.6 deg" in shown
    assert "<b> 2" not in text, "a name is text, not HTML"
    # the table before, half-way through and after the moves, and one drawing per move
    assert len(re.findall("<svg", text)) == 3 + 3
    assert "http" not in text


def test_a_failed_arrangement_gives_its_reason(run: ArrangementRun) -> None:
    failed = replace(
        run,
        error_code=314,
        error_msg="only 4 images",
        objects=(run.objects[0], replace(run.objects[1], outcome="not reached", end=None)),
        taps=run.taps[:3],
    )
    assert headline(failed) == "Arrangement failed: 1 of 2 objects at the goal after 3 taps"
    text = page(failed)
    assert "TOO_FEW_FRAMES" in text and "only 4 images" in text and "What to do" in text


def test_an_arrangement_without_taps_or_observations_has_a_page(run: ArrangementRun) -> None:
    blind = replace(run.objects[0], start=None, end=None, end_true=None)
    assert "not seen" in page(replace(run, objects=(blind,), taps=(), contacts=None))


def test_the_report_verb_writes_the_page_again(run, tmp_path, capsys):
    folder = write(run, tmp_path / "runs" / "run")
    assert main(["report", str(folder), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["arrangements"] == [str(folder / "report.html")] and result["runs"] == []
    assert (folder / "report.html").read_text() == page(run)
    assert main(["report", str(folder), "--output", str(tmp_path / "other")]) == 0
    assert (tmp_path / "other" / "report.html").exists()


@pytest.mark.parametrize("content", ["{", "{}", '{"run": {"taps": []}}'])
def test_a_damaged_file_is_refused_with_a_message(tmp_path: Path, content: str) -> None:
    (tmp_path / SUMMARY).write_text(content)
    with pytest.raises(RunError, match=r"arrangement\.json is damaged"):
        read_arrangement(tmp_path)
    assert main(["report", str(tmp_path)]) == 2


def test_every_object_is_shown_with_its_own_tolerance(run: ArrangementRun) -> None:
    text = page(run).replace("\u00a0", " ")
    assert "1 mm, 1 deg" in text and "2 mm, 3 deg" in text
    assert "tolerances: see the objects" in text
    alike = replace(run, objects=tuple(replace(one, tolerance=FINE) for one in run.objects))
    text = page(alike).replace("\u00a0", " ")
    assert "tolerance 1 mm, 1 deg" in text and "2 mm, 3 deg" not in text
