"""A tap that needs confirmation is made exactly as it was shown, and only after a person has
confirmed it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_planner_with_played_devices import FAST, GOAL, Actors

from tapping_cell.logic.poses import covariance_from_message, from_message
from tapping_cell.messages import (
    ArmState,
    Bool,
    ConfirmTap,
    ErrorCode,
    PlannedTap,
    PlanState,
    SetBool,
    SingleTap,
    TapperState,
)
from tapping_cell.se2 import Pose

TIMEOUT_S = 20.0
ASKING = replace(FAST, ask=True, confirm_deadline=TIMEOUT_S)


class Asked(Actors):
    """The simulated devices and a person who confirms or rejects taps."""

    def proposal(self, other_than: int = 0) -> PlannedTap:
        """Wait until a tap waits for confirmation, and return it."""

        def waits() -> bool:
            plan = self.plans[-1]
            proposed = plan.planned_tap.tap_id not in (0, other_than)
            return plan.state == PlanState.CONFIRMING and proposed

        self.wait(waits, "a tap waits for confirmation", 10.0)
        return self.plans[-1].planned_tap

    def answer(self, tap_id: int, confirm: bool = True) -> ConfirmTap.Response:
        return self.call("confirm_tap", ConfirmTap.Request(tap_id=tap_id, confirm=confirm))

    def set_ask(self, ask: bool) -> None:
        """Switch confirmation on or off, as the node does when its parameter is set."""
        request = SetBool.Request(data=ask)
        self.process.request("ask", request, object(), lambda _: None)
        self.run(0.1)


@pytest.fixture
def asked() -> Asked:
    return Asked(ASKING)


def test_a_confirmed_tap_is_made_as_it_was_shown(asked: Asked) -> None:
    asked.send()
    shown = asked.proposal()
    asked.run(5.0)
    assert asked.taps() == [], "nothing moves before the answer"
    assert asked.answer(shown.tap_id).accepted
    asked.wait(asked.taps, "the tap")
    tap = asked.taps()[0]
    assert (tap.tap_id, tap.strike_pose) == (shown.tap_id, shown.strike_pose)
    assert tap.predicted_pose == shown.predicted_pose.pose
    assert tap.striker_speed == shown.striker_speed


def test_every_tap_of_a_goal_requires_confirmation(asked: Asked) -> None:
    asked.moves_when_fired = False
    asked.send()
    made = 0
    last = 0
    while asked.plans[-1].state not in (PlanState.REACHED, PlanState.FAILED) and made < 3:
        last = asked.proposal(last).tap_id
        assert len(asked.taps()) == made
        assert asked.answer(last).accepted
        made += 1
        asked.wait(lambda: len(asked.taps()) == made, "the confirmed tap", 5.0)  # noqa: B023
    assert [tap.tap_id for tap in asked.taps()] == sorted({tap.tap_id for tap in asked.taps()})


@given(offset=st.integers(-5, 5).filter(bool))
@settings(max_examples=settings.default.max_examples // 5)
def test_an_answer_for_another_tap_fires_nothing(offset: int) -> None:
    asked = Asked(ASKING)
    asked.send()
    shown = asked.proposal()
    refused = asked.answer(shown.tap_id + offset)
    assert not refused.accepted and refused.error_code == ErrorCode.TAP_NOT_AWAITED
    assert str(shown.tap_id) in refused.error_msg
    asked.run(1.0)
    assert asked.taps() == []
    assert asked.plans[-1].planned_tap.tap_id == shown.tap_id, "it still waits"


def test_the_same_answer_twice_makes_one_tap(asked: Asked) -> None:
    asked.send()
    shown = asked.proposal()
    assert asked.answer(shown.tap_id).accepted
    assert asked.answer(shown.tap_id).error_code == ErrorCode.TAP_NOT_AWAITED
    asked.run(0.5)
    assert len(asked.taps()) == 1


def test_a_moved_object_is_replanned(asked: Asked) -> None:
    asked.send()
    first = asked.proposal()
    asked.pose = Pose(-0.06, 0.05, 0.1)
    second = asked.proposal(first.tap_id)
    assert from_message(second.object_pose).distance_to(asked.pose) < 1e-6
    assert asked.answer(first.tap_id).error_code == ErrorCode.TAP_NOT_AWAITED
    asked.run(1.0)
    assert asked.taps() == []
    assert asked.answer(second.tap_id).accepted


def test_an_answer_that_comes_with_the_motion_does_not_fire(asked: Asked) -> None:
    """The object moves, and the person confirms the tap before the planner has received two
    observations of the motion."""
    asked.send()
    first = asked.proposal()
    asked.pose = Pose(-0.06, 0.05, 0.1)
    asked.run(0.05)
    answered = asked.answer(first.tap_id)
    assert not answered.accepted
    asked.run(1.0)
    assert asked.taps() == []


def test_an_occluded_object_is_observed_again_first(asked: Asked) -> None:
    asked.send()
    first = asked.proposal()
    asked.visible = False
    asked.run(0.3)
    answered = asked.answer(first.tap_id)
    assert not answered.accepted and answered.error_code == ErrorCode.OBJECT_NOT_SEEN
    asked.visible = True
    assert asked.proposal(first.tap_id).tap_id > first.tap_id
    assert asked.taps() == []


def test_a_skipped_tap_is_not_proposed_again(asked: Asked) -> None:
    asked.send(Pose(0.10, 0.05, 0.0))
    first = asked.proposal()
    assert asked.answer(first.tap_id, confirm=False).accepted
    second = asked.proposal(first.tap_id)
    directions = [from_message(tap.strike_pose).theta for tap in (first, second)]
    assert abs(math.remainder(directions[1] - directions[0], math.tau)) > math.radians(10)
    assert "skipped" in second.reason
    assert asked.taps() == []


def test_repeated_skipping_gives_new_proposals_and_no_tap() -> None:
    asked = Asked(replace(ASKING, goal_time_limit=600.0))
    asked.send(Pose(0.10, 0.05, 0.0))
    last, seen = 0, []
    for _ in range(10):
        last = asked.proposal(last).tap_id
        seen.append(last)
        assert asked.answer(last, confirm=False).accepted
    assert seen == sorted(set(seen)) and asked.taps() == []


def test_an_unanswered_proposal_ends_the_goal(asked: Asked) -> None:
    asked.send()
    asked.proposal()
    began = asked.now()
    end = asked.end()
    assert end.error_code == ErrorCode.TAP_NOT_CONFIRMED and "20 s" in end.error_msg
    assert asked.now() - began == pytest.approx(TIMEOUT_S, abs=1.0)
    assert asked.taps() == []


def test_the_time_limit_of_the_goal_holds_while_nobody_answers() -> None:
    asked = Asked(replace(ASKING, goal_time_limit=5.0))
    asked.send()
    asked.proposal()
    end = asked.end()
    assert end.error_code == ErrorCode.DEADLINE_EXCEEDED and "Confirming" in end.error_msg
    assert end.planned_tap.tap_id == 0


@pytest.mark.parametrize("how", ["emergency stop", "fault of the arm"])
def test_a_stop_ends_the_goal_and_the_proposal(asked: Asked, how: str) -> None:
    asked.send()
    shown = asked.proposal()
    if how == "emergency stop":
        asked.publish("emergency_stop", Bool(data=True))
    else:
        asked.arm_state, asked.arm_error = ArmState.FAULT, (ErrorCode.ARM_ALARM, "alarm 1")
    end = asked.end(5.0)
    assert end.state == PlanState.FAILED
    assert asked.answer(shown.tap_id).error_code == ErrorCode.TAP_NOT_AWAITED
    asked.run(2.0)
    assert asked.taps() == []


def test_a_confirmation_remains_valid_for_a_late_tap(asked: Asked) -> None:
    asked.tapper_answers = TapperState.NOT_FIRED
    asked.tapper_error = (ErrorCode.CAMERA_SILENT, "the last image is 0.46 s old")
    asked.send()
    shown = asked.proposal()
    assert asked.answer(shown.tap_id).accepted
    asked.wait(lambda: asked.plans[-1].state == PlanState.LOOKING, "the tap was not fired", 10.0)
    asked.tapper_answers, asked.tapper_error = TapperState.FIRED, (0, "")
    asked.wait(lambda: len(asked.taps()) == 2, "the second attempt, without a question", 10.0)
    end = asked.end()
    questions = {plan.planned_tap.tap_id for plan in asked.plans if plan.planned_tap.answer_by.sec}
    assert end.state == PlanState.REACHED and questions == {shown.tap_id}
    again = asked.taps()[1]
    assert again.tap_id != shown.tap_id and again.strike_pose == shown.strike_pose


def test_a_confirmation_given_while_the_camera_is_late_is_kept(asked: Asked) -> None:
    asked.send()
    shown = asked.proposal()
    asked.camera_active = False
    asked.run(0.6)
    assert asked.answer(shown.tap_id).accepted and asked.taps() == []
    asked.run(0.3)
    assert asked.taps() == []
    asked.camera_active = True
    asked.wait(asked.taps, "the confirmed tap", 5.0)
    assert asked.taps()[0].strike_pose == shown.strike_pose


@pytest.mark.parametrize(
    ("step", "wait", "code", "word"),
    [
        ((0.0008, 0.0, 0.0), 0.0, ErrorCode.CAMERA_SILENT, "moved by 0.80 mm"),
        ((0.0, 0.0, 0.012), 0.0, ErrorCode.CAMERA_SILENT, "and 0.69 deg"),
        ((0.0, 0.0, 0.0), 30.0, ErrorCode.CAMERA_SILENT, "more than 20 s old"),
        ((0.0, 0.0, 0.0), 0.0, ErrorCode.TAPPER_INTERLOCK_OPEN, "the interlock"),
    ],
    ids=["moved", "turned", "old", "interlock"],
)
def test_a_repeated_proposal_gives_its_reason(step, wait, code, word):
    asked = Asked(replace(ASKING, withdraw_deadline=60.0))
    asked.tapper_answers, asked.tapper_error = TapperState.NOT_FIRED, (code, "the interlock")
    asked.send()
    shown = asked.proposal()
    asked.arm_withdraws = False
    assert asked.answer(shown.tap_id).accepted
    settling = PlanState.SETTLING
    asked.wait(lambda: asked.plans[-1].state == settling, "the tap is not fired", 5.0)
    asked.pose = Pose(*(a + b for a, b in zip(asked.pose, step, strict=True)))
    asked.run(wait)
    asked.arm_withdraws, asked.arm_state = True, ArmState.IDLE
    again = asked.proposal(shown.tap_id)
    assert "asked again because" in again.reason and word in again.reason
    asked.run(1.0)
    assert len(asked.taps()) == 1


def test_a_refusal_that_is_reported_late_withdraws_the_confirmation(asked: Asked) -> None:
    asked.tapper_answers = None
    asked.arm_withdraws = False
    asked.send()
    shown = asked.proposal()
    assert asked.answer(shown.tap_id).accepted
    settling = PlanState.SETTLING
    asked.wait(lambda: asked.plans[-1].state == settling, "the tap is given up", 5.0)
    asked.outcome = TapperState.NOT_FIRED
    asked.tapper_error = ErrorCode.TAPPER_INTERLOCK_OPEN, "the interlock"
    asked.run(0.1)
    asked.tapper_error = 0, ""
    asked.arm_withdraws, asked.arm_state = True, ArmState.IDLE
    again = asked.proposal(shown.tap_id)
    assert "asked again because" in again.reason and "the interlock" in again.reason
    asked.run(1.0)
    assert len(asked.taps()) == 1


def test_a_lost_arm_drops_the_proposal(asked: Asked) -> None:
    asked.send()
    shown = asked.proposal()
    asked.arm_active = False
    asked.wait(lambda: asked.plans[-1].state == PlanState.WAITING_FOR_CELL, "it waits", 3.0)
    asked.arm_active = True
    assert asked.proposal(shown.tap_id).tap_id > shown.tap_id


def test_an_arm_that_is_busy_at_the_answer_gets_no_tap(asked: Asked) -> None:
    asked.send()
    shown = asked.proposal()
    asked.arm_state = ArmState.MOVING
    asked.run(0.2)
    assert not asked.answer(shown.tap_id).accepted
    asked.arm_state = ArmState.IDLE
    asked.proposal(shown.tap_id)
    assert asked.taps() == []


def test_the_confirmation_mode_is_switched_while_the_cell_runs() -> None:
    asked = Asked(replace(ASKING, ask=False))
    asked.moves_when_fired = False
    asked.wait(lambda: asked.states, "the planner is up")
    assert not asked.plans[-1].ask
    asked.set_ask(True)
    assert asked.plans[-1].ask
    asked.send()
    shown = asked.proposal()
    # Switching confirmation off does not fire this tap, because it was shown as waiting for
    # confirmation.
    asked.set_ask(False)
    asked.run(2.0)
    assert asked.taps() == [] and asked.plans[-1].planned_tap.tap_id == shown.tap_id
    assert asked.answer(shown.tap_id).accepted
    asked.wait(lambda: len(asked.taps()) == 2, "the next tap, which is not asked for")


def test_the_expected_result_is_shown_with_its_uncertainty(asked: Asked) -> None:
    """The ellipse of the expected result is at least as long as the scatter of a tap and grows with
    the length of the tap."""
    sizes = []
    for goal in (Pose(-0.02, 0.02, 0.2), Pose(0.06, 0.02, 0.2)):
        asked = Asked(ASKING)
        asked.send(goal)
        shown = asked.proposal()
        covariance = covariance_from_message(shown.predicted_pose.covariance)
        assert np.all(np.linalg.eigvalsh(covariance) >= -1e-15)
        before = from_message(shown.object_pose)
        moved = before.distance_to(from_message(shown.predicted_pose.pose))
        size = math.sqrt(float(np.max(np.linalg.eigvalsh(covariance[:2, :2]))))
        assert 0.05 * moved <= size <= 0.15 * moved
        sizes.append(size)
    assert sizes[1] > sizes[0]


def test_without_the_confirmation_mode_no_tap_waits() -> None:
    actors = Actors(FAST)
    actors.send(GOAL)
    assert actors.end().state == PlanState.REACHED
    assert not any(plan.state == PlanState.CONFIRMING for plan in actors.plans)


def test_a_tap_before_which_an_object_was_moved_is_asked_for_again(asked: Asked) -> None:
    """Also if the object was put back, so that the new tap equals the confirmed one."""
    asked.arm_arrives = False
    asked.send()
    shown = asked.proposal()
    home = asked.pose
    assert asked.answer(shown.tap_id).accepted
    asked.wait(asked.taps, "the command")
    asked.pose = Pose(home.x + 0.05, home.y, home.theta)
    asked.wait(lambda: len(asked.commands) > 1, "the withdrawal")
    asked.outcome = TapperState.NOT_FIRED
    asked.pose = home
    again = asked.proposal(shown.tap_id)
    assert "an object was moved" in again.reason
    assert len(asked.taps()) == 1


def test_a_rejected_single_tap_is_not_proposed_again(asked: Asked) -> None:
    results: list[SingleTap.Result] = []
    asked.wait(lambda: asked.states, "the planner is up")
    asked.run(0.3)
    prescribed = SingleTap.Goal(striker_speed=0.6, incidence=0.0, direction=math.nan, slack=math.pi)
    asked.process.request("single_tap", prescribed, object(), results.append)
    assert asked.answer(asked.proposal().tap_id, confirm=False).accepted
    asked.run(0.1)
    assert [one.error_code for one in results] == [ErrorCode.TAP_NOT_CONFIRMED]
    assert asked.taps() == []
