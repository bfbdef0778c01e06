"""The notebooks and the example of examples/ run, and the notebooks draw their figures."""

import runpy
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.py"))


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_runs_and_draws(file, monkeypatch, capsys):
    shown = []
    monkeypatch.setattr(plt, "show", lambda: shown.append(len(plt.gcf().axes)))
    try:
        runpy.run_path(str(file), run_name="__main__")
    finally:
        plt.close("all")
    assert len(shown) >= 2 and min(shown) >= 1
    assert capsys.readouterr().out


def test_the_three_notebooks_are_there():
    assert len(NOTEBOOKS) == 3
    for file in NOTEBOOKS:
        assert file.read_text(encoding="utf-8").startswith("# %% [markdown]\n# # ")


@pytest.mark.campaign
def test_the_learning_example_runs(monkeypatch, capsys):
    file = EXAMPLES / "learn_to_tap.py"
    monkeypatch.setattr("sys.argv", [str(file), "--generations", "1", "--trials", "16"])
    runpy.run_path(str(file), run_name="__main__")
    printed = capsys.readouterr().out
    assert "tuned:" in printed and "optimal:" in printed and "100.0 % truly inside" in printed
