"""A confirmation remains valid for a tap that is nearly the same, and for no other."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.logic.confirmation import (
    HOLDS_S,
    OBJECT_M,
    OBJECT_RAD,
    STRIKE_M,
    STRIKE_RAD,
    Confirmations,
)
from tapping_cell.logic.task import Shot, Task
from tapping_cell.se2 import Pose

POSE = Pose(0.05, -0.02, 1.0)
SPEED = 0.4
AT = 100.0


def shot(
    before: Pose = POSE,
    strike: Pose = POSE,
    predicted: Pose = POSE,
    speed: float = SPEED,
    object_id: str = "disk",
    tapper: str = "tapper",
) -> Shot:
    plan = SimpleNamespace(strike_pose=strike, striker_speed=speed, tapper=tapper)
    made = SimpleNamespace(
        number=3,
        object_id=object_id,
        before=before,
        strike=SimpleNamespace(plan=plan, predicted=predicted),
        asked_again="",
    )
    return cast(Shot, made)


def confirmed() -> Confirmations:
    made = Confirmations(ask=True)
    made.confirm(shot(), AT)
    return made


@given(
    direction=st.floats(0.0, math.tau),
    share=st.floats(0.0, 2.0).filter(lambda share: abs(share - 1.0) > 1e-3),
    turned=st.booleans(),
    sign=st.sampled_from([-1.0, 1.0]),
    which=st.sampled_from(["before", "strike", "predicted"]),
)
def test_it_is_valid_for_poses_within_the_limits(direction, share, turned, sign, which):
    distance, angle = (OBJECT_M, OBJECT_RAD) if which == "before" else (STRIKE_M, STRIKE_RAD)
    if turned:
        pose = Pose(POSE.x, POSE.y, POSE.theta + sign * share * angle)
    else:
        step = share * distance
        x, y = POSE.x + step * math.cos(direction), POSE.y + step * math.sin(direction)
        pose = Pose(x, y, POSE.theta)
    planned = shot(**{which: pose})
    holds, said = confirmed().holds(planned, AT + 1.0)
    assert holds == (share < 1.0) and said
    assert bool(planned.asked_again) == (not holds)


@pytest.mark.parametrize("share", [-0.051, -0.049, 0.049, 0.051])
def test_it_is_valid_for_speeds_that_differ_by_less_than_5_percent(share: float) -> None:
    planned = shot(speed=SPEED * (1.0 + share))
    holds, said = confirmed().holds(planned, AT)
    assert holds == (abs(share) < 0.05)
    assert holds or f"from 400 to {400 * (1 + share):.0f} mm/s" in said


@pytest.mark.parametrize(
    ("planned", "later", "word"),
    [
        (shot(), HOLDS_S - 0.1, ""),
        (shot(), HOLDS_S + 0.1, "20 s old"),
        (shot(object_id="square"), 0.0, "another object"),
        (shot(tapper="south"), 0.0, "another object or tapper"),
    ],
)
def test_it_ends_with_its_time_and_for_another_object_or_tapper(planned, later, word):
    given_ = confirmed()
    holds, said = given_.holds(planned, AT + later)
    assert holds == (not word) and word in said
    # A confirmation that has ended is not valid again, not even for the confirmed tap.
    assert given_.holds(shot(), AT)[0] == holds


def test_a_tap_that_was_refused_is_asked_for_again_with_the_first_reason() -> None:
    given_ = confirmed()
    given_.withdraw("the arm is elsewhere")
    given_.withdraw("a later reason")
    holds, said = given_.holds(shot(), AT)
    assert not holds and "the arm is elsewhere" in said and "later" not in said


def test_nothing_is_confirmed_before_an_answer_or_after_the_tap() -> None:
    given_ = Confirmations(ask=True)
    given_.withdraw("no tap was confirmed")
    assert given_.holds(shot(), AT) == (False, "")
    given_.confirm(shot(), AT)
    given_.forget()
    assert given_.holds(shot(), AT) == (False, "")


def task(ask: bool) -> Task:
    return cast(Task, SimpleNamespace(ask=ask))


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("goal", [None, task(True), task(False)])
def test_a_person_is_asked_if_the_cell_or_the_goal_wants_it(own, goal):
    made = Confirmations(own)
    assert made.always == own
    assert made.asks(goal) == (own or bool(goal and goal.ask))
    made.change(not own)
    assert made.always == (not own)


def test_a_resumed_goal_is_asked_for_as_before_the_crash_until_the_next_goal() -> None:
    made = Confirmations(ask=False)
    for always, resumed, asks in ((True, True, True), (True, False, False), (False, True, False)):
        made.resume(always)
        made.begin(resumed)
        assert made.always == asks and made.asks(task(False)) == asks
    assert not made.asks(None)
    made.resume(True)
    assert not made.asks(None), "the next goal is not resumed"
    made.change(False)
    assert not made.always, "somebody has switched it off"
