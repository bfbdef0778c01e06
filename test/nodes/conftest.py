"""Nodes under test store goals and stops in a folder of the test, not in that of the user's
cells."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tapping_cell.cli.graph import own_domain
from tapping_cell.nodes import cell_identity


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
