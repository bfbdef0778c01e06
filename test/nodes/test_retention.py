"""Old runs are deleted only if this was asked for: starred and new ones never."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from tapping_cell.nodes.recorder import retention
from tapping_cell.nodes.recorder.retention import (
    DAY_S,
    NEWEST,
    REFUSALS,
    STARRED,
    Retention,
    list_refusal,
)


def run(parent: Path, number: int, outcome: str = "reached", starred: bool = False) -> str:
    """Make a run that is ``number`` days old."""
    folder = parent / f"run_{number:03d}"
    (folder / "bag").mkdir(parents=True)
    summary = folder / "summary.json"
    summary.write_text(json.dumps({"name": folder.name, "outcome": outcome}, indent=2))
    if starred:
        (folder / STARRED).touch()
    made = time.time() - number * DAY_S
    os.utime(summary, (made, made))
    return folder.name


def names(parent: Path) -> set[str]:
    return {entry.name for entry in parent.iterdir()}


def test_nothing_is_deleted_by_default(tmp_path: Path) -> None:
    for number in range(30):
        run(tmp_path, number)
    assert Retention(5).apply(tmp_path, lambda _: 0.0) == []
    assert len(names(tmp_path)) == 30
    assert Retention(5, 0.2).apply(tmp_path / "missing") == []


def test_a_full_disk_costs_ordinary_runs_first_then_failed_ones(tmp_path: Path) -> None:
    failed = {run(tmp_path, number, "failed") for number in range(20, 25)}
    starred = {run(tmp_path, number, starred=True) for number in range(25, 28)}
    ordinary = [run(tmp_path, number) for number in range(19, -1, -1)]
    (tmp_path / "up").mkdir()  # logs, no run
    rule = Retention(1000, free_share=0.2)
    assert rule.apply(tmp_path, lambda _: 0.21) == []
    runs = len(names(tmp_path))
    # Each deleted run frees one per cent: the two oldest go.
    deleted = rule.apply(tmp_path, lambda _: 0.185 + 0.01 * (runs - len(names(tmp_path))))
    assert deleted == ordinary[:2]
    rule.apply(tmp_path, lambda _: 0.0)
    assert names(tmp_path) == {*starred, *ordinary[-NEWEST:], "up"}
    assert not failed & names(tmp_path)


def test_old_and_surplus_runs_are_deleted(tmp_path: Path) -> None:
    for number in range(40):
        run(tmp_path, number)
    assert len(Retention(1000, days=30.5).apply(tmp_path)) == 9
    assert len(Retention(25, days=1000).apply(tmp_path)) == 7
    assert len(names(tmp_path)) == 24, "a new run still fits"


def test_an_interrupted_deletion_is_completed(tmp_path: Path, monkeypatch) -> None:
    for number in range(12):
        run(tmp_path, number)
    with monkeypatch.context() as patch:

        def fail(_: Path) -> None:
            raise OSError(5, "Input/output error")

        patch.setattr(retention.shutil, "rmtree", fail)
        with pytest.raises(OSError):
            Retention(11, 0.1).apply(tmp_path, lambda _: 1.0)
    assert len([name for name in names(tmp_path) if name.startswith("run_")]) == 11
    Retention(100, 0.1).apply(tmp_path, lambda _: 1.0)
    assert len(names(tmp_path)) == 11


def test_a_linked_folder_is_not_followed(tmp_path: Path) -> None:
    for number in range(12):
        run(tmp_path / "runs", number)
    target = tmp_path / run(tmp_path, 99)
    (tmp_path / "runs" / "link").symlink_to(target)
    Retention(1, 0.5).apply(tmp_path / "runs", lambda _: 0.0)
    assert (target / "summary.json").exists() and len(names(tmp_path / "runs")) == NEWEST + 1


def test_the_list_of_refusals_does_not_grow_for_ever(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(retention, "LONGEST_LIST", 1000)
    for number in range(200):
        list_refusal(tmp_path, {"number": number, "error_msg": "off the table"})
    lines = (tmp_path / REFUSALS).read_text().splitlines()
    assert json.loads(lines[-1])["number"] == 199
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 2500


def test_a_run_that_lost_its_power_is_deleted_like_a_failed_one(tmp_path: Path) -> None:
    for number in range(12):
        run(tmp_path, number)
    (tmp_path / "run_011" / "summary.json").unlink()
    os.utime(tmp_path / "run_011", (0, 0))
    assert Retention(100, free_share=0.5).apply(tmp_path, lambda _: 0.0) == ["run_010", "run_011"]
