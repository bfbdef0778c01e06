"""The report of a run with several objects: moves, their order, and their reasons."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tapping_cell.cli import main
from tapping_cell.report.objects_page import headline, moves_of
from tapping_cell.report.objects_page import page as page_of
from tapping_cell.report.run import Run, RunObject, TapRow
from tapping_cell.report.run_folder import read_run, summary, write_illustrated_run
from tapping_cell.report.run_reader import IllustratedRun
from tapping_cell.se2 import Pose

SQUARE = ((-0.02, -0.02), (0.02, -0.02), (0.02, 0.02), (-0.02, 0.02))
FINE, COARSE = (0.001, math.radians(1.0)), (0.002, math.radians(3.0))
ONE, OTHER, BUFFER = Pose(-0.1, 0.0, 0.0), Pose(0.1, 0.0, 0.5), Pose(0.0, 0.12, 0.0)
UNSEEN = Pose(math.nan, math.nan, math.nan)
AWAY = "'<b> 2' makes way: it is in the way of 'disk'"
HOME = "'<b> 2' goes to its goal: its goal and a path to it are free"


def tap(number: int, name: str, before: Pose, after: Pose | None, purpose: str) -> TapRow:
    return TapRow(
        number=number,
        tap_id=number,
        method="optimal",
        outcome="fired",
        before=before,
        commanded=Pose(0.0, 0.0, 0.0),
        predicted=after or before,
        measured=after or UNSEEN,
        true_pose=None,
        strike=before,
        striker_speed=0.4,
        contact_angle=0.1,
        object_name=name,
        purpose=purpose,
    )


def page(run: Run) -> str:
    return page_of(IllustratedRun(run, ()))


@pytest.fixture
def run() -> Run:
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
    return Run(
        name="run",
        objects=(
            RunObject("disk", SQUARE, ONE, OTHER, OTHER, OTHER, FINE, 1, "reached"),
            RunObject("<b> 2", SQUARE, OTHER, ONE, ONE, None, COARSE, 4, "reached"),
        ),
        taps=taps,
        outcome="reached",
        wall_time=42.0,
        seed=None,
        versions={},
        error_code=0,
        error_msg="",
        table_size=(0.6, 0.44),
        began=1.7e9,
        contacts=(),
    )


def test_the_folder_preserves_every_value(run: Run, tmp_path: Path) -> None:
    write_illustrated_run(tmp_path, IllustratedRun(run, ()), pictures=False)
    again = read_run(tmp_path)
    assert summary(again) == approx(summary(run))
    for one, other in zip(run.taps, again.taps, strict=True):
        assert (one.object_name, one.purpose, one.seen) == (
            other.object_name,
            other.purpose,
            other.seen,
        )
        assert one.before.distance_to(other.before) < 1e-7


def approx(value: Any) -> Any:
    """Return JSON values whose numbers are compared approximately."""
    if isinstance(value, dict):
        return {key: approx(each) for key, each in value.items()}
    if isinstance(value, list):
        return [approx(each) for each in value]
    return pytest.approx(value, abs=1e-9) if isinstance(value, float) else value


def test_consecutive_taps_of_an_object_are_one_move(run: Run) -> None:
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


def test_the_page_lists_each_object_and_each_reason(run: Run) -> None:
    text = page(run)
    assert headline(run) == "Arrangement reached: 2 objects, 5 taps"
    assert "1. &#39;&lt;b&gt; 2&#39; makes way: it is in the way of &#39;disk&#39;." in text
    assert "Taps 1 to 2: moved by 156 mm; remaining error 156.20 mm, 0.00 deg." in text
    shown = text.replace("\u00a0", " ")
    assert "-100.0 mm, 0.0 mm, 0.0 deg" in shown and "100.0 mm, 0.0 mm, 28.6 deg" in shown
    assert "<b> 2" not in text, "a name is text, not HTML"
    # the table before, half-way through and after the moves, and one drawing per move
    assert text.count('role="img"') == 3 + 3 + 1
    assert "http" not in text


def test_a_failed_arrangement_gives_its_reason(run: Run) -> None:
    failed = replace(
        run,
        outcome="failed",
        error_code=314,
        error_msg="only 4 images",
        objects=(run.objects[0], replace(run.objects[1], outcome="not reached", end=None)),
        taps=run.taps[:3],
    )
    assert headline(failed) == "Arrangement failed: 1 of 2 objects at the goal after 3 taps"
    text = page(failed)
    assert "TOO_FEW_FRAMES" in text and "only 4 images" in text and "What to do" in text


def test_an_arrangement_without_taps_or_observations_has_a_page(run: Run) -> None:
    blind = replace(run.objects[0], start=None, end=None, end_true=None)
    assert "not seen" in page(replace(run, objects=(blind,), taps=(), contacts=None))


def test_the_report_verb_writes_the_page_again(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "runs" / "run"
    folder.mkdir(parents=True)
    write_illustrated_run(folder, IllustratedRun(run, ()))
    first = (folder / "report.html").read_text()
    assert main(["report", str(folder), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["runs"]
    assert (row["object_name"], row["outcome"], row["taps"]) == ("2 objects", "reached", 5)
    assert (folder / "report.html").read_text() == first
    assert (folder / "cell.png").stat().st_size > 10_000
    assert main(["report", str(folder), "--output", str(tmp_path / "other")]) == 0
    assert (tmp_path / "other" / "report.html").exists()


def test_every_object_is_shown_with_its_own_tolerance(run: Run) -> None:
    text = page(run).replace("\u00a0", " ")
    assert "1 mm, 1 deg" in text and "2 mm, 3 deg" in text
    assert "tolerances: see the objects" in text
    alike = replace(run, objects=tuple(replace(one, tolerance=FINE) for one in run.objects))
    text = page(alike).replace("\u00a0", " ")
    assert "tolerance 1 mm, 1 deg" in text and "2 mm, 3 deg" not in text
