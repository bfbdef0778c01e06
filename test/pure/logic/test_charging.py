"""The striker is charged while the arm lowers it, and fired only when the arm is at rest."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from logic_parts import alone
from test_permit import CELL, HEIGHT, START, STRIKE, TAP, Pair, at, board, jobs, messages

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic import tapper as tappers
from tapping_cell.logic.clock import to_stamp
from tapping_cell.logic.effects import Call, Effect, JobEnded, RunJob
from tapping_cell.logic.host import Activated, Configured
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.tapper_cycle import LONGEST_CHARGED_S, LONGEST_WAIT_S
from tapping_cell.logic.tapper_jobs import ChargeEnd, Status
from tapping_cell.logic.tapper_states import State
from tapping_cell.messages import ArmState, ErrorCode, ObjectState, TapCommand, TapperState
from tapping_cell.se2 import Pose


def waiting(cell: Cell = CELL) -> tappers.TapperLogic:
    """Return a tapper that has accepted a tap."""
    tapper = tappers.TapperLogic(tappers.TapperOptions())
    tapper.on_lifecycle(Configured(cell, board(BoardState.SAFE)), at(START))
    tapper.on_lifecycle(Activated(), at(START))
    tapper.on_message("tap_command", Pair().command(TapCommand.TAP, at(START)), at(START))
    assert tapper.state is State.WAITING
    return tapper


def arm(
    state: int,
    tip: Pose,
    steady: float,
    tap_id: int = TAP,
    homed: bool = True,
    height: float = HEIGHT,
) -> ArmState:
    message = ArmState(state=state, tap_id=tap_id, homed=homed, tip_pose=to_message(tip, height))
    message.header.stamp = to_stamp(at(steady).ros)
    return message


@pytest.mark.parametrize("request_", [TapCommand.TAP, TapCommand.CLEAR_VIEW])
@pytest.mark.parametrize("active", [True, False])
def test_only_an_active_tapper_serves_taps_and_no_other_request(request_, active):
    tapper = tappers.TapperLogic(tappers.TapperOptions())
    tapper.on_lifecycle(Configured(CELL, board(BoardState.SAFE)), at(START))
    if active:
        tapper.on_lifecycle(Activated(), at(START))
    tapper.on_message("tap_command", Pair().command(request_, at(START)), at(START))
    is_tap = request_ == TapCommand.TAP
    assert (tapper.state is State.WAITING) == (is_tap and active)
    refused = ErrorCode.NOT_ACTIVE if is_tap and not active else ErrorCode.NONE
    assert tapper.error[0] == refused


def charged_while_lowered() -> tuple[tappers.TapperLogic, list[Effect]]:
    tapper = waiting()
    lowers = arm(ArmState.MOVING, STRIKE, START, height=HEIGHT + 0.05)
    made = tapper.on_message("arm_state", lowers, at(START))
    (charge,) = jobs(made)
    end = ChargeEnd(Status(board(BoardState.CHARGED, TAP), 0), True, None)
    return tapper, list(tapper.on_job(JobEnded(charge, end), at(START + 0.3)))


@pytest.mark.parametrize(
    "message",
    [
        arm(ArmState.MOVING, STRIKE @ Pose(0.0, 0.01, 0.0), START),
        arm(ArmState.MOVING, STRIKE @ Pose(0.0, 0.0, 0.2), START),
        arm(ArmState.MOVING, STRIKE, START, tap_id=TAP - 1),
        arm(ArmState.MOVING, STRIKE, START, homed=False),
        arm(ArmState.WITHDRAWING, STRIKE, START),
        arm(ArmState.IDLE, STRIKE, START),
    ],
)
def test_the_striker_is_charged_only_above_its_strike_pose(message: ArmState) -> None:
    tapper = waiting()
    assert jobs(tapper.on_message("arm_state", message, at(START))) == []
    assert tapper.state is State.WAITING


def test_a_tapper_charged_early_asks_when_the_arm_is_in_position() -> None:
    tapper, made = charged_while_lowered()
    assert tapper.state is State.CHARGED
    assert not [effect for effect in made if isinstance(effect, Call)]
    assert tapper.check_firing(START + 0.4, at(START + 0.31)) is not None
    stands = arm(ArmState.IN_POSITION, STRIKE, START + 0.5)
    made = tapper.on_message("arm_state", stands, at(START + 0.5))
    (call,) = [effect for effect in made if isinstance(effect, Call)]
    assert call.service == "hold_still"
    # A further report from the arm causes no second request.
    again = tapper.on_message("arm_state", stands, at(START + 0.51))
    assert not [effect for effect in again if isinstance(effect, Call)]


@pytest.mark.parametrize("off", [Pose(0.0, 0.006, 0.0), Pose(0.0, 0.0, 0.06)])
def test_no_shot_is_fired_if_the_arm_is_in_position_for_another_tap_with_the_same_id(off):
    tapper, _ = charged_while_lowered()
    stands = arm(ArmState.IN_POSITION, STRIKE @ off, START + 0.5)
    made = tapper.on_message("arm_state", stands, at(START + 0.5))
    assert not [effect for effect in made if isinstance(effect, Call)]
    assert tapper.state is State.DISCHARGING


@pytest.mark.parametrize("off", [0.054, 0.0025, -0.0025, math.nan])
def test_no_shot_is_fired_if_the_tip_is_not_at_its_commanded_height(off: float) -> None:
    tapper, _ = charged_while_lowered()
    stands = arm(ArmState.IN_POSITION, STRIKE, START + 0.5, height=HEIGHT + off)
    made = tapper.on_message("arm_state", stands, at(START + 0.5))
    assert not [effect for effect in made if isinstance(effect, Call)]
    assert tapper.state is State.DISCHARGING


def test_a_tapper_charged_early_is_discharged_after_an_arm_timeout() -> None:
    tapper, _ = charged_while_lowered()
    made = tapper.on_tick(at(START + 0.7))
    (job,) = [e.job.name for e in made if isinstance(e, RunJob) and e.job.name != "read"]
    assert job == "discharge"


def test_a_tapper_charged_early_is_discharged_when_the_arm_never_arrives() -> None:
    tapper, _ = charged_while_lowered()
    steady = START + 0.3
    while tapper.state is State.CHARGED:
        steady += 0.1
        tapper.on_message("arm_state", arm(ArmState.MOVING, STRIKE, steady), at(steady))
        assert steady < START + 5.0
    assert tapper.state is State.DISCHARGING
    assert steady > START + LONGEST_CHARGED_S


def test_a_tapper_charged_early_is_discharged_when_the_arm_aborts_the_tap() -> None:
    tapper, _ = charged_while_lowered()
    tapper.on_message("arm_state", arm(ArmState.WITHDRAWING, STRIKE, START + 0.4), at(START + 0.4))
    assert tapper.state is State.DISCHARGING


def waits(seconds: float, *, sees: str = "", height: float = HEIGHT + 0.05) -> tappers.TapperLogic:
    """Return a tapper that was waiting for this time: the arm is silent, unless the tapper sees an
    object of this name, far from its planned pose, while the arm travels."""
    tapper = waiting()
    for step in range(1, 1 + round(seconds / 0.1)):
        steady = START + 0.1 * step
        if sees:
            seen = ObjectState(object_id=sees, visible=True, at_rest=True)
            seen.pose.pose = to_message(Pose(0.1, 0.0, 0.0))
            seen.header.stamp = to_stamp(at(steady).ros)
            tapper.on_message("object_states", alone(seen), at(steady))
            travels = arm(ArmState.MOVING, STRIKE @ Pose(0.1, 0.0, 0.0), steady, height=height)
            tapper.on_message("arm_state", travels, at(steady))
        tapper.on_tick(at(steady))
    return tapper


@pytest.mark.parametrize(
    ("sees", "code"),
    [("", ErrorCode.ARM_SILENT), ("aluminium disk", ErrorCode.OBJECT_MOVED)],
)
def test_what_an_accepted_tap_waits_for_is_published_and_ends_it(sees: str, code: int) -> None:
    def published(tapper: tappers.TapperLogic, seconds: float) -> TapperState:
        made = tapper.on_tick(at(START + seconds))
        return messages(made, "tapper_state")[-1]

    assert published(waits(0.2, sees=sees), 0.2).error_code == ErrorCode.NONE
    shown = published(waits(0.5, sees=sees), 0.5)
    assert (shown.error_code, shown.outcome) == (code, TapperState.NONE)
    ended = published(waits(LONGEST_WAIT_S + 0.5, sees=sees), 5.0)
    assert (ended.error_code, ended.outcome) == (code, TapperState.NOT_FIRED)


def test_an_arm_on_its_way_is_waited_for_in_peace() -> None:
    tapper = waiting()
    for step in range(100):
        steady = START + 0.1 * step
        travels = arm(ArmState.MOVING, STRIKE @ Pose(0.1, 0.0, 0.0), steady)
        made = tapper.on_message("arm_state", travels, at(steady))
        made = [*made, *tapper.on_tick(at(steady))]
        assert messages(made, "tapper_state")[-1].error_code == ErrorCode.NONE
    assert tapper.state is State.WAITING


def test_a_tap_of_an_object_that_the_camera_does_not_know_is_refused_with_both_names() -> None:
    tapper = waits(0.5, sees="aluminium disk")
    tapper.on_message(
        "tap_command", Pair().command(TapCommand.WITHDRAW, at(START + 1)), at(START + 1)
    )
    tap = replace(Pair().command(TapCommand.TAP, at(START + 1)), tap_id=TAP + 1, object_id="bar")
    made = tapper.on_message("tap_command", tap, at(START + 1))
    state = messages(made, "tapper_state")[-1]
    assert state.error_code == ErrorCode.CONFIGURATION_CONFLICT
    assert "'bar'" in state.error_msg and "'aluminium disk'" in state.error_msg
