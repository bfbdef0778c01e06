"""The verb single-tap as a user runs it: it is interrupted and resumed, and its records can be
read."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tapping_cell.calibration.experiment import read_experiment
from tapping_cell.calibration.track import Slide, slide_of
from tapping_cell.cli import main
from tapping_cell.report.bag import read_bag

TINY = ("--speeds", "600", "--incidences", "25", "--trials", "2", "--seed", "3")
SLOW = ("--slow-motion", "8", "--json")  # slow enough that no image is lost even on a busy machine


def start(*options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tapping_cell", "single-tap", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def end(process: subprocess.Popen[str], patience: float = 150.0) -> tuple[int, str, str]:
    output, errors = process.communicate(timeout=patience)
    return process.returncode, output, errors


def test_an_experiment_is_stopped_resumed_and_read_back(tmp_path: Path) -> None:
    process = start(*TINY, *SLOW, "--runs-folder", str(tmp_path))
    deadline = time.monotonic() + 120
    while not (found := list(tmp_path.glob("*/run_01.csv"))):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    status, output, errors = end(process)
    assert status == 130, errors
    folder = found[0].parent
    result = json.loads(output)
    assert Path(result["folder"]) == folder and result["error_msg"] == "interrupted"
    kept = read_experiment(folder)
    assert kept.left_out == () and 1 <= len(kept.trials) <= 2

    status, output, errors = end(start("--resume", str(folder), *SLOW))
    assert status == 0, (output, errors)
    assert json.loads(output)["complete"] is True

    experiment = read_experiment(folder)
    assert [trial.trial for trial in experiment.trials[: len(kept.trials)]] == [
        trial.trial for trial in kept.trials
    ]
    assert experiment.header.source == "simulated" and experiment.header.object is not None
    used = [trial for trial in experiment.trials if trial.outcome == "ok"]
    assert len(used) == 2
    for trial in used:
        assert trial.striker_speed == 0.6
        # The incidence is computed from the joints that the arm reports. Differences between these
        # and the arm's true pose therefore do not affect it.
        assert trial.incidence == pytest.approx(math.radians(25.0), abs=0.01)
        assert 0.015 < trial.displacement < 0.04 and trial.rotation < 0
        assert trial.track is not None
        found_slide = slide_of(trial, 1e-4, 2e-3, 30.0, 0.006)
        assert isinstance(found_slide, Slide), found_slide
        assert found_slide.moving >= 4
        assert found_slide.displacement == pytest.approx(trial.displacement, abs=2e-4)
        # Expected speed: at this incidence and with restitution 0.86, the object starts with 0.49
        # times the striker's speed of 0.6 m/s, which is 0.3 m/s. Friction with the table slows it.
        moving = (found_slide.along > 0.05 * trial.displacement) & (
            found_slide.along < 0.7 * trial.displacement
        )
        speed = np.diff(found_slide.along[moving]) / np.diff(found_slide.time[moving])
        assert 0.5 * 0.3 < speed.max() < 0.36
    assert used[0].start_theta != used[1].start_theta

    taps = set()
    for session in sorted(folder.glob("session_*")):
        bag = read_bag(session)
        assert bag.whole
        taps |= {m.tap_id for _, m in bag.of("tap_command") if m.request == 0}
        assert sum(1 for _ in bag.of("object_pose")) > 50 or session.name == "session_02"
    assert len(taps) >= 2


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--speeds", "2300"), "leave the table"),
        (("--speeds", "5"), "the tapper's range is 20 to 2500 mm/s"),
        (("--incidences", "75"), "75.0 deg"),
        (("--trials", "0"), "1 to 1000"),
        (("--slow-motion", "0.5"), "1 to 100"),
        (("--object", "/nowhere/disk.yaml"), "/nowhere/disk.yaml"),
        (("--resume", "/nowhere/at/all"), "contains no"),
    ],
    ids=[
        "too fast",
        "too slow",
        "grazing",
        "no trial",
        "faster than real",
        "no object",
        "nothing to resume",
    ],
)
def test_an_experiment_that_cannot_be_measured_is_refused_before_it_starts(
    tmp_path: Path,
    options: tuple[str, ...],
    word: str,
    own_signals: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = () if "--resume" in options else ("--runs-folder", str(tmp_path / "runs"))
    assert main(["single-tap", *options, *folder]) == 2
    assert word in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "runs").exists()
