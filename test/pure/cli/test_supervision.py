"""Nodes that end are restarted a limited number of times. Only the end of an essential node ends
the others."""

from __future__ import annotations

import pytest

from tapping_cell.cli.graph import Ended, NodeDied
from tapping_cell.cli.supervision import DELAY_S, MAX_RESTARTS, WINDOW_S, Supervisor


class FakeGraph:
    """Processes that end when the test asks them to."""

    def __init__(self) -> None:
        self.down: dict[str, Ended] = {}
        self.started: list[str] = []

    def ended(self) -> list[Ended]:
        return list(self.down.values())

    def restart(self, name: str) -> None:
        del self.down[name]
        self.started.append(name)

    def end(self, name: str, status: int = -9, words: str = "it printed nothing") -> None:
        self.down[name] = Ended(name, status, words)


@pytest.mark.parametrize("name", ["operator_page", "run_recorder", "tap_planner", "scara_arm"])
def test_a_killed_node_is_named_and_restarted(name: str) -> None:
    graph = FakeGraph()
    supervisor = Supervisor(graph)  # type: ignore[arg-type]
    graph.end(name)
    (incident,) = supervisor.check(10.0)
    assert incident.node == name and "SIGKILL" in incident.sentence
    assert not supervisor.check(10.0 + DELAY_S / 2) and not graph.started
    assert not supervisor.check(10.0 + DELAY_S) and graph.started == [name]


@pytest.mark.parametrize(("name", "ends"), [("operator_page", False), ("tapper_trigger", True)])
def test_a_node_that_ends_repeatedly_is_restarted_a_limited_number_of_times(name, ends):
    graph, now = FakeGraph(), 0.0
    supervisor = Supervisor(graph)  # type: ignore[arg-type]
    for _ in range(MAX_RESTARTS):
        graph.end(name)
        supervisor.check(now)
        now += DELAY_S
        supervisor.check(now)
    graph.end(name)
    if ends:
        with pytest.raises(NodeDied, match=f"without {name}, which ended 4 times"):
            supervisor.check(now)
        return
    (incident,) = supervisor.check(now)
    assert incident.given_up and "the cell works without it" in incident.sentence
    assert not supervisor.check(now + WINDOW_S) and name in supervisor.left_alone


def test_rare_exits_do_not_accumulate() -> None:
    graph = FakeGraph()
    supervisor = Supervisor(graph)  # type: ignore[arg-type]
    for number in range(20):
        graph.end("scara_arm")
        supervisor.check(number * WINDOW_S)
        supervisor.check(number * WINDOW_S + DELAY_S)
    assert len(graph.started) == 20


def test_a_node_that_refuses_its_parameters_is_not_restarted() -> None:
    graph = FakeGraph()
    graph.end("tap_planner", 1, "loading | error: unknown parameter 'speeed'")
    with pytest.raises(NodeDied, match="error: unknown parameter 'speeed'"):
        Supervisor(graph).check(0.0)  # type: ignore[arg-type]
