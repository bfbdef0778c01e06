"""Kill each node while a goal is being executed: nothing unsafe happens and the goal is reached.

``python -m tapping_cell faults --crashes`` kills every node at every phase of a tap; ``faults
--goals`` kills and freezes nodes at random times, in virtual time.

``TAPPING_CELL_FREEZES=100:7 pytest --timeout 0`` freezes the planner and the camera node 100 times
each, at random times with seed 7. With the same variable, ``test/nodes/test_frozen_tapper.py``
freezes the tapper and the arm.
"""

from __future__ import annotations

import os
import random
import time
from collections.abc import Iterator

import pytest
from builtin_interfaces.msg import Time
from tapping_cell_msgs.msg import TapCommand

from tapping_cell.cli.crash_trials import PHASES, CrashCell, Observed

FREEZES, SEED = map(int, os.environ.get("TAPPING_CELL_FREEZES", "4:5").split(":"))


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CrashCell]:
    with CrashCell(tmp_path_factory.mktemp("cell"), frame_rate=15.0) as made:
        yield made


def test_the_goal_is_reached_although_every_node_is_killed_once(cell: CrashCell) -> None:
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


@pytest.mark.parametrize("node", ["tap_planner", "camera_pose"])
def test_no_tap_is_fired_on_messages_of_a_frozen_planner_or_camera(
    cell: CrashCell, node: str
) -> None:
    draw = random.Random(SEED)
    frozen = strikes = goals = 0
    # The freezes may prevent every tap. Then up to two goals with one freeze each follow, so that a
    # strike is checked.
    while frozen < FREEZES or (not strikes and frozen < FREEZES + 2):
        goals += 1
        enough = max(FREEZES, frozen + 1)
        phase = draw.choice(PHASES[1:4])
        assert cell.begin(phase), f"the goal never came to be {phase}; {cell.ended()}"
        while cell.ended() is None and frozen < enough:
            time.sleep(draw.uniform(0.0, 0.1))
            cell.freeze(node, draw.uniform(0.05, 2.0))
            frozen += 1
            phase = draw.choice(PHASES[1:4])
            cell.wait(lambda phase=phase: cell.ended() is not None or cell.in_phase(phase), 120.0)
        assert cell.wait(lambda: cell.ended() is not None, 240.0)
        crash = cell.finish(node, "frozen", 0.0)
        strikes += len(cell.seen.struck)
        assert crash.ended != "hung", crash
        assert not crash.unsafe, crash
    print(f"{frozen} freezes of {node} (seed {SEED}): {goals} goals, {strikes} strikes")
    assert strikes


@pytest.mark.parametrize(
    ("struck", "frozen_until", "unsafe"),
    [(9.5, 11.0, False), (10.1, 11.0, True), (10.1, 10.0, False)],
    ids=["before the limits end", "while frozen", "thawed"],
)
def test_a_tap_fired_on_messages_of_a_frozen_node_is_detected(
    struck: float, frozen_until: float, unsafe: bool
) -> None:
    """Test the check that the other tests of this file use: it must detect a strike that is based
    on old messages of a frozen node."""
    tap = TapCommand(request=TapCommand.TAP, striker_speed=0.3)
    tap.header.stamp = Time(sec=9)
    seen = Observed(commands=[tap], struck=[struck])
    seen.settled.append(struck - 0.1)
    seen.frozen.append(("tap_planner", 9.0, frozen_until))
    seen.judge_strikes()
    assert bool(seen.unsafe) is unsafe
