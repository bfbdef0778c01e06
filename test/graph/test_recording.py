"""A graph started by `up` with one parameter file: each goal sent to it leaves a run folder."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tapping_cell.report.bag import read_bag
from tapping_cell.report.run import Run
from tapping_cell.report.run_folder import RunError, read_run

PARAMETERS = """
/left/sim_world:
  ros__parameters:
    {{arm_port: {folder}/arm, tapper_port: {folder}/tapper, seed: 6, frame_rate: 15.0}}
/left/scara_arm:
  ros__parameters: {{port: {folder}/arm}}
/left/tapper_trigger:
  ros__parameters: {{port: {folder}/tapper}}
/left/run_recorder:
  ros__parameters: {{pictures: false, least_free: 0.0}}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    file = tmp_path / "parameters.yaml"
    file.write_text(PARAMETERS.format(folder=tmp_path))
    command = [sys.executable, "-m", "tapping_cell", "up", "--namespace", "left"]
    command += ["--params", str(file), "--runs", str(tmp_path / "runs")]
    process = subprocess.Popen([*command, "--logs", str(tmp_path / "logs")], cwd=tmp_path)
    try:
        yield tmp_path
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(120) == 0


def goal(*words: str) -> tuple[int, str]:
    command = [sys.executable, "-m", "tapping_cell", "goal", "--namespace", "left", "--wait", "90"]
    ended = subprocess.run(
        [*command, *words], capture_output=True, text=True, timeout=240, check=False
    )
    return ended.returncode, " ".join((ended.stdout + ended.stderr).split())


def recorded(folder: Path, number: int) -> list[Run]:
    """Wait until ``number`` runs have a summary, and return them in chronological order."""
    deadline = time.monotonic() + 60
    while True:
        found = []
        for entry in sorted((folder / "runs").glob("*")):
            try:
                found.append(read_run(entry))
            except RunError:
                continue
        if len(found) >= number:
            return found
        assert time.monotonic() < deadline, f"{len(found)} of {number} runs were recorded"
        time.sleep(0.2)


def a_second_cell_is_refused(folder: Path) -> None:
    command = [sys.executable, "-m", "tapping_cell", "up", "--namespace", "left"]
    second = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=150)
    assert second.returncode == 1
    words = " ".join(second.stderr.split())
    assert "another cell runs on this machine in ROS domain" in words
    assert "namespace '/left'" in words


def test_goals_of_a_running_graph_are_recorded(folder: Path) -> None:
    """While this graph runs, no second cell can be started in the same domain and namespace."""
    status, words = goal("-25", "0", "0")
    assert status == 0 and "goal reached" in words, words
    a_second_cell_is_refused(folder)
    status, words = goal("900", "0", "0")
    assert status == 1 and "(103)" in words and "what to do: Send a goal" in words
    first, second = recorded(folder, 2)
    assert (first.outcome, second.outcome) == ("reached", "refused")
    assert "_left_to_-25_0_0" in first.name and len(first.taps) >= 1
    assert second.error_code == 103 and second.taps == ()
    bag = read_bag(folder / "runs" / first.name / "bag")
    assert bag.whole and all(topic.name.startswith(("/left/", "/diag")) for topic in bag.topics)
