"""The verb `object learn` makes an object file from run folders."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from made_bags import MadeRun

from tapping_cell.cli import main
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import load_object
from tapping_cell.report.run_folder import write_folder
from tapping_cell.se2 import Pose

DISK = shared_folder() / "objects" / "aluminium_disk.yaml"


def made_runs(folder: Path) -> list[str]:
    """Write two runs of five random taps each, whose results are exactly as commanded."""
    folders = []
    random = np.random.default_rng(3)
    for index in range(2):
        stops = [Pose(0.0, 0.0, 0.0)]
        for _ in range(5):
            length, heading = random.uniform(0.01, 0.03), random.uniform(-3, 3)
            last = stops[-1]
            stops.append(
                Pose(
                    last.x + length * math.cos(heading),
                    last.y + length * math.sin(heading),
                    last.theta + float(random.uniform(-3, 3)) * length,
                )
            )
        run = folder / f"run_{index}"
        run.mkdir()
        MadeRun(stops).write(run)
        write_folder(run, pictures=False)
        folders.append(str(run))
    return folders


def test_an_object_file_is_learnt_from_runs(tmp_path, capsys):
    runs, made = made_runs(tmp_path), tmp_path / "learnt.yaml"
    own = tmp_path / "guess.yaml"
    name = json.loads((Path(runs[0]) / "summary.json").read_text())["object"]
    text = DISK.read_text().replace("name: aluminium disk", f"name: {json.dumps(name or 'disk')}")
    own.write_text(text)
    words = ["object", "learn", *runs, "--object", str(own), "--output", str(made), "--json"]
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)
    comparison = tmp_path / "comparison.html"
    comparison.write_text("")
    again = ["object", "learn", *runs, str(comparison), "--object", str(own), "--json"]
    assert main(again) == 0
    output = capsys.readouterr()
    assert json.loads(output.out) == result
    assert f"{comparison} is not a run: skipped" in output.err
    assert result["taps"] == 10 and result["left_out"] == 0
    # The results are as commanded, so the learnt values equal those of the object file in use.
    assert load_object(made).friction == pytest.approx(load_cell().object.friction, rel=0.02)
    assert load_object(made).calibration is not None


def test_runs_of_another_object_and_no_runs_are_refused(tmp_path, capsys):
    assert main(["object", "learn", str(tmp_path), "--object", str(DISK)]) == 2
    assert "cannot be read" in capsys.readouterr().err
    runs = made_runs(tmp_path)
    other = shared_folder() / "objects" / "plexiglas_disk.yaml"
    if json.loads((Path(runs[0]) / "summary.json").read_text())["object"]:
        assert main(["object", "learn", *runs, "--object", str(other)]) == 2
        assert "give the file of the object that was tapped" in capsys.readouterr().err
