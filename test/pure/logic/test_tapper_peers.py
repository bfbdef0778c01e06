"""What the messages of arm, planner and camera forbid the tapper."""

from __future__ import annotations

import pytest
from logic_parts import at

from tapping_cell.logic.clock import to_stamp
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.tapper_peers import PeerLimits, TapperPeers
from tapping_cell.messages import ArmState, ErrorCode, ObjectState, ObjectStates, PlanState
from tapping_cell.se2 import Pose

START = 100.0
TAP = 7
POSE, STRIKE = Pose(0.05, -0.02, 1.0), Pose(0.02, -0.02, 0.0)
HEIGHT = 0.01


def picture(steady: float, pose: Pose = POSE) -> ObjectStates:
    state = ObjectState(object_id="disk", visible=True, at_rest=True)
    state.header.stamp = to_stamp(at(steady).ros)
    state.pose.pose = to_message(pose)
    message = ObjectStates(objects=[state])
    message.header.stamp = state.header.stamp
    return message


def arm(state: int, steady: float, tap_id: int = TAP) -> ArmState:
    message = ArmState(state=state, tap_id=tap_id, homed=True)
    message.tip_pose = to_message(STRIKE, HEIGHT)
    message.header.stamp = to_stamp(at(steady).ros)
    return message


def peers(taps: bool = True, **limits: float) -> TapperPeers:
    """Return peers that have just sent everything that a tap needs."""
    made = TapperPeers(PeerLimits(**limits))
    made.begin_tap("disk", HEIGHT)
    plan = PlanState(state=PlanState.FIRING if taps else PlanState.IDLE)
    plan.header.stamp = to_stamp(at(START).ros)
    made.on_plan_state(plan, at(START))
    made.on_arm_state(arm(ArmState.IN_POSITION, START), at(START))
    made.on_object_states(picture(START), at(START))
    return made


def firing(made: TapperPeers, steady: float) -> int:
    error = made.check_firing(TAP, POSE, STRIKE, at(steady))
    return error[0] if error else ErrorCode.NONE


@pytest.mark.parametrize(
    ("taps", "later", "code"),
    [
        (True, 0.44, ErrorCode.NONE),
        (True, 0.46, ErrorCode.NOT_READY),
        (False, 1.4, ErrorCode.NONE),
        (False, 1.6, ErrorCode.NOT_READY),
    ],
)
def test_a_silent_planner_ends_its_tap_sooner_than_that_of_a_program(taps, later, code) -> None:
    made = peers(taps)
    made.on_arm_state(arm(ArmState.IN_POSITION, START + later), at(START + later))
    made.on_object_states(picture(START + later), at(START + later))
    assert firing(made, START + later) == code


def test_a_longer_limit_holds_for_every_planner() -> None:
    made = peers(taps=False, silence=2.0)
    made.on_arm_state(arm(ArmState.IN_POSITION, START + 1.8), at(START + 1.8))
    made.on_object_states(picture(START + 1.8), at(START + 1.8))
    assert firing(made, START + 1.8) == ErrorCode.NONE


def test_a_late_older_image_does_not_make_the_camera_silent() -> None:
    made = peers(taps=False)
    made.on_object_states(picture(START + 0.4), at(START + 0.4))
    made.on_object_states(picture(START - 1.0), at(START + 0.4))
    made.on_arm_state(arm(ArmState.IN_POSITION, START + 0.8), at(START + 0.8))
    assert firing(made, START + 0.8) == ErrorCode.NONE
    made.on_arm_state(arm(ArmState.IN_POSITION, START + 0.9), at(START + 0.9))
    assert firing(made, START + 0.9) == ErrorCode.CAMERA_SILENT


@pytest.mark.parametrize("moved", [True, False])
@pytest.mark.parametrize(
    ("state", "silent", "code"),
    [
        (ArmState.IDLE, False, ErrorCode.TAPPER_ARM_NOT_IN_POSITION),
        (ArmState.IDLE, True, ErrorCode.ARM_SILENT),
        (ArmState.MOVING, True, ErrorCode.ARM_SILENT),
        (ArmState.MOVING, False, ErrorCode.NONE),
        (ArmState.IN_POSITION, False, ErrorCode.NONE),
    ],
)
def test_a_wait_is_explained_by_the_object_before_the_arm(state, silent, code, moved) -> None:
    made = peers()
    made.on_arm_state(arm(state, START), at(START))
    pose = Pose(POSE.x + 0.01, POSE.y, POSE.theta) if moved else POSE
    later = START + (0.31 if silent else 0.0)
    made.on_object_states(picture(later, pose), at(later))
    error = made.obstacle(TAP, POSE, STRIKE, at(later))
    assert (error[0] if error else 0) == (ErrorCode.OBJECT_MOVED if moved else code)
