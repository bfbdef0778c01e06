"""Test that the motion invariants detect forbidden motions.

The test jogs the arm by a command that it sends directly to the emulated controller, so that no
node has commanded the motion.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tapping_cell.logic.poses import to_message
from tapping_cell.messages import ArmState, TapCommand
from tapping_cell.se2 import Pose
from tapping_cell.simulation.fault_layer import Direction, FaultKind, LineFault
from tapping_cell.verification.trial import Trial

JOG = b"$J=G91 X0.5 F500\n"


@pytest.fixture
def trial() -> Trial:
    made = Trial(seed=21, faults=False)
    made.bring_up()
    made.scheduler.run(made.scheduler.now + 2.0)
    return made


def violated_by_a_motion(trial: Trial) -> set[str]:
    """Return the names of the invariants violated by a motion that no node has commanded."""
    trial.scheduler.run(trial.scheduler.now + 1.0)
    assert trial.checker.violations == []
    trial.physical.arm_board.receive(JOG, trial.scheduler.now)
    trial.physical.arm_line.schedule()
    moved = trial.scheduler.now + 1.0
    trial.scheduler.run(moved, lambda: trial.physical.moving(trial.scheduler.now))
    assert trial.physical.moving(trial.scheduler.now)
    trial.scheduler.run(moved)
    return {violation.name for violation in trial.checker.violations}


def kill(trial: Trial) -> None:
    trial.kill("scara_arm", 60.0)


def shut_down(trial: Trial) -> None:
    trial.shut_down("scara_arm", 60.0)


def stop(trial: Trial) -> None:
    trial.call_stop("scara_arm")


def press(trial: Trial) -> None:
    trial.press_emergency_stop(60.0)


@pytest.mark.parametrize("event", [kill, shut_down, stop, press])
def test_a_motion_after_a_crash_or_a_stop_is_detected(
    trial: Trial, event: Callable[[Trial], None]
) -> None:
    event(trial)
    assert "moved by itself" in violated_by_a_motion(trial)


def test_an_unrequested_motion_is_detected(trial: Trial) -> None:
    assert violated_by_a_motion(trial) == {"moved unasked"}


@pytest.mark.parametrize("event", [kill, stop])
def test_a_motion_requested_by_an_operator_is_not_a_violation(
    trial: Trial, event: Callable[[Trial], None]
) -> None:
    event(trial)
    trial.scheduler.run(trial.scheduler.now + 61.0)
    trial.recover()
    assert trial.checker.motion_allowed
    assert trial.checker.violations == []


def test_a_clear_that_a_frozen_arm_handles_after_the_release_is_not_a_violation(
    trial: Trial,
) -> None:
    """The person clears while the emergency stop is still held. The arm receives the stop, its
    release and the clear at once, and is homed by the person."""
    trial.freeze("scara_arm", 1.7)
    trial.press_emergency_stop(0.9)
    trial.scheduler.run(trial.scheduler.now + 20.0)
    trial.recover()
    assert trial.checker.violations == []


def tap_an_object_that_stays_hidden(
    trial: Trial, monkeypatch: pytest.MonkeyPatch, start: Pose, predicted: Pose
) -> None:
    """Let a program command tap 7 from one pose of the object to another, in a cell without nodes
    whose arm hides the object from then on."""
    for process in trial.processes.values():
        process.kill()
    monkeypatch.setattr(trial.physical, "view", lambda time: None)
    command = TapCommand(
        tap_id=7, object_pose=to_message(start), predicted_pose=to_message(predicted)
    )
    trial.checker.on_publish("program", "tap_command", command)
    moving = ArmState(state=ArmState.MOVING, tap_id=7)
    trial.checker.on_publish("scara_arm", "arm_state", moving)


def test_a_refused_command_does_not_hide_that_a_hand_moved_the_object(
    trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The arm leaves the view of the object where its last tap expects it."""
    checker, now = trial.checker, trial.scheduler.now
    place = trial.physical.object_pose(now)
    tap_an_object_that_stays_hidden(trial, monkeypatch, place, place)
    trial.scheduler.run(now + 1.0)
    checker.moved_by_hand = trial.scheduler.now, Pose(0.0, 0.0, 0.0)
    trial.scheduler.run(now + 2.0)
    checker.on_publish("other program", "tap_command", TapCommand(tap_id=0))
    checker.on_publish("scara_arm", "arm_state", ArmState(clear_of_camera=True))
    assert checker.violations == []
    checker.moved_by_hand = None
    checker.on_publish("scara_arm", "arm_state", ArmState())
    checker.on_publish("scara_arm", "arm_state", ArmState(clear_of_camera=True))
    assert {violation.name for violation in checker.violations} == {"false view"}


@pytest.mark.parametrize(("shift", "names"), [(0.0, set()), (0.001, {"false view"})])
def test_a_copied_command_does_not_hide_that_a_hand_moved_the_object(
    trial: Trial, monkeypatch: pytest.MonkeyPatch, shift: float, names: set[str]
) -> None:
    """A program commands tap 8 after a hand has moved the object, with the object pose of tap 7, or
    with a new one."""
    checker, place = trial.checker, trial.physical.object_pose(trial.scheduler.now)
    tap_an_object_that_stays_hidden(trial, monkeypatch, place, place)
    trial.scheduler.run(trial.scheduler.now + 1.0)
    checker.moved_by_hand = trial.scheduler.now, place
    trial.scheduler.run(trial.scheduler.now + 1.0)
    pose = to_message(Pose(place.x + shift, place.y, place.theta))
    copied = TapCommand(tap_id=8, object_pose=pose, predicted_pose=pose)
    checker.on_publish("other program", "tap_command", copied)
    checker.on_publish("scara_arm", "arm_state", ArmState(state=ArmState.MOVING, tap_id=8))
    checker.on_publish("scara_arm", "arm_state", ArmState(clear_of_camera=True))
    assert {violation.name for violation in checker.violations} == names


@pytest.mark.parametrize(("share", "names"), [(1.0, {"false view"}), (2.0, set())])
def test_an_arm_may_hide_an_object_that_moved_much_farther_than_predicted(
    trial: Trial, monkeypatch: pytest.MonkeyPatch, share: float, names: set[str]
) -> None:
    """The planner may have learnt a gain from a shot without full energy (run 35000496). The object
    has moved by ``share`` times the predicted displacement of 20 mm."""
    place = trial.physical.object_pose(trial.scheduler.now)
    start = Pose(place.x - 0.02 * share, place.y, place.theta)
    predicted = Pose(start.x + 0.02, start.y, start.theta)
    tap_an_object_that_stays_hidden(trial, monkeypatch, start, predicted)
    trial.checker.on_publish("scara_arm", "arm_state", ArmState(clear_of_camera=True))
    assert {violation.name for violation in trial.checker.violations} == names


def test_a_refused_expired_command_without_an_id_is_no_violation(trial: Trial) -> None:
    trial.network.publish("other program", "tap_command", TapCommand(request=TapCommand.TAP))
    trial.scheduler.run(trial.scheduler.now + 1.0)
    assert trial.checker.violations == []


def test_a_stop_that_a_vanished_port_cannot_pass_on_is_no_violation(trial: Trial) -> None:
    """The port goes away with the first stop. A stopped node does not use its line, and notices
    this only at the reset."""
    line = trial.physical.tapper_line
    way = Direction.TO_DEVICE
    line.layer.add(LineFault(FaultKind.HANG_UP, way, line.layer.count(way), 1, 0.5))
    trial.call_stop("tapper_trigger")
    trial.scheduler.run(trial.scheduler.now + 30.0)
    assert line.is_open and line.has_vanished
    trial.press_emergency_stop(1.0)
    trial.scheduler.run(trial.scheduler.now + 5.0)
    assert trial.physical.tapper_board.state != "STOPPED"
    trial.recover()
    assert trial.checker.violations == []


@pytest.mark.parametrize("runs", [True, False])
def test_the_tap_of_a_second_planner_needs_that_planner_only(trial: Trial, runs: bool) -> None:
    """The planner has crashed, and one that was started by mistake works on a goal (run 43000720).
    If the second planner counts as ended, its shot is a violation."""
    trial.kill("tap_planner", 60.0)
    trial.start_second("tap_planner", 30.0)
    trial.scheduler.run(trial.scheduler.now + 5.0)
    if not runs:
        trial.checker.second_planner_until = trial.scheduler.now
    trial.send_goal(Pose(0.04, -0.02, 0.3), foreign=True)
    trial.scheduler.run(trial.scheduler.now + 15.0, lambda: bool(trial.physical.releases))
    trial.scheduler.run(trial.scheduler.now + 0.1)
    assert trial.physical.releases
    names = {violation.name for violation in trial.checker.violations}
    assert names == (set() if runs else {"no planner"})
