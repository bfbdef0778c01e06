"""Nodes under test store goals and stops in a folder of the test, not in that of the user's
cells."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tapping_cell.cli.graph import own_domain
from tapping_cell.configuration.assembly import make_strike_space
from tapping_cell.configuration.cell import Cell
from tapping_cell.logic import goal_handling
from tapping_cell.logic.table_maps import TableMaps
from tapping_cell.nodes import cell_identity
from tapping_cell.nodes.page.goal_check import GoalCheck
from tapping_cell.planning import FreeSpace

_MAPS: dict[str, TableMaps] = {}
_FREE: dict[str, FreeSpace] = {}


@pytest.fixture(autouse=True)
def _maps_of_earlier_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let planners and pages of one cell share its map of possible taps, which depends only on the
    cell's files and takes 0.4 s of processor time to compute."""

    def maps(cell: Cell) -> TableMaps:
        key = repr((cell.file, cell.object))
        if key not in _MAPS:
            _MAPS[key] = TableMaps(cell)
        return _MAPS[key]

    def free(check: GoalCheck) -> FreeSpace:
        cell = check._cell
        key = repr((cell.file, cell.object))
        if key not in _FREE:
            _FREE[key] = FreeSpace(make_strike_space(cell))
        return _FREE[key]

    monkeypatch.setattr(goal_handling, "TableMaps", maps)
    monkeypatch.setattr(GoalCheck, "free", property(free))


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cell_identity, "STATE", tmp_path / ".ros" / "tapping_cell")


@pytest.fixture
def own_graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Use a new ROS domain: nodes of earlier tests in this process may still be listed, and the ROS
    graph does not distinguish nodes with the same name."""
    monkeypatch.delenv("ROS_DOMAIN_ID")
    domain = own_domain()
    assert domain.held is not None
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain.number))
    with domain.held:
        yield
