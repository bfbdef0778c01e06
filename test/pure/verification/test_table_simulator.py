"""Cells with several objects in virtual time with all faults. An inserted defect makes the checks
fail."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from tapping_cell.logic.arrangement import ArrangementTask
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import ArrangeObjects, ErrorCode, ObjectProgress, PlanState
from tapping_cell.se2 import Pose
from tapping_cell.verification.campaign import run_trial
from tapping_cell.verification.faults import Mix
from tapping_cell.verification.table_cell import TableRelease
from tapping_cell.verification.table_faults import OTHERS, TABLE_AT_A_SHOT, TABLE_MAKERS
from tapping_cell.verification.table_invariants import Asked, Told
from tapping_cell.verification.table_trial import (
    SHARE_OF_TABLES,
    TableTrial,
    has_several_objects,
)

MIX = Mix(several=True)


def test_the_seed_selects_the_cells_with_several_objects() -> None:
    share = sum(map(has_several_objects, range(2000))) / 2000
    assert share == pytest.approx(SHARE_OF_TABLES, abs=0.03)


def test_the_same_seed_gives_the_same_trace() -> None:
    first, second = (run_trial(7, 2, trace=True, mix=MIX) for _ in range(2))
    assert first.trace == second.trace
    assert len(first.trace) > 100


def test_without_faults_every_goal_is_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tapping_cell.verification.trial.SHARE_OF_SHORT_LIMITS", 0.0)
    trial = TableTrial(1, faults=False)
    report = trial.run(6)
    assert report.violations == []
    assert {goal.code for goal in report.outcomes} == {ErrorCode.NONE}
    asked = trial.checker.asked.values()
    assert {one.arrangement for one in asked} == {False, True}
    assert {command.object_id for command in trial.checker.commands.values()} >= {"second disk"}


@pytest.mark.parametrize("seed", range(4))
def test_nothing_unsafe_happens_under_random_faults(seed: int) -> None:
    report = run_trial(3000 + seed, 6, mix=MIX)
    assert report.violations == []
    assert len(report.outcomes) == 6


def test_the_invariants_detect_violations() -> None:
    """Modified copies of a real release and of a real command each violate an invariant."""
    trial = TableTrial(1, faults=False)
    assert trial.run(2).violations == []
    checker, own = trial.checker, trial.cell.object.name
    good = next(one for one in trial.physical.releases if one.shot in checker.planners)
    assert isinstance(good, TableRelease)
    command = checker.commands[good.shot]
    name = command.object_id or own
    other = next(each for each in good.poses if each != name)

    def names() -> set[str]:
        found = {violation.name for violation in checker.violations}
        checker.violations.clear()
        return found

    for sight in (checker, *checker.others.values()):
        sight.moved_by_hand = None
    away = Pose(good.poses[name].x + 0.03, good.poses[name].y, 0.0)
    checker._check_scene(replace(good, poses={**good.poses, name: away}), command)
    assert "object elsewhere" in names()
    told = checker.told["object_states"][other]
    checker.told["other_objects"][other] = told
    told.pose, told.since = good.poses[other], good.time - 2.0
    checker._check_scene(replace(good, met=other), command)
    assert "other object struck" in names()
    told.newest, told.seen = from_message(command.strike_pose), trial.scheduler.now
    told.exposed = -math.inf
    checker._goal_begun_at = trial.scheduler.now
    checker._check_basis(good.shot)
    assert {"object not observed", "tip in another object"} <= names()
    # The planner has not seen it since the goal began, but may not regard it as removed yet.
    index = trial.checker.on_goal_sent(good.poses[name], by_topic=False)
    checker.asked[index], checker._goal = Asked({name: good.poses[name]}, arrangement=True), index
    checker.told["object_states"] = {each: Told(pose=here) for each, here in good.poses.items()}
    told = checker.told["object_states"][other]
    told.exposed, told.seen = trial.scheduler.now, trial.scheduler.now - 2.0
    told.received = told.seen
    checker._goal_begun_at = trial.scheduler.now - 1.0
    checker._check_basis(good.shot)
    assert "hidden object ignored" in names()
    told.received = told.seen = -math.inf
    checker._check_basis(good.shot)
    assert "hidden object ignored" not in names()
    checker._own_tap = checker.commands[good.shot]
    checker._tap, checker._waiting = good.shot, (PlanState.PLACING, 0.0, 0.0, 0.0)
    checker._check_others_of_tap("object_states", other, good.poses[other])
    trial.scheduler.run(trial.scheduler.now + 0.2)
    assert "tap not withdrawn" in names()


@pytest.mark.parametrize("avoids", [True, False])
def test_a_planner_that_discards_every_decision_is_detected(
    monkeypatch: pytest.MonkeyPatch, avoids: bool
) -> None:
    """A person lays an unknown object aside during every goal. If the planner does not take it into
    account, every decision about several objects is out of date."""
    monkeypatch.setattr("tapping_cell.verification.trial.SHARE_OF_SHORT_LIMITS", 0.0)
    if not avoids:
        monkeypatch.setattr(ArrangementTask, "avoid", lambda self, obstacles: None)
    trial = TableTrial(1, faults=False)
    choose, aside = trial.next_goal, ((0.18, 0.11), (0.19, 0.11), (0.185, 0.12))

    def next_goal(number: int) -> Pose:
        trial.scheduler.after(0.05, lambda: setattr(trial.physical, "unknown", (aside,)))
        return choose(number)

    monkeypatch.setattr(trial, "next_goal", next_goal)
    report = trial.run(6)
    found = {violation.name for violation in report.violations}
    assert found == set() if avoids else "no decision" in found


@pytest.mark.parametrize(("seconds", "found"), [(20, set()), (22, {"no decision"})])
def test_two_slow_decisions_after_a_long_observation_are_allowed(
    seconds: int, found: set[str]
) -> None:
    """A planner observes for almost 10 s, for example while it waits for the camera's clock. The
    decision then takes 5 s, asks for a further image, and the next decision takes 5 s again."""
    trial = TableTrial(1, faults=False)
    checker, scheduler = trial.checker, trial.scheduler
    for elapsed in range(2 * seconds + 1):
        state = PlanState.LOOKING if elapsed < 20 else PlanState.PLANNING
        checker._check_decisions(PlanState(state=state))
        scheduler.run(scheduler.now + 0.5)
    assert {violation.name for violation in checker.violations} == found


def test_an_arrangement_must_be_where_it_says() -> None:
    trial = TableTrial(1, faults=False)
    trial.bring_up()
    here = trial.physical.pose_of("second disk", trial.scheduler.now)
    goal = Pose(here.x + 0.01, here.y, here.theta)
    index = trial.checker.on_goal_sent(goal, by_topic=False)
    trial.checker.asked[index] = Asked({"second disk": goal}, arrangement=True)
    reached = ObjectProgress(object_id="second disk", state=ObjectProgress.REACHED)
    trial.checker.check_result(index, ArrangeObjects.Result(objects=[reached]), (0.001, 0.02))
    assert "false claim" in {violation.name for violation in trial.checker.violations}


def test_only_the_removal_of_an_object_that_may_move_explains_that_it_is_not_seen() -> None:
    trial = TableTrial(1, faults=False)
    removed = {"other object removed"}
    trial.checker.others["third disk"].removed_until = 20.0
    trial._asked = Asked({"second disk": Pose(0.0, 0.0, 0.0)}, arrangement=True)
    assert not trial._is_explained(ErrorCode.OBJECT_NOT_SEEN, removed)
    assert trial._is_explained(ErrorCode.NO_ARRANGEMENT, removed)
    trial._may_move = ("third disk",)
    assert trial._is_explained(ErrorCode.OBJECT_NOT_SEEN, removed)


def test_the_faults_around_a_shot_are_known() -> None:
    assert set(TABLE_AT_A_SHOT) <= set(TABLE_MAKERS)
    assert set(OTHERS) <= set(TABLE_AT_A_SHOT)
