"""Each cell of a computer has a unique name, and only one process at a time holds a name."""

from __future__ import annotations

import socket
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.cli import graph
from tapping_cell.cli.graph import Graph, GraphError, domain_number, own_domain
from tapping_cell.nodes.cell_identity import cell_key, claim, state_folder
from tapping_cell.nodes.kept_content import KeptContent

# few letters, so that many examples are equal or differ only in their separators
TOKEN = st.builds(str.__add__, st.sampled_from("aB_"), st.text("aB_9", max_size=3))
CELL = st.tuples(
    st.integers(0, 232), st.lists(TOKEN, max_size=3).map(lambda parts: "/" + "/".join(parts))
)


@given(one=CELL, other=CELL)
def test_cells_share_a_key_only_if_they_are_the_same_cell(
    one: tuple[int, str], other: tuple[int, str]
) -> None:
    assert (cell_key(*one) == cell_key(*other)) == (one == other)
    assert "/" not in cell_key(*one)


def test_a_claim_holds_across_processes_until_its_owner_ends() -> None:
    code = (
        "from tapping_cell.nodes.cell_identity import claim\n"
        "held = claim('test/one'); print(held is not None, flush=True); input()"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=-1, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "True\n"
        assert claim("test/one") is None
        process.kill()
    held = claim("test/one")
    assert held is not None
    held.close()


def test_a_second_graph_of_one_cell_is_refused(tmp_path: object) -> None:
    held = claim("graph/domain7.left")
    assert held is not None
    with held, pytest.raises(GraphError, match=r"ROS domain 7, namespace '/left'.*--namespace"):
        Graph((), {}, tmp_path, {"ROS_DOMAIN_ID": "7"}, "left").__enter__()  # type: ignore[arg-type]
    with Graph((), {}, tmp_path, {"ROS_DOMAIN_ID": "7"}, "left"):  # type: ignore[arg-type]
        assert claim("graph/domain7.left") is None
    again = claim("graph/domain7.left")
    assert again is not None
    again.close()


def test_automatic_domains_differ_and_a_chosen_domain_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID")
    one, other = own_domain(), own_domain()
    assert one.number != other.number
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert own_domain().number == 42


@pytest.mark.parametrize("participant", [0, 3])
def test_a_domain_with_nodes_is_not_chosen(
    participant: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nodes started with ``ros2 run`` hold no reservation, but each node occupies a discovery
    port."""
    monkeypatch.delenv("ROS_DOMAIN_ID")
    free = own_domain()
    assert free.held is not None
    free.held.close()
    monkeypatch.setattr(graph, "OWN_DOMAINS", [free.number])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as node:
        node.bind(("", 7400 + 250 * free.number + 10 + 2 * participant))
        with pytest.raises(GraphError, match="in use"):
            own_domain()
    chosen = own_domain()
    assert chosen.number == free.number and chosen.held is not None
    chosen.held.close()


def test_a_domain_with_a_stored_stop_is_not_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that was interrupted, such as a commissioning, can leave a stop behind."""
    monkeypatch.delenv("ROS_DOMAIN_ID")
    free = own_domain()
    assert free.held is not None
    free.held.close()
    monkeypatch.setattr(graph, "OWN_DOMAINS", [free.number])
    stop = KeptContent(state_folder(cell_key(free.number, "")) / "stop-scara_arm.json")
    stop.keep({"sources": ["enabling device released"], "asserted": False})
    with pytest.raises(GraphError, match="in use"):
        own_domain()
    stop.keep(None)
    chosen = own_domain()
    assert chosen.number == free.number and chosen.held is not None
    chosen.held.close()


@pytest.mark.parametrize("chosen", ["left", "-1", "233", "1.5"])
def test_an_invalid_domain_is_refused_with_a_message(chosen: str) -> None:
    with pytest.raises(GraphError, match=f"ROS_DOMAIN_ID is '{chosen}'.*0 to 232"):
        domain_number({"ROS_DOMAIN_ID": chosen})
