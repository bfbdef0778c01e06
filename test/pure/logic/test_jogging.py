"""Manual steps of the arm: small, within its limits, and only while nothing else can happen."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_enabling import HELD, PARKED, RELEASED, set_up_pair
from test_permit import CELL, START, Pair, at, jobs

from tapping_cell.hardware.motion import check_limits
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic import arm as arms
from tapping_cell.logic import enabling, jogging
from tapping_cell.logic.arm_jobs import MotionEnd, Reading
from tapping_cell.logic.arm_states import State
from tapping_cell.logic.effects import Answer, Effect, JobEnded, RunJob, StopWire
from tapping_cell.logic.host import Activated, Configured
from tapping_cell.messages import ErrorCode, Jog, PlanState, TapCommand, TapperState
from tapping_cell.se2 import Pose

GEOMETRY = CELL.arm.geometry()
STEP = jogging.request("shoulder", math.radians(1.0))
MIDDLE = Joints(0.3, 1.2, -0.05, 0.2)
joints = st.tuples(
    *(st.floats(low, high) for low, high in zip(GEOMETRY.lower, GEOMETRY.upper, strict=True))
).map(lambda values: Joints(*values))
steps = st.tuples(st.sampled_from([*jogging.AXES]), st.floats(-0.12, 0.12))


def ready_arm() -> arms.ArmLogic:
    """Return an idle arm in set-up mode, whose key is held and whose position was just read. The
    promise of an earlier process to stand still is over."""
    arm = arms.ArmLogic(arms.ArmOptions(set_up=True))
    arm.on_lifecycle(Configured(CELL, Reading(True, PARKED, False, START)), at(START - 10.0))
    arm.on_lifecycle(Activated(), at(START - 10.0))
    arm.on_message(enabling.TOPIC, HELD, at(START))
    return arm


def ask(arm: arms.ArmLogic, request: Jog.Request, steady: float) -> tuple[Jog.Response, Any]:
    """Send a request; return the response and all effects."""
    made: list[Effect] = [*arm.on_request("~/jog", request, 1, at(steady))]
    (answer,) = [effect.response for effect in made if isinstance(effect, Answer)]
    return answer, made


@given(joints, steps)
def test_a_step_stays_within_the_limits_and_moves_only_what_was_asked(
    here: Joints, step: tuple[str, float]
) -> None:
    axis, size = step
    found = jogging.target(CELL, here, jogging.request(axis, size))
    largest = jogging.LARGEST_STEP_M if jogging.is_length(axis) else jogging.LARGEST_STEP_RAD
    if not isinstance(found, Joints):
        code, sentence = found
        assert sentence
        assert code in (
            ErrorCode.COMMAND_INVALID,
            ErrorCode.ARM_OUT_OF_REACH,
            ErrorCode.ARM_JOINT_LIMIT,
        )
        assert (code == ErrorCode.COMMAND_INVALID) == (abs(size) > largest + 1e-9)
        return
    check_limits(GEOMETRY, found)
    assert abs(size) <= largest + 1e-9
    kind, index = jogging.AXES[axis]
    wanted = [size if index == each else 0.0 for each in range(4)]
    if kind == Jog.Request.JOINTS:
        assert np.subtract(found, here) == pytest.approx(wanted, abs=1e-12)
        return
    before, after = (tip_in_table(each) for each in (here, found))
    moved = np.subtract(after, before)
    moved[3] = math.remainder(moved[3], math.tau)
    assert moved == pytest.approx(wanted, abs=1e-9)
    assert max(abs(a - b) for a, b in zip(here, found, strict=True)) <= math.radians(20.0)


def tip_in_table(at_joints: Joints) -> tuple[float, float, float, float]:
    tip = GEOMETRY.forward(at_joints)
    planar = CELL.arm_base @ Pose(tip.x, tip.y, tip.yaw)
    return planar.x, planar.y, tip.z, planar.theta


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 0.2])
@pytest.mark.parametrize("kind", [Jog.Request.JOINTS, Jog.Request.TIP, 7])
def test_an_invalid_number_or_kind_is_refused(kind: int, number: float) -> None:
    for index in range(4):
        step = [number if index == each else 0.0 for each in range(4)]
        found = jogging.target(CELL, MIDDLE, Jog.Request(kind=kind, step=step))
        assert not isinstance(found, Joints) and found[0] == ErrorCode.COMMAND_INVALID


def test_a_joint_at_its_limit_steps_only_back() -> None:
    here = MIDDLE._replace(shoulder=GEOMETRY.upper[0])
    out, back = (
        jogging.target(CELL, here, jogging.request("shoulder", by)) for by in (0.01, -0.01)
    )
    assert not isinstance(out, Joints) and out[0] == ErrorCode.ARM_JOINT_LIMIT
    assert "limit" in out[1] or "outside" in out[1]
    assert isinstance(back, Joints)


def test_the_arm_steps_slowly_and_is_idle_again() -> None:
    arm = ready_arm()
    answer, made = ask(arm, STEP, START + 0.1)
    assert answer.accepted and arm.state is State.FOLLOWING
    (run,) = [effect.job.run for effect in made if isinstance(effect, RunJob)]
    goal = PARKED._replace(shoulder=PARKED.shoulder + math.radians(1.0))
    assert run.keywords["targets"] == [(goal, 0.0)]
    assert run.keywords["scale"] == arms.SET_UP_SPEED * CELL.arm.motion().near_speed
    (job,) = jobs(made)
    end = MotionEnd(True, Reading(True, goal, False, START + 0.2))
    arm.on_job(JobEnded(job, end), at(START + 0.2))
    assert arm.state is State.IDLE


def test_the_arm_parks_on_request() -> None:
    arm = ready_arm()
    answer, made = ask(arm, Jog.Request(kind=Jog.Request.PARK), START + 0.1)
    assert answer.accepted and jobs(made) and arm.state is State.WITHDRAWING


@pytest.mark.parametrize("kind", [Jog.Request.JOINTS, Jog.Request.PARK])
@pytest.mark.parametrize("silent", [True, False])
def test_the_release_of_the_key_stops_the_step(kind: int, silent: bool) -> None:
    arm = ready_arm()
    ask(arm, replace(STEP, kind=kind), START + 0.1)
    if silent:
        made = arm.on_tick(at(START + 1.1 * enabling.HEARTBEAT_S))
    else:
        made = arm.on_message(enabling.TOPIC, RELEASED, at(START + 0.15))
    assert isinstance(made[0], StopWire) and arm.state is State.STOPPED
    answer, made = ask(arm, STEP, START + 2.0)
    assert answer.error_code == ErrorCode.ARM_BUSY and not jobs(made)


def refused(arm: arms.ArmLogic, steady: float = START + 0.1) -> int:
    """Return the code with which every kind of motion is refused, without an effect."""
    codes = set()
    for kind in (Jog.Request.JOINTS, Jog.Request.TIP, Jog.Request.PARK):
        state = arm.state
        answer, made = ask(arm, replace(STEP, kind=kind), steady)
        assert not answer.accepted and answer.error_msg and not jobs(made)
        assert arm.state is state
        codes.add(answer.error_code)
    (code,) = codes
    return int(code)


def test_a_released_key_refuses() -> None:
    arm = ready_arm()
    assert refused(arm, START + 1.1 * enabling.HEARTBEAT_S) == ErrorCode.ENABLING_RELEASED
    arm.on_message(enabling.TOPIC, RELEASED, at(START + 0.1))
    assert refused(arm) == ErrorCode.ENABLING_RELEASED


def test_an_arm_outside_set_up_mode_refuses() -> None:
    arm = arms.ArmLogic(arms.ArmOptions())
    arm.on_lifecycle(Configured(CELL, Reading(True, PARKED, False, START)), at(START))
    assert refused(arm) == ErrorCode.NOT_ACTIVE
    arm.on_lifecycle(Activated(), at(START))
    arm.on_message(enabling.TOPIC, HELD, at(START))
    assert refused(arm) == ErrorCode.NOT_IN_SET_UP


def test_an_arm_that_is_not_homed_refuses() -> None:
    arm = arms.ArmLogic(arms.ArmOptions(set_up=True))
    arm.on_lifecycle(Configured(CELL, Reading(False, PARKED, False, START)), at(START))
    arm.on_lifecycle(Activated(), at(START))
    arm.on_message(enabling.TOPIC, HELD, at(START))
    assert refused(arm) == ErrorCode.ARM_NOT_HOMED


@pytest.mark.parametrize("state", range(13))
def test_a_goal_under_way_refuses(state: int) -> None:
    arm = ready_arm()
    arm.on_message("plan_state", PlanState(state=state), at(START))
    over = state in (PlanState.IDLE, PlanState.REACHED, PlanState.FAILED, PlanState.CANCELED)
    answer, _ = ask(arm, STEP, START + 0.1)
    assert answer.error_code == (ErrorCode.NONE if over else ErrorCode.PLANNER_BUSY)


def test_a_step_under_way_refuses_the_next_and_a_tap() -> None:
    arm = ready_arm()
    ask(arm, STEP, START + 0.1)
    assert refused(arm) == ErrorCode.ARM_BUSY
    tap = Pair().command(TapCommand.TAP, at(START + 0.1))
    assert not jobs(arm.on_message("tap_command", tap, at(START + 0.1)))
    assert arm.state is State.FOLLOWING


def test_an_arm_at_a_strike_pose_refuses() -> None:
    pair = set_up_pair()
    for machine in (pair.arm, pair.tapper):
        machine.on_message(enabling.TOPIC, HELD, at(START))
    pair.begin()
    assert refused(pair.arm) == ErrorCode.ARM_BUSY


@given(st.floats(0.0, 1.0))
def test_no_step_begins_while_the_striker_may_be_charged(late: float) -> None:
    """The striker counts as charged for 0.7 s after its last report; docs/safety.md."""
    arm = ready_arm()
    arm._last_tap_id = 7
    charged = TapperState(state=TapperState.CHARGED, tap_id=7)
    arm.on_message("tapper_state", charged, at(START))
    now = START + 0.01 + late
    arm.on_message(enabling.TOPIC, HELD, at(now))
    arm._readings.take_in(Reading(True, PARKED, False, now), at(now))
    answer, _ = ask(arm, STEP, now)
    assert answer.error_code == (ErrorCode.ARM_BUSY if now - START < 0.7 else ErrorCode.NONE)


def test_an_old_position_refuses() -> None:
    arm = ready_arm()
    arm.on_message(enabling.TOPIC, HELD, at(START + 1.01))
    assert refused(arm, START + 1.01) == ErrorCode.ARM_TIMEOUT


def test_a_conflict_between_nodes_refuses() -> None:
    arm = ready_arm()
    arm.on_conflict("two nodes publish tap_command", at(START))
    assert refused(arm) == ErrorCode.CONFIGURATION_CONFLICT
