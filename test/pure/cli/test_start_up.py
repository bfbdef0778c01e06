"""`up` prints "ready" only if a goal would be accepted, and otherwise what is missing."""

from __future__ import annotations

from typing import Any

import pytest

from tapping_cell.cli.start_up import judge
from tapping_cell.messages import ErrorCode

NODES = ("sim_world", "camera_pose", "tap_planner", "scara_arm", "tapper_trigger", "operator_page")


def cell(mode: str = "ready", code: int = 0, **rows: dict[str, str]) -> dict[str, Any]:
    """Return a state of the cell's client; ``rows`` replaces the rows of some nodes."""
    well = {"life": "active", "level": "ok", "sentence": "ok"}
    return {
        "nodes": [{**well, "name": name, **rows.get(name, {})} for name in NODES],
        "mode": mode,
        "code": code,
        "sentence": "the cell accepts goals" if mode == "ready" else "a reason",
        "hint": "a remedy.",
        "plan": {"busy": False},
        "recovery": [],
    }


def test_a_cell_that_accepts_goals_is_ready() -> None:
    start = judge(NODES, cell(), {})
    assert start.ready and not start.reason and {line.word for line in start.lines} == {"ready"}


@pytest.mark.parametrize("name", NODES)
@pytest.mark.parametrize("life", ["not running", "unconfigured", "inactive"])
def test_a_cell_with_an_inactive_node_is_not_ready(name: str, life: str) -> None:
    start = judge(NODES, cell(**{name: {"life": life, "sentence": "waits for X"}}), {})
    assert not start.ready and not start.person and name in start.reason


@pytest.mark.parametrize("mode", ["not ready", "stopped", "fault", "moving"])
def test_active_nodes_alone_are_not_ready(mode: str) -> None:
    start = judge(NODES, cell(mode, ErrorCode.CAMERA_SILENT), {})
    assert not start.ready and start.reason == "a reason" and not start.person


def test_a_required_operator_action_is_reported_and_does_not_count_as_a_late_start() -> None:
    start = judge(NODES, cell("not ready", ErrorCode.ARM_NOT_HOMED), {})
    assert not start.ready and start.person == "a reason. a remedy."


def test_a_node_with_a_fault_has_started() -> None:
    """A fault of a cell that was ready is cleared by a person; it must not end `up`."""
    fault = {"level": "error", "sentence": "no status report from the arm's controller"}
    start = judge(NODES, cell("fault", ErrorCode.ARM_TIMEOUT, scara_arm=fault), {})
    assert start.complete and not start.ready and "scara_arm: fault" in start.reason
    restarted = {"life": "inactive", "level": "ok", "sentence": "not configured"}
    assert not judge(NODES, cell("fault", tap_planner=restarted, scara_arm=fault), {}).complete


def test_devices_wait_for_the_simulated_world_without_cable_hints() -> None:
    state = cell(
        "not ready",
        ErrorCode.ARM_NOT_CONNECTED,
        sim_world={"life": "not running"},
        scara_arm={"life": "unconfigured", "level": "warn", "sentence": "check the cable"},
    )
    lines = {line.node: str(line) for line in judge(NODES, state, {}).lines}
    assert lines["sim_world"] == "sim_world: starting"
    assert lines["scara_arm"] == "scara_arm: waits, for sim_world"


@pytest.mark.parametrize(
    ("name", "ready"), [("operator_page", True), ("camera_pose", False), ("tapper_trigger", False)]
)
def test_only_faults_of_nodes_that_position_nothing_let_the_cell_start(
    name: str, ready: bool
) -> None:
    full = {"level": "error", "sentence": "(908) the disk is full"}
    start = judge(NODES, cell(**{name: full}), {})
    assert start.ready == ready and "the disk is full" in " ".join(map(str, start.lines))


def test_an_unattended_page_does_not_block_the_cell() -> None:
    state = cell(operator_page={"life": "not running"})
    start = judge(NODES, state, {"operator_page": "ended by SIGKILL"})
    assert start.ready and str(start.lines[-1]) == "operator_page: ended, ended by SIGKILL"
