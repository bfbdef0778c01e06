"""Each node killed in the course of a goal: nothing unsafe happens and the goal is reached.

``python -m tapping_cell faults --crashes`` kills every node at every phase of a tap; ``faults
--goals`` does so, and freezes them, in virtual time.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tapping_cell.cli.crash_trials import CrashCell


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CrashCell]:
    with CrashCell(tmp_path_factory.mktemp("cell"), frame_rate=15.0) as made:
        yield made


def test_every_node_is_killed_in_the_course_of_a_goal_which_is_reached(cell: CrashCell) -> None:
    assert cell.begin("planning")
    cell.kill("camera_pose")
    for node, phase in (
        ("scara_arm", "travelling"),
        ("tapper_trigger", "drawn"),
        ("tap_planner", "drawn"),
    ):
        assert cell.come(phase), f"the goal never came to be {phase}; {cell.ended()}"
        cell.kill(node)
    assert cell.wait(lambda: cell.ended() is not None, 120.0)
    crash = cell.finish("every node", "", 0.0)
    assert crash.ended == "reached", crash
    assert crash.clean, crash.unsafe
