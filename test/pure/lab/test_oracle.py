"""Each invariant of the oracle is violated by a defect, and not by what is allowed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from lab.campaign import trial_of
from lab.faults.faults import Mix
from lab.oracle.confirmation import ConfirmationOracle
from lab.oracle.set_up import SetUpOracle
from lab.trial import Trial
from lab.virtual_cell.fixed_cell import FixedRelease
from lab.virtual_cell.people import KEY, SWITCH
from lab.virtual_cell.physical_cell import Release
from lab.virtual_cell.scheduler import Scheduler
from lab.virtual_cell.table_cell import PhysicalTable, TableRelease
from tapping_cell.logic.poses import from_message, to_message
from tapping_cell.messages import (
    ArmState,
    Bool,
    ConfirmTap,
    HoldStill,
    PlannedTap,
    PlanState,
    PositionObject,
    TapCommand,
    TapperState,
)
from tapping_cell.se2 import Pose

JOG = b"$J=G91 X0.5 F500\n"
SLOW_JOG = b"$J=G91 X0.5 F5\n"


def found(trial: Trial) -> set[str]:
    """Return the names of the violations, and forget them."""
    names = {violation.name for violation in trial.oracle.violations}
    trial.oracle.violations.clear()
    return names


def jog(trial: Trial, line: bytes = JOG, lasting: float = 1.0) -> None:
    """Move the arm by a command that goes directly to the controller, as no node commands it."""
    trial.physical.arm_board.receive(line, trial.scheduler.now)
    trial.physical.arm_line.schedule()
    trial.scheduler.run(trial.scheduler.now + lasting)


@pytest.fixture
def trial() -> Trial:
    made = Trial(seed=21, faults=False)
    made.bring_up()
    made.scheduler.run(made.scheduler.now + 2.0)
    return made


# Motion


def test_an_unrequested_motion_is_detected(trial: Trial) -> None:
    jog(trial)
    # The node does not know of the motion, and so reports a clear view.
    assert found(trial) == {"moved unasked", "false view"}


@pytest.mark.parametrize(
    "event",
    [
        lambda trial: trial.kill("scara_arm", 60.0),
        lambda trial: trial.shut_down("scara_arm", 60.0),
        lambda trial: trial.call_stop("scara_arm"),
        lambda trial: trial.press_emergency_stop(60.0),
    ],
    ids=["kill", "shut down", "stop", "press"],
)
def test_a_motion_after_a_crash_or_a_stop_is_detected(
    trial: Trial, event: Callable[[Trial], None]
) -> None:
    event(trial)
    trial.scheduler.run(trial.scheduler.now + 1.0)
    assert found(trial) == set()
    jog(trial)
    assert "moved by itself" in found(trial)


@pytest.mark.parametrize("node", ["kill", "stop"])
def test_a_motion_requested_by_a_person_is_allowed(trial: Trial, node: str) -> None:
    if node == "kill":
        trial.kill("scara_arm", 60.0)
    else:
        trial.call_stop("scara_arm")
    trial.scheduler.run(trial.scheduler.now + 61.0)
    trial.recover()
    assert trial.oracle.motion_allowed
    assert found(trial) == set()


def test_a_clear_that_a_frozen_arm_handles_after_the_release_is_allowed(trial: Trial) -> None:
    """The arm receives the stop, its release and the request to clear at once."""
    trial.freeze("scara_arm", 1.7)
    trial.press_emergency_stop(0.9)
    trial.scheduler.run(trial.scheduler.now + 20.0)
    trial.recover()
    assert found(trial) == set()


def test_a_stop_that_is_cleared_while_it_is_pressed_is_detected(trial: Trial) -> None:
    trial.network.publish("panel", "emergency_stop", Bool(data=True))
    trial.scheduler.run(trial.scheduler.now + 1.0)
    trial.oracle.on_cleared("tapper_trigger", asked=False)
    assert found(trial) == set()
    trial.oracle.on_cleared("tapper_trigger", asked=True)
    assert found(trial) == {"cleared while pressed"}


def test_a_promise_that_is_broken_is_detected(trial: Trial) -> None:
    oracle, now = trial.oracle, trial.scheduler.now
    oracle.on_publish("scara_arm", "arm_state", ArmState(state=ArmState.IN_POSITION, tap_id=3))
    granted = HoldStill.Response(granted=True)
    oracle.on_answer("scara_arm", HoldStill.Request(tap_id=3, duration=2.0), granted)
    assert oracle.promises[3] == now + 2.0
    oracle.on_answer("scara_arm", HoldStill.Request(tap_id=3, duration=0.1), granted)
    assert oracle.promises[3] == now + 2.0, "a shorter request does not end it"
    oracle.ask_to_move()
    jog(trial)
    assert "broken promise" in found(trial)
    oracle.on_answer("scara_arm", HoldStill.Request(tap_id=4, duration=2.0), granted)
    assert found(trial) == {"empty promise"}


# Releases


@pytest.fixture(scope="module")
def fired() -> Trial:
    made = Trial(seed=21, faults=False)
    assert made.run(1).violations == []
    return made


DEFECTS: dict[str, Callable[[Release], Release]] = {
    "arm moving": lambda good: replace(good, moving=True),
    "no such tap": lambda good: replace(good, shot=good.shot + 1000),
    "arm elsewhere": lambda good: replace(good, tip=good.tip @ Pose(0.003, 0.0, 0.0)),
    "too much energy": lambda good: replace(good, energy=1.05 * good.energy),
    "outside the promise": lambda good: replace(good, time=good.time + 1.0),
    "object elsewhere": lambda good: replace(
        good, object_pose=good.object_pose @ Pose(0.005, 0.0, 0.0)
    ),
    "camera silent": lambda good: replace(good, time=good.time + 60.0),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_a_release_with_a_defect_is_detected(fired: Trial, name: str) -> None:
    good = fired.physical.releases[0]
    fired.oracle._check_release(DEFECTS[name](good), [])
    assert name in found(fired)


def test_a_second_shot_of_a_tap_and_one_after_a_stop_or_its_end_are_detected(fired: Trial) -> None:
    good, oracle = fired.physical.releases[0], fired.oracle
    oracle._check_release(good, [good])
    assert "fired twice" in found(fired)
    oracle.stopped_at["tapper_trigger"] = good.time - 0.2
    oracle._ended[good.shot] = good.time - 0.2
    oracle._check_release(good, [])
    assert {"after a stop", "after its end"} <= found(fired)
    oracle.stopped_at.clear()
    oracle._ended.clear()
    oracle.on_invalid(good.shot, "frame", arm_refuses=True)
    oracle._check_release(good, [])
    assert "executed an invalid command" in found(fired)
    oracle.invalid.clear()


def test_a_shot_against_what_the_tapper_saw_is_detected(fired: Trial) -> None:
    good, oracle = fired.physical.releases[0], fired.oracle
    command = oracle.commands[good.shot]
    sight, planned = oracle.sight(""), from_message(command.object_pose)
    sight.received.clear()
    sight.received.append((good.time - 0.2, planned @ Pose(0.0, 0.0, 0.2)))
    oracle._check_scene(good, command, good.object_pose)
    assert found(fired) == {"against what it saw"}
    sight.received.append((good.time - 0.01, planned))
    oracle._check_scene(good, command, good.object_pose)
    assert found(fired) == set()


def test_a_false_report_of_the_tapper_is_detected(fired: Trial) -> None:
    shot, oracle = fired.physical.releases[0].shot, fired.oracle
    report = TapperState(state=TapperState.SAFE, tap_id=shot, outcome=TapperState.NOT_FIRED)
    oracle.on_publish("tapper_trigger", "tapper_state", report)
    assert found(fired) == {"other outcome"}
    oracle.at_the_end()
    assert found(fired) == {"false report"}
    report = TapperState(tap_id=shot + 1000, outcome=TapperState.FIRED)
    oracle.on_publish("tapper_trigger", "tapper_state", report)
    assert found(fired) == {"false report"}


# Goals


def test_a_false_claim_and_a_goal_of_nobody_are_detected(trial: Trial) -> None:
    oracle, true = trial.oracle, trial.physical.object_pose(trial.scheduler.now)
    near, far = true @ Pose(0.0005, 0.0, 0.0), true @ Pose(0.0015, 0.0, 0.0)
    for goal, names in ((near, set()), (far, {"false claim"})):
        request = oracle.on_goal_sent({trial.cell.object.name: goal}, (0.001, 0.02))
        oracle.check_result(request, PositionObject.Result(), 0)
        assert found(trial) == names
    oracle.check_result(request, PositionObject.Result(error_code=1, taps=1), 0)
    assert found(trial) == {"false count"}
    plan = PlanState(state=PlanState.PLANNING)
    plan.goal.pose = to_message(Pose(0.05, 0.05, 0.0))
    oracle.on_publish("tap_planner", "plan_state", plan)
    assert found(trial) == {"goal of nobody"}
    oracle.on_publish("tap_planner", "plan_state", PlanState(state=PlanState.IDLE))
    command = TapCommand(request=TapCommand.TAP, tap_id=1)
    oracle.on_publish("tap_planner", "tap_command", command)
    assert found(trial) == {"tap without a goal"}


# Several objects, fixed tappers


def test_another_object_in_the_way_is_detected() -> None:
    trial = trial_of(1, Mix(several=True), faults=False)
    assert trial.run(2).violations == []
    oracle, table = trial.oracle, trial.physical
    assert isinstance(table, PhysicalTable)
    good = next(one for one in trial.physical.releases if one.shot in oracle.planners)
    assert isinstance(good, TableRelease)
    command = oracle.commands[good.shot]
    name = command.object_id or oracle.own
    other = next(each for each in good.poses if each != name)
    late = replace(good, met=other, time=good.time + 100.0)
    oracle._check_scene(late, command, good.poses[name])
    assert "other object struck" in found(trial)
    tip = from_message(command.strike_pose)
    behind = tip @ Pose(-0.5 * trial.cell.file.tapper.tool_length, 0.0, 0.0)
    outline = tuple((behind.x + dx, behind.y + dy) for dx, dy in ((0.02, 0), (0, 0.02), (-0.02, 0)))
    table.unknown = (outline,)
    oracle.after_event()
    oracle._check_scene(replace(good, time=trial.scheduler.now + 20.0), command, good.poses[name])
    assert "tool in an unknown object" in found(trial)


def test_a_second_striker_is_detected() -> None:
    trial = trial_of(1, Mix(fixed=True), faults=False)
    assert trial.run(1).violations == []
    good = trial.physical.releases[0]
    assert isinstance(good, FixedRelease)
    defects = {
        "second striker": replace(good, others_out=("west",)),
        "wrong tapper": replace(good, tapper="nobody"),
        "object in motion": replace(good, object_at_rest=False),
    }
    for name, release in defects.items():
        command = trial.oracle.commands[good.shot]
        trial.oracle.check_place(release, command)
        trial.oracle._check_scene(release, command, good.object_pose)
        assert name in found(trial)


# Set-up mode and confirmation


@pytest.fixture
def set_up() -> Trial:
    made = Trial(seed=21, faults=False, mix=Mix(set_up=True))
    made.bring_up()
    made.scheduler.run(made.scheduler.now + 2.0)
    assert found(made) == set()
    return made


def enabling_of(trial: Trial) -> SetUpOracle:
    assert trial.enabling is not None
    return trial.enabling


def test_a_motion_while_the_device_is_held_is_allowed(set_up: Trial) -> None:
    jog(set_up, SLOW_JOG, 2.0)
    assert found(set_up) == {"moved unasked", "false view"}


@pytest.mark.parametrize("silent", [False, True])
def test_a_motion_without_the_device_is_detected(set_up: Trial, silent: bool) -> None:
    set_up.release_enabling((KEY, SWITCH), silent, 60.0)
    set_up.scheduler.run(set_up.scheduler.now + 1.5)
    jog(set_up, SLOW_JOG)
    assert "moved without enabling" in found(set_up)


def test_a_shot_without_the_device_or_too_strong_is_detected(set_up: Trial) -> None:
    enabling, now = enabling_of(set_up), set_up.scheduler.now
    tip, height = set_up.physical.tip(now)
    shot = Release(1, 0.02, now, set_up.physical.joints(now), False, tip, height, tip)
    enabling.on_switch(True)
    enabling.check_release(shot)
    assert found(set_up) == set()
    enabling.on_switch(False)
    enabling.on_key("tapper_trigger", held=True)
    enabling.check_release(replace(shot, time=now + 0.1))
    assert found(set_up) == {"too much energy for set-up"}
    enabling.check_release(replace(shot, time=now + 0.7, energy=0.001))
    assert found(set_up) == {"fired without enabling"}
    enabling.check_speed(0.25)
    assert found(set_up) == set()
    enabling.check_speed(0.26)
    assert found(set_up) == {"too fast for set-up"}


class Confirmations:
    """A planner that asks before every tap and has proposed tap 1."""

    def __init__(self) -> None:
        self.found: list[str] = []
        self.scheduler = Scheduler()
        self.oracle = ConfirmationOracle(
            self.scheduler, lambda name, _: self.found.append(name), asks=True
        )
        planned = PlannedTap(tap_id=1, striker_speed=0.3)
        self.oracle.on_plan_state(PlanState(state=PlanState.CONFIRMING, planned_tap=planned))

    def answer(self, confirm: bool) -> None:
        request = ConfirmTap.Request(tap_id=1, confirm=confirm)
        self.oracle.on_call(request)
        self.oracle.on_answer(request, ConfirmTap.Response(accepted=True))

    def tap(self, tap_id: int, speed: float = 0.3, x: float = 0.0) -> list[str]:
        command = TapCommand(tap_id=tap_id, striker_speed=speed)
        command.object_pose.position.x = x
        self.oracle.on_tap(command)
        return self.found


@pytest.mark.parametrize(
    ("tap_id", "speed", "x", "later", "names"),
    [
        (1, 0.3, 0.0, 0.0, []),
        (2, 0.31, 0.0004, 19.0, []),
        (2, 0.33, 0.0, 0.0, ["tap not confirmed"]),
        (2, 0.3, 0.0006, 0.0, ["tap not confirmed"]),
        (2, 0.3, 0.0, 20.1, ["tap not confirmed"]),
    ],
)
def test_a_confirmation_covers_nearly_equal_taps_for_a_while(
    tap_id: int, speed: float, x: float, later: float, names: list[str]
) -> None:
    asked = Confirmations()
    asked.answer(confirm=True)
    asked.scheduler.run(later)
    assert asked.tap(tap_id, speed, x) == names


def test_a_tap_that_nobody_confirmed_or_somebody_rejected_is_detected() -> None:
    assert Confirmations().tap(1) == ["tap not confirmed"]
    asked = Confirmations()
    asked.answer(confirm=False)
    assert asked.tap(1) == ["rejected tap"]
