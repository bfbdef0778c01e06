"""The wheel of `pip install .`: the library and its verbs run without ROS and without devices."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import single_tap_records
from without_ros import run

ROOT = Path(__file__).resolve().parents[2]
LARGEST_WHEEL = 5_000_000  # bytes


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the wheel as pip does, and unpack it into a folder without the source tree."""
    source, site = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("tapping_cell", "config", "launch", "msg_defs", "resource"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    environment = {**os.environ, "AMENT_PREFIX_PATH": ""}
    subprocess.run(
        [sys.executable, "-c", build, str(site)],
        cwd=source,
        env=environment,
        capture_output=True,
        check=True,
    )
    (wheel,) = site.glob("*.whl")
    assert wheel.stat().st_size < LARGEST_WHEEL
    with zipfile.ZipFile(wheel) as content:
        content.extractall(site)
    return site


CALCULATE = """
import tapping_cell
from tapping_cell.configuration.assembly import make_session
from tapping_cell.configuration.cell import load_cell
from tapping_cell.planning import Strike
from tapping_cell.report.error_codes import hint
from tapping_cell.simulation.tap_trials import SimulatedTable

cell = load_cell()
table = SimulatedTable(cell)
session = make_session(cell, goal=(0.0, 0.03, 0.1), planner="exact")
for decision in session.decisions(table.observe):
    if isinstance(decision, Strike):
        table.tap(decision.plan.strike_pose, decision.plan.striker_speed)
print(tapping_cell.__file__, type(decision).__name__, bool(hint(101)))
"""


def test_the_library_runs_a_simulated_goal(site, tmp_path):
    done = run(site, tmp_path, "-c", CALCULATE)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(site / "tapping_cell" / "__init__.py"), "Done", "True"]


def test_evaluate_and_fit_run(site, tmp_path):
    """``paper`` runs in the same way in test_paper.py."""
    cell = ("-m", "tapping_cell")
    words = ("--planner", "exact", "--processes", "2", "--model", "world", "--trials", "4")
    done = run(site, tmp_path, *cell, "evaluate", *words)
    assert done.returncode == 0 and "truly inside" in done.stdout, done.stderr
    records = single_tap_records.write(tmp_path / "records", single_tap_records.taps())
    done = run(site, tmp_path, *cell, "object", "fit", str(records))
    assert done.returncode == 0 and "torque factor" in done.stdout, done.stderr


def test_a_verb_that_needs_ros_says_so(site, tmp_path):
    done = run(site, tmp_path, "-m", "tapping_cell", "demo")
    assert done.returncode == 2
    assert "cannot import" in done.stderr and "Traceback" not in done.stderr
