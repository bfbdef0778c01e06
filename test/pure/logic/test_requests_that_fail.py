"""A request that cannot be served gets an answer, and the goal under way goes on."""

from __future__ import annotations

import math
from typing import Any

import pytest
from test_planner_with_played_devices import FAST, GOAL, Actors

from tapping_cell.logic.arm import ArmLogic, ArmOptions
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import Answer
from tapping_cell.logic.host import Activated, Deactivated, UnansweredRequest
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.logic.planner_states import Placing
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
from tapping_cell.messages import (
    ArrangeObjects,
    ConfirmTap,
    ErrorCode,
    HoldStill,
    ObjectGoal,
    PlanState,
    PoseStamped,
    PositionObject,
    SetBool,
    SingleTap,
    TapCommand,
    Trigger,
)
from tapping_cell.planning import PlanningError
from tapping_cell.se2 import Pose

NOW = Now(100.0, 1_800_000_000_000_000_000)
OTHER = Pose(-0.02, 0.01, 0.1)


def placed(pose: Pose) -> PoseStamped:
    message = PoseStamped(pose=to_message(pose))
    message.header.frame_id = "table"
    return message


def fail(*_: Any) -> None:
    raise ZeroDivisionError("defect")


def arrangement(**tolerance: float) -> ArrangeObjects.Goal:
    return ArrangeObjects.Goal(
        goals=[ObjectGoal(object_id="aluminium disk", goal_pose=placed(OTHER), **tolerance)]
    )


class Clients(Actors):
    """Simulated devices, and two clients: the goal of the first one is under way."""

    def __init__(self) -> None:
        super().__init__()
        self.wait(lambda: self.states, "the planner is up")
        self.run(0.3)
        asked = PositionObject.Goal(goal_pose=placed(GOAL))
        self.first = self.send_action("position_object", asked, 1)
        self.wait(self.taps, "a tap of the first client's goal")

    def send_action(self, name: str, asked: Any, token: int) -> list[Any]:
        answers: list[Any] = []
        self.process.request(name, asked, token, answers.append)
        return answers

    def check_first_goal_is_reached(self) -> None:
        self.wait(lambda: self.first, "the first client's result")
        assert self.first[0].error_code == ErrorCode.NONE
        assert self.reported_errors() == []


@pytest.mark.parametrize(
    ("action", "asked"),
    [
        ("position_object", PositionObject.Goal(goal_pose=placed(OTHER), angle_tolerance=math.pi)),
        ("position_object", PositionObject.Goal(goal_pose=placed(OTHER), position_tolerance=0.2)),
        ("arrange_objects", arrangement(angle_tolerance=math.pi)),
        ("arrange_objects", arrangement(position_tolerance=0.2)),
    ],
)
def test_a_goal_with_too_large_a_tolerance_is_refused_and_the_present_goal_goes_on(action, asked):
    clients = Clients()
    (answer,) = clients.send_action(action, asked, 2)
    assert answer.error_code == ErrorCode.GOAL_BAD_TOLERANCE
    clients.check_first_goal_is_reached()


REQUESTS = [
    ("position_object", "accept", PositionObject.Goal(goal_pose=placed(OTHER))),
    ("arrange_objects", "accept_arrangement", arrangement()),
]


@pytest.mark.parametrize(("action", "method", "asked"), REQUESTS)
@pytest.mark.parametrize(
    ("error", "code"),
    [
        (PlanningError("no plan for this goal"), ErrorCode.COMMAND_INVALID),
        (ZeroDivisionError("no plan for this goal"), ErrorCode.INTERNAL),
    ],
)
def test_a_goal_whose_check_raises_is_refused_and_the_present_goal_goes_on(
    monkeypatch, action, method, asked, error, code
):
    clients = Clients()

    def fail(*_: Any) -> None:
        raise error

    monkeypatch.setattr(clients.process.logic.goals, method, fail)
    (answer,) = clients.send_action(action, asked, 2)
    assert answer.error_code == code and "no plan for this goal" in answer.error_msg
    clients.check_first_goal_is_reached()


@pytest.mark.parametrize(
    ("service", "request_", "failed"),
    [
        ("position_object", PositionObject.Goal(), lambda a: a.error_code == ErrorCode.INTERNAL),
        ("arrange_objects", ArrangeObjects.Goal(), lambda a: a.error_code == ErrorCode.INTERNAL),
        ("single_tap", SingleTap.Goal(), lambda a: a.error_code == ErrorCode.INTERNAL),
        ("confirm_tap", ConfirmTap.Request(), lambda a: a.error_code == ErrorCode.INTERNAL),
        ("ask", SetBool.Request(data=True), lambda a: not a.success),
        ("~/cancel", Trigger.Request(), lambda a: not a.success),
    ],
)
def test_a_request_whose_handler_raises_is_answered_once(service, request_, failed):
    logic = PlannerLogic(FAST)
    made = logic.on_defect(
        ZeroDivisionError("defect"), NOW, UnansweredRequest(service, request_, 7)
    )
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    assert answer.token == 7 and failed(answer.response)


def test_a_request_of_a_driver_whose_handler_raises_is_answered() -> None:
    error = ZeroDivisionError("defect")
    for logic in (ArmLogic(ArmOptions()), TapperLogic(TapperOptions())):
        made = logic.on_defect(error, NOW, UnansweredRequest("~/clear_fault", None, 7))
        (answer,) = [effect for effect in made if isinstance(effect, Answer)]
        assert answer.token == 7 and not answer.response.success
        assert "defect" in answer.response.message
    made = ArmLogic(ArmOptions()).on_defect(
        error, NOW, UnansweredRequest("hold_still", HoldStill.Request(), 7)
    )
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    assert not answer.response.granted and answer.response.error_code == ErrorCode.INTERNAL


def test_a_request_that_raises_is_answered_and_the_present_goal_ends_with_its_result(monkeypatch):
    clients = Clients()
    monkeypatch.setattr(clients.process.logic, "_on_confirmation", fail)
    (answer,) = clients.send_action("confirm_tap", ConfirmTap.Request(tap_id=1, confirm=True), 2)
    assert answer.error_code == ErrorCode.INTERNAL and not answer.accepted
    clients.wait(lambda: clients.first, "the first client's result")
    assert clients.first[0].error_code == ErrorCode.INTERNAL
    clients.run(0.1)
    assert clients.plans[-1].state == PlanState.FAILED


def test_a_defect_at_the_start_of_a_goal_answers_both_clients(monkeypatch):
    clients = Clients()
    monkeypatch.setattr(clients.process.logic._resumption, "keep", fail)
    second = clients.send_action("position_object", PositionObject.Goal(goal_pose=placed(OTHER)), 2)
    assert [one.error_code for one in clients.first] == [ErrorCode.GOAL_REPLACED]
    assert [one.error_code for one in second] == [ErrorCode.INTERNAL]
    assert clients.process.disk.goal is None, "neither goal is resumed after a crash"


METHODS = {
    "withdraw": lambda logic: logic._sender,
    "park": lambda logic: logic._sender,
    "report": lambda logic: logic._reports,
    "keep": lambda logic: logic._resumption,
    "_go": lambda logic: logic,
}
"""The object that has a method, by the method's name."""


def fail_at_cancellation(
    monkeypatch: pytest.MonkeyPatch, clients: Clients, fails: str
) -> list[str]:
    """Cancel the first goal, and let this method of the planner raise once meanwhile. Return the
    name of the method as soon as it has raised."""
    part = METHODS[fails](clients.process.logic)
    shipped, raised = getattr(part, fails), []

    def fail_once(*arguments: Any) -> Any:
        if not raised:
            raised.append(fails)
            raise ZeroDivisionError("defect")
        return shipped(*arguments)

    monkeypatch.setattr(part, fails, fail_once)
    clients.process.request("cancel", None, 1, lambda _: None, waits=False)
    return raised


@pytest.mark.parametrize("fails", ["withdraw", "report", "park"])
def test_a_tap_is_withdrawn_if_the_cancellation_of_its_goal_raises(monkeypatch, fails):
    clients = Clients()
    (tap,) = clients.taps()
    raised = fail_at_cancellation(monkeypatch, clients, fails)
    clients.run(0.02)
    withdrawn = [one.tap_id for one in clients.commands if one.request == TapCommand.WITHDRAW]
    assert raised and tap.tap_id in withdrawn
    assert clients.first, "the client has received the result of its goal"


def test_a_goal_ends_as_usual_if_its_gains_cannot_be_learnt(monkeypatch):
    clients = Clients()
    monkeypatch.setattr(clients.process.logic.goals, "learn", fail)
    clients.wait(lambda: clients.first, "the client's result")
    assert clients.first[0].error_code == ErrorCode.NONE
    clients.run(0.02)
    assert clients.plans[-1].state == PlanState.REACHED


@pytest.mark.parametrize("fails", ["keep", "_go"])
def test_a_tap_whose_command_was_not_published_does_not_count(monkeypatch, fails):
    """The internal error occurs before or after the command was prepared."""
    clients = Clients()
    part = METHODS[fails](clients.process.logic)
    shipped = getattr(part, fails)

    def fail_for_a_tap(*arguments: Any) -> Any:
        made = shipped(*arguments)
        if arguments[1] is True if fails == "keep" else isinstance(arguments[0].record, Placing):
            raise ZeroDivisionError("defect")
        return made

    clients.check_first_goal_is_reached()
    before = len(clients.taps())
    monkeypatch.setattr(part, fails, fail_for_a_tap)
    second = clients.send_action("position_object", PositionObject.Goal(goal_pose=placed(OTHER)), 2)
    clients.wait(lambda: second, "the client's result")
    assert (second[0].error_code, second[0].taps) == (ErrorCode.INTERNAL, 0)
    assert len(clients.taps()) == before


@pytest.mark.parametrize("fails", ["report", "park"])
def test_the_last_tap_counts_once_if_the_end_of_its_goal_raises(monkeypatch, fails):
    clients = Clients()
    assert clients.taps()
    raised = fail_at_cancellation(monkeypatch, clients, fails)
    clients.wait(lambda: clients.first, "the client's result")
    assert raised and clients.first[0].taps == 1


@pytest.mark.parametrize("logic", [ArmLogic(ArmOptions()), TapperLogic(TapperOptions())])
def test_a_driver_follows_a_life_cycle_event_whose_handler_raises(logic):
    """The node counts as active or inactive, so its state machine must be, too."""
    for event in (Activated(), Deactivated()):
        logic.on_defect(ZeroDivisionError("defect"), NOW, event)
        assert logic.active == isinstance(event, Activated)


def test_a_planner_whose_deactivation_raises_accepts_no_goal(monkeypatch):
    clients = Clients()
    logic = clients.process.logic
    with monkeypatch.context() as broken:
        broken.setattr(logic, "on_lifecycle", fail)
        clients.process.lifecycle(Deactivated())
    assert clients.first[0].error_code == ErrorCode.INTERNAL
    asked = PositionObject.Goal(goal_pose=placed(OTHER))
    (answer,) = clients.send_action("position_object", asked, 2)
    assert answer.error_code == ErrorCode.NOT_ACTIVE
