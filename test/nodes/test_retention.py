"""Old runs are deleted only if this was asked for: starred and new ones never."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import pytest

from tapping_cell.nodes.recorder import retention
from tapping_cell.nodes.recorder.recording import CannotRecord, new_folder
from tapping_cell.nodes.recorder.retention import (
    DAY_S,
    MOST_DELETED,
    MOST_USELESS,
    NEWEST,
    REFUSALS,
    Deletion,
    Retention,
    count_runs,
    list_refusal,
)
from tapping_cell.nodes.recorder.run_names import STARRED
from tapping_cell.report.bag import BagWriter


def run(parent: Path, number: int, outcome: str = "reached", starred: bool = False) -> str:
    """Make a run that is ``number`` days old."""
    folder = parent / f"run_{number:03d}"
    (folder / "bag").mkdir(parents=True)
    summary = folder / "summary.json"
    summary.write_text(
        json.dumps({"name": folder.name, "outcome": outcome, "began": 1.0}, indent=2)
    )
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
    assert Retention(5).apply(tmp_path, lambda _: 0.0) == Deletion()
    assert len(names(tmp_path)) == 30
    assert Retention(5, 0.2).apply(tmp_path / "missing") == Deletion()


def test_a_full_disk_costs_ordinary_runs_first_then_failed_ones(tmp_path: Path) -> None:
    failed = {run(tmp_path, number, "failed") for number in range(20, 25)}
    starred = {run(tmp_path, number, starred=True) for number in range(25, 28)}
    ordinary = [run(tmp_path, number) for number in range(19, -1, -1)]
    (tmp_path / "up").mkdir()  # logs, no run
    rule = Retention(1000, free_share=0.2)
    assert rule.apply(tmp_path, lambda _: 0.21) == Deletion()
    runs = len(names(tmp_path))
    # Each deleted run frees one per cent: the two oldest go.
    done = rule.apply(tmp_path, lambda _: 0.185 + 0.01 * (runs - len(names(tmp_path))))
    assert done.deleted == ordinary[:2]
    rule.apply(tmp_path, lambda _: -len(names(tmp_path)))
    assert names(tmp_path) == {*starred, *ordinary[-NEWEST:], "up"}
    assert not failed & names(tmp_path)


def test_old_and_surplus_runs_are_deleted(tmp_path: Path) -> None:
    for number in range(40):
        run(tmp_path, number)
    assert len(Retention(1000, days=30.5).apply(tmp_path).deleted) == 9
    assert len(Retention(25, days=1000).apply(tmp_path).deleted) == 7
    assert len(names(tmp_path)) == 24, "a new run still fits"


def test_an_interrupted_deletion_is_completed(tmp_path: Path, monkeypatch) -> None:
    for number in range(12):
        run(tmp_path, number)
    with monkeypatch.context() as patch:

        def fail(_: Path) -> None:
            raise OSError(5, "Input/output error")

        patch.setattr(retention.shutil, "rmtree", fail)
        done = Retention(11, 0.1).apply(tmp_path, lambda _: 1.0)
        assert done.deleted == [] and "Input/output error" in done.failed[0]
    assert len([name for name in names(tmp_path) if name.startswith("run_")]) == 10
    Retention(100, 0.1).apply(tmp_path, lambda _: 1.0)
    assert len(names(tmp_path)) == 10


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
    folder = tmp_path / "run_011"
    shutil.rmtree(folder / "bag")
    (folder / "summary.json").unlink()
    with BagWriter(folder / "bag") as bag:
        bag.add_topic("/left/run_notes", "std_msgs/msg/String")
    os.utime(folder, (0, 0))
    done = Retention(100, free_share=0.5).apply(tmp_path, lambda _: 0.0)
    assert done.deleted == ["run_010", "run_011"]


def test_a_folder_of_something_else_is_never_deleted(tmp_path: Path) -> None:
    for number in range(NEWEST):
        run(tmp_path, number)
    (tmp_path / "experiment" / "bag").mkdir(parents=True)
    (tmp_path / "experiment" / "bag" / "bag.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "summary.json").write_text('{"outcome": "good"}')
    with BagWriter(tmp_path / "other" / "bag") as bag:
        bag.add_topic("/plan_state", "std_msgs/msg/String")
    for entry in ("experiment", "thesis", "other"):
        os.utime(tmp_path / entry, (0, 0))
    assert Retention(1, 0.9, 0.5).apply(tmp_path, lambda _: 0.0) == Deletion()
    assert count_runs(tmp_path) == NEWEST
    # most_runs counts the same runs.
    new_folder(tmp_path, "new", NEWEST + 1, 0.0)
    with pytest.raises(CannotRecord, match=f"holds {NEWEST} runs"):
        new_folder(tmp_path, "newer", NEWEST, 0.0)


def test_deletions_that_free_nothing_are_stopped(tmp_path: Path) -> None:
    for number in range(60):
        run(tmp_path, number)
    done = Retention(1000, 0.5).apply(tmp_path, lambda _: 0.1)
    assert done.useless and len(done.deleted) == MOST_USELESS
    done = Retention(1000, 0.5).apply(tmp_path, lambda _: -len(names(tmp_path)))
    assert not done.useless and len(done.deleted) == MOST_DELETED


def test_a_run_that_cannot_be_deleted_stops_no_other(tmp_path: Path, monkeypatch) -> None:
    for number in range(13):
        run(tmp_path, number)
    remove = shutil.rmtree

    def fail(folder: Path) -> None:
        if folder.name.endswith("run_012"):
            raise PermissionError(1, "Operation not permitted")
        remove(folder)

    monkeypatch.setattr(retention.shutil, "rmtree", fail)
    for expected in (["run_011", "run_010"], []):
        done = Retention(1, 0.1).apply(tmp_path, lambda _: 1.0)
        assert done.deleted == expected
        assert done.failed == [".deleted-run_012 (Operation not permitted)"]
