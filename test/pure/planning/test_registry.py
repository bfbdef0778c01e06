import math
import sys

import numpy as np
import pytest

from tapping_cell.planning import (
    Planner,
    PlannerSettings,
    PlanningError,
    Taps,
    UnknownPlannerError,
    make_planner,
    planner_names,
)
from tapping_cell.planning.registry import load_planner


def test_the_four_methods_are_registered_planners():
    assert planner_names()[:4] == ["exact", "conservative", "multi", "optimal"]
    for name in planner_names()[:4]:
        planner = make_planner(name)
        assert isinstance(planner, Planner) and planner.name == name
        assert float(planner.taps_to_go(0.01, math.radians(10.0))) > 1.0


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(UnknownPlannerError, match="'exakt'; choose one of exact, conservative,"):
        make_planner("exakt")


@pytest.fixture
def foreign_package(tmp_path, monkeypatch):
    info = tmp_path / "foreign-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[tapping_cell.planners]\n"
        "straight = foreign_planner:Straight\n"
        "broken = foreign_planner:missing\n"
        "nothing = foreign_planner:nothing\n"
        "exact = foreign_planner:Straight\n"
    )
    (tmp_path / "foreign_planner.py").write_text(
        "from tapping_cell.planning import Taps\n"
        "import numpy as np\n"
        "class Straight:\n"
        "    name = 'straight'\n"
        "    def __init__(self, settings): self.settings = settings\n"
        "    def choose(self, r, theta): return Taps(np.maximum(r, 0.002), np.zeros_like(r))\n"
        "    def taps_to_go(self, r, theta): return np.ones_like(r)\n"
        "def nothing(settings): return 3\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("foreign_planner", None)


def test_other_packages_add_methods_by_an_entry_point(foreign_package):
    assert planner_names() == [
        "exact",
        "conservative",
        "multi",
        "optimal",
        "broken",
        "nothing",
        "straight",
    ]
    assert make_planner("straight").name == "straight"
    assert type(make_planner("exact")).__module__.startswith("tapping_cell.")
    with pytest.raises(PlanningError, match=r"'broken' \(foreign_planner:missing\)"):
        make_planner("broken")
    with pytest.raises(PlanningError, match="returned a int"):
        make_planner("nothing")


class Own:
    """A method that taps straight to the goal; tests replace its answers."""

    name = "own"
    tap = staticmethod(lambda r, theta: Taps(np.maximum(r, 0.002), np.zeros(np.shape(r))))
    after = staticmethod(lambda r, theta: np.ones(np.shape(r)))

    def __init__(self, settings):
        self.settings = settings

    def choose(self, r, theta):
        return self.tap(r, theta)

    def taps_to_go(self, r, theta):
        return self.after(r, theta)


@pytest.mark.parametrize(
    ("answers", "sentence"),
    [
        ({"tap": lambda r, t: (r, t)}, "must return Taps.*not tuple"),
        ({"tap": lambda r, t: Taps(0.01, 0.0)}, "of the shape of its arguments"),
        ({"tap": lambda r, t: Taps(r[0], t[0])}, "fails for arrays or numbers"),
        ({"tap": lambda r, t: Taps(r + 0.001, 0 * t)}, "tap of 1 mm and -?0 degrees.*1.7 mm"),
        ({"tap": lambda r, t: Taps(r + 0.002, t)}, r"for the residual 0 mm.*degrees/mm"),
        ({"tap": lambda r, t: Taps(r * np.nan, 0 * t)}, "tap of nan mm"),
        ({"after": lambda r, t: 1.0}, "one number for each residual"),
    ],
)
def test_impossible_taps_of_a_class_are_refused_with_an_example(monkeypatch, answers, sentence):
    assert load_planner(f"{__name__}:Own", PlannerSettings()).name == "own"
    for name, answer in answers.items():
        monkeypatch.setattr(Own, name, staticmethod(answer))
    with pytest.raises(PlanningError, match=sentence):
        load_planner(f"{__name__}:Own", PlannerSettings())
