"""Two objects swap their places in the complete simulated cell, which is started with the verb
`demo`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tapping_cell.report.objects_page import moves_of
from tapping_cell.report.run_folder import read_run

TIMEOUT_S = 900
"""Time limit of the whole demo, s. It must be longer than the time limits of the demo's goals."""


@pytest.mark.timeout(TIMEOUT_S + 60)
def test_two_objects_swap_places_without_contact(tmp_path: Path) -> None:
    folder = tmp_path / "exchange"
    command = [sys.executable, "-m", "tapping_cell", "demo", "--out", str(folder)]
    command += ["--objects", "2", "--goals", "swap", "--seed", "20"]
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=tmp_path,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    told = json.loads((folder / "summary.json").read_text())
    assert told["reached"] and told["contacts"] == []
    run = read_run(folder)
    assert len(run.objects) == 2 and len(run.taps) == told["taps"]
    for one, other in (run.objects, run.objects[::-1]):
        assert one.goal is not None and other.start is not None and one.end_true is not None
        assert one.goal.distance_to(other.start) < 0.0005
        assert one.end_true.distance_to(one.goal) <= one.tolerance[0]
    # Each object stands at the goal of the other, so one of them must move out of the way first.
    first, second = moves_of(run)[:2]
    assert f" makes way: it is in the way of '{second.name}'" in first.purpose
    assert f"'{second.name}' goes to its goal" in second.purpose
    assert (folder / "report.html").stat().st_size > 10_000
