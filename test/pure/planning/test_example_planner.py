"""The tutorial's example of a user-defined planning method, installed and used as described
there."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.planning import Planner, PlannerSettings

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "patient_planner"
SLACK = 1 + 1e-9


@pytest.fixture(scope="module")
def planner() -> Planner:
    spec = importlib.util.spec_from_file_location("patient", EXAMPLE / "patient_planner.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.PatientPlanner(PlannerSettings())


@given(distance=st.floats(0.0, 0.3), rotation=st.floats(-np.pi, np.pi))
def test_every_tap_is_possible(planner, distance, rotation):
    settings = planner.settings
    tap = planner.choose(distance, rotation)
    size = abs(float(tap.distance))
    assert size >= settings.smallest_distance / SLACK
    assert abs(float(tap.rotation)) <= settings.cone_slope * size * SLACK


def test_it_is_installed_by_its_entry_point_and_reaches_its_goals(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    for file in EXAMPLE.glob("*.[pt]*"):
        (source / file.name).write_bytes(file.read_bytes())
    installed = tmp_path / "installed"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", str(installed), str(source)], check=True)
    ours = str(Path(__file__).resolve().parents[3])
    path = os.pathsep.join([str(installed), ours, os.environ.get("PYTHONPATH", "")])
    words = ["evaluate", "--planner", "patient", "--trials", "500", "--goal", "10", "0", "10"]
    evaluated = subprocess.run(
        [sys.executable, "-m", "tapping_cell", *words, "--json"],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        check=True,
        text=True,
    )
    result = json.loads(evaluated.stdout)
    assert result["truly_inside_rate"] == 1.0
    assert result["taps"]["mean"] < 4.0
