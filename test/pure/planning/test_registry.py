import math
import sys

import pytest

from tapping_cell.planning import (
    Planner,
    PlanningError,
    UnknownPlannerError,
    make_planner,
    planner_names,
)


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
        "    def choose(self, r, theta): return Taps(np.asarray(r), np.zeros_like(r))\n"
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
