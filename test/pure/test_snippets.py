"""Every Python snippet of the documents runs and computes what the page says."""

import json
import math
import re
import sys
import textwrap
import types
from pathlib import Path

import numpy as np
import pytest
from made_bags import STOPS, MadeRun

from tapping_cell.cli import main
from tapping_cell.planning import Done
from tapping_cell.report.tables import METHOD, TRIAL_COLUMNS, write_table

ROOT = Path(__file__).resolve().parents[2]
SNIPPETS = {
    (str(page.relative_to(ROOT)), number): snippet
    for page in sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
    for number, snippet in enumerate(
        re.findall(r"^ *```py(?:thon)?\n(.+?)^ *```", page.read_text(encoding="utf-8"), re.M | re.S)
    )
}


def planning(run, capsys, _):
    names = run()
    assert isinstance(names["decision"], Done) and "at the goal" in capsys.readouterr().out
    error = names["session"].residual(names["table"].pose)
    assert math.hypot(error[0], error[1]) <= 1e-3 and abs(error[2]) <= math.radians(1.0)


def mechanics(run, _, __):
    names = run()
    assert (names["speed"], names["spin"]) == pytest.approx((0.1818, 1.355), rel=1e-3)
    assert names["duration"] == pytest.approx(0.1096, rel=1e-3)
    moved = (names["distance"], 0.0, names["rotation"])
    assert moved == pytest.approx((0.010, 0.0, math.radians(3)), rel=1e-6)
    assert names["moved"] == pytest.approx(np.array(moved), abs=1e-5)


def tables(run, capsys, _):
    pytest.importorskip("pandas", reason="pandas is optional")
    columns = {name: [0, 1] for name in (*METHOD, *TRIAL_COLUMNS)} | {"method": ["exact"] * 2}
    Path("comparison").mkdir()
    write_table(Path("comparison/trials.csv"), columns | {"taps": [2, 4]})
    run()
    assert re.search(r"exact +2\.0 +3\.0", capsys.readouterr().out)


def images(run, _, __):
    folder = Path("runs/2026-01-31_12-00-00")
    folder.mkdir(parents=True)
    MadeRun(STOPS).write(folder)
    found = run()["images"]
    assert len(found) > 2 and all(image.shape == (768, 960, 3) for image in found.values())


def planner(run, capsys, monkeypatch):
    module = types.ModuleType("my_planner")
    vars(module).update(run())
    monkeypatch.setitem(sys.modules, "my_planner", module)
    words = ["--planner", "my_planner:MyPlanner", "--trials", "200", "--processes", "1", "--json"]
    assert main(["evaluate", *words]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["truly_inside_rate"] == 1.0 and found["taps"]["mean"] < 3.0


def environment(run, _, __):
    pytest.importorskip("gymnasium", reason="gymnasium is optional")
    names = run()
    assert names["reward"] == -1.0 and names["observation"].shape == (6,)


CHECKS = {
    ("docs/simulation.md", 0): environment,
    ("docs/planning.md", 1): planner,
    ("docs/mechanics.md", 0): mechanics,
    ("docs/planning.md", 0): planning,
    ("docs/runs.md", 1): tables,
    ("docs/runs.md", 0): images,
}


@pytest.mark.parametrize("place", SNIPPETS, ids=str)
def test_a_snippet_runs(place, tmp_path, monkeypatch, capsys):
    """A new snippet needs its check in ``CHECKS``."""

    def run():
        names = {}
        exec(textwrap.dedent(SNIPPETS[place]), names)
        return names

    monkeypatch.chdir(tmp_path)
    CHECKS[place](run, capsys, monkeypatch)


def test_no_check_is_left_over():
    assert CHECKS.keys() == SNIPPETS.keys()
