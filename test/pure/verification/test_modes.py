"""Set-up mode and the confirmation of taps in simulated time: their invariants detect violations,
and goals are reached."""

from __future__ import annotations

import pytest

from tapping_cell.messages import ArmState, ConfirmTap, PlannedTap, PlanState, TapCommand
from tapping_cell.verification.campaign import run_trial
from tapping_cell.verification.confirmation_invariants import ConfirmationChecker
from tapping_cell.verification.faults import Mix
from tapping_cell.verification.people import KEY, SWITCH
from tapping_cell.verification.physical_cell import Release
from tapping_cell.verification.set_up_invariants import SetUpChecker
from tapping_cell.verification.table_trial import has_several_objects
from tapping_cell.verification.trial import Trial

BOTH = (KEY, SWITCH)
SET_UP, ASK = Mix(set_up=True), Mix(ask=True)
JOG = b"$J=G91 X0.5 F5\n"


@pytest.fixture
def trial() -> Trial:
    made = Trial(seed=21, faults=False, mix=SET_UP)
    made.bring_up()
    made.scheduler.run(made.scheduler.now + 2.0)
    assert made.checker.violations == []
    return made


def checker_of(trial: Trial) -> SetUpChecker:
    assert trial.checker.set_up is not None
    return trial.checker.set_up


def found(trial: Trial) -> set[str]:
    return {violation.name for violation in trial.checker.violations}


def test_the_same_seed_gives_the_same_trace() -> None:
    mix = Mix(set_up=True, ask=True)
    first, second = (run_trial(7, 2, trace=True, mix=mix) for _ in range(2))
    assert first.trace == second.trace


@pytest.mark.parametrize(("mix", "seed"), [(SET_UP, 3), (ASK, 4), (Mix(set_up=True, ask=True), 5)])
def test_goals_are_reached_without_faults(mix: Mix, seed: int) -> None:
    report = Trial(seed, faults=False, mix=mix).run(3)
    assert report.violations == []
    assert 0 in {outcome.code for outcome in report.outcomes}


@pytest.mark.parametrize(
    "mix",
    [
        Mix(("enabling device released",), set_up=True),
        Mix(("ask changed",), ask=True),
    ],
)
def test_every_run_has_the_chosen_mode_whatever_its_seed(mix: Mix) -> None:
    seed = next(filter(has_several_objects, range(100)))
    report = run_trial(seed, 2, mix=mix)
    assert report.violations == []
    assert report.faults.keys() & set(mix.only)


@pytest.mark.parametrize("mix", [SET_UP, ASK])
def test_nothing_unsafe_happens_under_random_faults(mix: Mix) -> None:
    assert run_trial(1000, 4, mix=mix).violations == []


def test_a_motion_while_the_device_is_held_is_not_a_violation_of_set_up_mode(trial: Trial) -> None:
    trial.physical.arm_board.receive(JOG, trial.scheduler.now)
    trial.physical.arm_line.schedule()
    trial.scheduler.run(trial.scheduler.now + 2.0)
    assert found(trial) == {"moved unasked"}


@pytest.mark.parametrize("silent", [False, True])
def test_a_motion_without_the_device_is_detected(trial: Trial, silent: bool) -> None:
    trial.release_enabling(BOTH, silent, 60.0)
    trial.scheduler.run(trial.scheduler.now + 1.0)
    trial.physical.arm_board.receive(JOG, trial.scheduler.now)
    trial.physical.arm_line.schedule()
    trial.scheduler.run(trial.scheduler.now + 1.0)
    assert "moved without enabling" in found(trial)


def test_a_motion_that_goes_on_without_the_device_is_detected(trial: Trial) -> None:
    """The arm's node is idle, so it does not stop a motion that it has not begun."""
    trial.physical.arm_board.receive(JOG, trial.scheduler.now)
    trial.physical.arm_line.schedule()
    moved = trial.scheduler.now + 1.0
    trial.scheduler.run(moved, lambda: trial.physical.moving(trial.scheduler.now))
    trial.release_enabling(BOTH, False, 60.0)
    trial.scheduler.run(trial.scheduler.now + 3.0)
    assert "moves on without enabling" in found(trial)


def test_work_that_begins_without_the_device_is_detected(trial: Trial) -> None:
    checker = checker_of(trial)
    checker.on_state(ArmState(state=ArmState.HOMING))
    assert found(trial) == set()
    checker.on_state(ArmState(state=ArmState.IDLE))
    trial.release_enabling(BOTH, False, 60.0)
    trial.scheduler.run(trial.scheduler.now + 1.0)
    checker.on_state(ArmState(state=ArmState.HOMING))
    assert found(trial) == {"work without enabling"}


def test_a_check_that_is_passed_without_the_device_is_detected(trial: Trial) -> None:
    checker = trial.checker.set_up
    assert checker is not None
    checker.on_asked("charge", None)
    assert found(trial) == set()
    trial.release_enabling(BOTH, False, 60.0)
    trial.scheduler.run(trial.scheduler.now + 0.7)
    checker.on_asked("charge", (910, "released"))
    assert found(trial) == set()
    checker.on_asked("charge", None)
    assert found(trial) == {"work without enabling"}


def test_a_move_that_is_too_fast_is_detected(trial: Trial) -> None:
    joints = trial.physical.joints(0.0)
    trial.checker.check_start(joints, 0.25)
    assert found(trial) == set()
    trial.checker.check_start(joints, 0.26)
    assert found(trial) == {"too fast for set-up"}


def release_of(trial: Trial, energy: float) -> Release:
    now = trial.scheduler.now
    tip, height = trial.physical.tip(now)
    joints, pose = trial.physical.joints(now), trial.physical.object_pose(now)
    return Release(1, energy, now, joints, False, tip, height, pose)


def test_a_shot_without_the_device_is_detected(trial: Trial) -> None:
    checker = checker_of(trial)
    trial.release_enabling(BOTH, False, 60.0)
    trial.scheduler.run(trial.scheduler.now + 0.7)
    checker.check_release(release_of(trial, 0.001))
    assert found(trial) == {"fired without enabling"}


def test_too_much_energy_without_the_switch_is_detected(trial: Trial) -> None:
    checker = checker_of(trial)
    checker.on_device("tapper_trigger", KEY, True, checker.scheduler.now)
    checker.on_switch(True)
    checker.check_release(release_of(trial, 0.02))
    assert found(trial) == set()
    checker.on_switch(False)
    trial.scheduler.run(trial.scheduler.now + 0.05)
    checker.check_release(release_of(trial, 0.005))
    assert found(trial) == set()
    checker.check_release(release_of(trial, 0.006))
    assert found(trial) == {"too much energy for set-up"}


class Confirmations:
    """A checker whose planner asks before every tap and has proposed tap 1."""

    def __init__(self) -> None:
        self.trial = Trial(seed=22, faults=False)
        self.found: list[str] = []
        self.checker = ConfirmationChecker(
            self.trial.scheduler,
            self.trial.physical,
            lambda name, _: self.found.append(name),
            asks_from_start=True,
        )
        self.propose(1)

    def propose(self, tap_id: int) -> None:
        planned = PlannedTap(tap_id=tap_id, striker_speed=0.3)
        self.checker.on_plan_state(PlanState(state=PlanState.CONFIRMING, planned_tap=planned))

    def answer(self, tap_id: int, confirm: bool = True) -> None:
        request = ConfirmTap.Request(tap_id=tap_id, confirm=confirm)
        self.checker.on_call(request)
        self.checker.on_answer(request, ConfirmTap.Response(accepted=True))

    def tap(self, tap_id: int, speed: float = 0.3, x: float = 0.0) -> list[str]:
        command = TapCommand(tap_id=tap_id, striker_speed=speed)
        command.object_pose.position.x = x
        self.checker.on_tap(command)
        return self.found


@pytest.fixture
def asked() -> Confirmations:
    return Confirmations()


def test_a_tap_that_nobody_confirmed_is_detected(asked: Confirmations) -> None:
    assert asked.tap(1) == ["tap not confirmed"]


def test_a_confirmed_tap_and_a_nearly_equal_one_are_no_violation(asked: Confirmations) -> None:
    asked.answer(1)
    assert asked.tap(1) == []
    assert asked.tap(2, speed=0.31, x=0.0004) == []


@pytest.mark.parametrize(("speed", "x"), [(0.33, 0.0), (0.3, 0.0006)])
def test_a_confirmation_of_a_different_tap_is_detected(
    asked: Confirmations, speed: float, x: float
) -> None:
    asked.answer(1)
    assert asked.tap(2, speed, x) == ["tap not confirmed"]


def test_an_outdated_confirmation_is_detected(asked: Confirmations) -> None:
    asked.answer(1)
    asked.trial.scheduler.run(20.1)
    assert asked.tap(2) == ["tap not confirmed"]


def test_a_confirmation_for_a_second_shot_is_detected(asked: Confirmations) -> None:
    asked.answer(1)
    asked.trial.physical.releases.append(release_of(asked.trial, 0.001))
    assert asked.tap(2) == ["tap not confirmed"]


def test_a_tap_after_its_rejection_is_detected(asked: Confirmations) -> None:
    asked.answer(1, confirm=False)
    asked.checker.on_call(ConfirmTap.Request(tap_id=1, confirm=True))
    assert asked.tap(1) == ["rejected tap"]


def test_an_answer_for_another_tap_is_detected(asked: Confirmations) -> None:
    asked.propose(2)
    asked.answer(1)
    assert asked.found == ["answer for another tap"]


def test_a_proposed_tap_needs_its_answer_also_after_a_change_of_ask(asked: Confirmations) -> None:
    asked.checker.on_asks(False)
    assert asked.tap(7) == []
    assert asked.tap(1) == ["tap not confirmed"]


def test_a_goal_and_its_resumption_demand_confirmations(asked: Confirmations) -> None:
    asked.checker.asks_from_start = False
    asked.checker.on_asks(False)
    asked.checker.asking_goals.add(3)
    asked.checker.on_goal_begun(3, resumed=False)
    assert asked.tap(7) == ["tap not confirmed"]
    asked.checker.on_goal_begun(4, resumed=False)
    assert asked.tap(8) == ["tap not confirmed"]
    asked.checker.on_asks(True)
    asked.checker.on_planner_ended()
    asked.checker.on_goal_begun(4, resumed=True)
    assert asked.tap(9) == ["tap not confirmed"] * 2
