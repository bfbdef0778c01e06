"""Nodes killed or hung in the middle of a tap: nothing unsafe happens and the goal is reached.

Two of the 35 combinations; ``python -m tapping_cell faults --crashes`` runs them all.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator

import pytest
from tapping_cell_msgs.msg import ArmState, TapperState

from tapping_cell.cli.crash_trials import CrashCell


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CrashCell]:
    with CrashCell(tmp_path_factory.mktemp("cell")) as made:
        yield made


@pytest.mark.parametrize(("node", "phase"), [("tap_planner", "drawn"), ("scara_arm", "travelling")])
def test_a_killed_node_comes_back_and_the_goal_is_reached(
    cell: CrashCell, node: str, phase: str
) -> None:
    crash = cell.trial(node, phase)
    assert crash.ended == "reached", crash
    assert crash.clean, crash.unsafe


@pytest.mark.parametrize("node", ["tap_planner", "camera_pose"])
def test_nothing_is_drawn_while_a_node_hangs_and_the_tap_goes_on_after_it(
    cell: CrashCell, node: str
) -> None:
    cell.begin("travelling")
    process = cell.graph.process_ids[node]
    os.kill(process, signal.SIGSTOP)
    try:
        assert cell.wait(lambda: cell.seen.arm.state == ArmState.IN_POSITION, 60.0)
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            assert cell.seen.tapper.state == TapperState.SAFE
            assert cell.seen.tapper.outcome == TapperState.NONE
            time.sleep(0.01)
    finally:
        os.kill(process, signal.SIGCONT)
    assert cell.wait(lambda: cell.ended() is not None, 120.0)
    assert cell.finish(node, "travelling", 0.0).clean
