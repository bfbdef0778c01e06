"""The cycle of one tap of the arm: when it leaves the strike pose, and where its way ends."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, cast

import pytest
from logic_parts import at

from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic.arm_cycle import ArmCycle
from tapping_cell.logic.arm_jobs import MotionEnd, Reading
from tapping_cell.logic.arm_states import InPosition, Leaving, Placing, Tap, Withdrawing
from tapping_cell.logic.device import Abandon, Run
from tapping_cell.logic.standing_still import StandingStill
from tapping_cell.logic.transitions import Go
from tapping_cell.messages import HoldStill, TapperState

CELL = load_cell()
START = 100.0
TAP = Tap(7, at(START + 1.0).ros, cast(Any, "the strike pose"), cast(Any, "the scene"))
JOINTS = Joints(0.3, -0.8, 0.0, 0.2)
SERVED = InPosition(tap_id=7, tap=TAP, joints=JOINTS)


def cycle(set_up: bool = False) -> tuple[ArmCycle, StandingStill]:
    still = StandingStill()
    made = ArmCycle(still, set_up)
    made.configure(CELL)
    return made, still


def records(steps) -> list[Any]:
    return [step.record for step in steps if isinstance(step, Go)]


def job(steps) -> partial:
    (run,) = [step for step in steps if isinstance(step, Run)]
    return cast(partial, run.job)


def test_set_up_mode_moves_at_a_quarter_of_the_speed() -> None:
    full, slow = cycle()[0].motion(), cycle(set_up=True)[0].motion()
    assert full == CELL.arm.motion()
    assert slow.travel_speed == pytest.approx(0.25 * full.travel_speed)
    assert slow.near_speed == pytest.approx(0.25 * full.near_speed)


def test_a_tap_begins_when_the_arm_is_free_and_ends_with_its_command() -> None:
    made, still = cycle()
    still.promise(HoldStill.Request(tap_id=6, duration=0.7), at(START))
    steps = list(made.begin(TAP, at(START)))
    assert records(steps) == [Placing(tap_id=7, tap=TAP)]
    words = job(steps).keywords
    assert (words["tip"], words["expiry"]) == (TAP.strike, TAP.expiry)
    assert words["not_before"] == START + 0.7


@pytest.mark.parametrize("complete", [True, False])
def test_only_a_complete_motion_places_the_striker(complete: bool) -> None:
    made, _ = cycle()
    end = MotionEnd(complete, Reading(True, JOINTS, False, START))
    steps = list(made.placed(Placing(tap_id=7, tap=TAP), end, at(START)))
    if complete:
        assert records(steps) == [SERVED] and len(steps) == 1
    else:
        assert records(steps) == [Leaving(tap_id=7, since=START, scene=TAP.scene)]
        assert isinstance(steps[-1], Abandon), "no job of the tap goes on"


@pytest.mark.parametrize(
    ("homed", "moving", "share", "axis", "stays"),
    [
        (True, False, 0.0, "shoulder", True),
        (False, False, 0.0, "shoulder", False),
        (True, True, 0.0, "shoulder", False),
        *((True, False, 0.99, axis, True) for axis in Joints._fields),
        *((True, False, -1.01, axis, False) for axis in Joints._fields),
        *((True, False, 1.01, axis, False) for axis in Joints._fields),
    ],
)
def test_an_arm_in_position_stays_within_twice_its_tolerance(homed, moving, share, axis, stays):
    made, _ = cycle()
    one = CELL.arm.tolerance_quill if axis == "quill" else CELL.arm.tolerance_angle
    joints = JOINTS._replace(**{axis: getattr(JOINTS, axis) + share * 2 * one})
    checked = made.checked(replace(SERVED, deviating=2), Reading(homed, joints, moving, START))
    assert checked == replace(SERVED, deviating=0 if stays else 3)


@pytest.mark.parametrize(("later", "ends"), [(0.99, False), (1.01, True)])
def test_an_expired_tap_is_given_up(later: float, ends: bool) -> None:
    made, _ = cycle()
    now = at(START + later)
    found = records(made.check_expiry(SERVED, now))
    assert found == ([Leaving(tap_id=7, since=now.steady, scene=TAP.scene)] if ends else [])
    assert not records(made.check_expiry(Placing(tap_id=7, tap=TAP), at(START + 9.0)))
    assert not records(made.check_expiry(None, at(START + 9.0)))


@pytest.mark.parametrize(("later", "leaves"), [(0.5, False), (0.64, False), (0.66, True)])
def test_the_arm_leaves_shortly_before_its_promise_ends(later: float, leaves: bool) -> None:
    """The job reads the joints first, then waits for the end of the promise itself."""
    made, still = cycle()
    still.promise(HoldStill.Request(tap_id=7, duration=0.7), at(START))
    left = Leaving(tap_id=7, since=START, scene=TAP.scene)
    steps = list(made.leave_when_free(left, at(START + later)))
    assert records(steps) == ([Withdrawing(tap_id=7, scene=TAP.scene)] if leaves else [])
    if leaves:
        assert job(steps).keywords["not_before"] == START + 0.7
        assert job(steps).keywords["free_at"](at(START)) == START + 0.7
    assert not list(made.leave_when_free(SERVED, at(START + 9.0)))


def test_the_arm_does_not_leave_a_charged_striker() -> None:
    made, still = cycle()
    still.on_tapper_state(TapperState(state=TapperState.CHARGED, tap_id=7), 7, True, at(START))
    left = Leaving(tap_id=7, since=START, scene=None)
    assert not list(made.leave_when_free(left, at(START + 0.69)))
    assert list(made.leave_when_free(left, at(START + 0.71)))


def test_a_second_withdrawal_ends_at_the_park_pose() -> None:
    made, _ = cycle()
    left = Leaving(tap_id=7, since=START, scene=TAP.scene)
    assert records(made.withdraw_again(left)) == [replace(left, scene=None)]
    for scene in (TAP.scene, None):
        away = Withdrawing(tap_id=7, scene=scene)
        then = replace(away, then_park=scene is not None)
        assert records(made.withdraw_again(away)) == [then]
    for record in (None, SERVED, Placing(tap_id=7, tap=TAP)):
        assert not list(made.withdraw_again(record))


def test_a_cleared_view_belongs_to_no_tap_and_a_parked_arm_to_its_own() -> None:
    made, _ = cycle()
    cleared = list(made.clear_view((0.0, 0.0, 0.9), at(START)))
    assert records(cleared) == [Withdrawing(tap_id=0, scene=None)]
    assert records(made.park(7, at(START))) == [Withdrawing(tap_id=7, scene=None)]
    assert job(cleared).keywords["not_before"] in (START, -math.inf)
