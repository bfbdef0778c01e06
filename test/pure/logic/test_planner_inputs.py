"""Which objects that are not seen the planner takes for hidden by the arm."""

from __future__ import annotations

import math

import pytest
from logic_parts import alone, at, goal_handling

from tapping_cell.configuration.cell import load_cell
from tapping_cell.logic.clock import to_stamp
from tapping_cell.logic.planner_inputs import PlannerInputs
from tapping_cell.logic.poses import to_message
from tapping_cell.messages import ArmState, ObjectState, PoseStamped
from tapping_cell.se2 import Pose

CELL = load_cell()
UNDER_THE_TIP = Pose(0.05, 0.02, 0.0)
LENS = (0.0, 0.0, 0.9)


def camera(x: float, y: float, z: float) -> PoseStamped:
    message = PoseStamped()
    message.pose.position.x, message.pose.position.y, message.pose.position.z = x, y, z
    return message


def arm(tip: Pose = UNDER_THE_TIP, homed: bool = True) -> ArmState:
    message = ArmState(state=ArmState.IDLE, homed=homed, tip_pose=to_message(tip, 0.02))
    message.header.stamp = to_stamp(at(1.0).ros)
    return message


def state(steady: float, visible: bool, name: str) -> ObjectState:
    made = ObjectState(object_id=name, visible=visible, at_rest=visible)
    made.header.stamp = to_stamp(at(steady).ros)
    made.pose.pose = to_message(UNDER_THE_TIP)
    return made


def covered(
    lens: PoseStamped | None,
    arm_state: ArmState | None,
    seen: bool = True,
    name: str = CELL.object.name,
    has_arm: bool = True,
) -> bool:
    """Return whether an object that was seen under the arm's tip counts as hidden by the arm."""
    inputs = PlannerInputs(0.5)
    inputs.configure(goal_handling(CELL))
    inputs.monitor.expect(has_arm, name)
    if lens is not None:
        inputs.receive("camera/pose", lens, at(1.0))
    if arm_state is not None:
        inputs.receive("arm_state", arm_state, at(1.0))
    if seen:
        inputs.receive("object_states", alone(state(1.0, True, name)), at(1.0))
        assert name not in inputs.monitor._covered_at, "an object that is seen is not hidden"
    inputs.receive("object_states", alone(state(1.1, False, name)), at(1.1))
    return name in inputs.monitor._covered_at


def test_an_object_under_the_arm_may_be_hidden_by_it() -> None:
    assert covered(camera(*LENS), arm())


@pytest.mark.parametrize(
    "inputs",
    [
        (None, arm()),
        (camera(*LENS), None),
        (camera(*LENS), arm(homed=False)),
        (camera(math.nan, 0.0, 0.9), arm()),
        (camera(*LENS), arm(Pose(math.nan, 0.0, 0.0))),
        (camera(*LENS), arm(Pose(0.1, 0.2, 0.0))),
        (camera(*LENS), arm(), False),
        (camera(*LENS), arm(), True, "an object without a file"),
    ],
    ids=[
        *("no camera", "no arm", "not homed", "camera without a number", "arm without a number"),
        *("elsewhere", "never seen", "unknown"),
    ],
)
def test_without_knowing_camera_arm_and_object_nothing_counts_as_hidden(inputs) -> None:
    assert not covered(*inputs)


def test_a_cell_without_an_arm_hides_nothing() -> None:
    """Even if another cell's arm is heard."""
    assert not covered(camera(*LENS), arm(), has_arm=False)


def test_nothing_is_hidden_before_the_cell_is_known() -> None:
    inputs = PlannerInputs(0.5)
    inputs.receive("camera/pose", camera(*LENS), at(1.0))
    inputs.receive("arm_state", arm(), at(1.0))
    for time, visible in ((1.0, True), (1.1, False)):
        states = alone(state(time, visible, CELL.object.name))
        assert inputs.receive("object_states", states, at(time)) is None
    assert not inputs.monitor._covered_at
