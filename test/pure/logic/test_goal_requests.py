"""Which requests for a goal are allowed, and how a refusal is reported and answered."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.effects import Answer, Log, LogLevel, Publish
from tapping_cell.logic.goal_handling import Request
from tapping_cell.logic.goal_requests import failure, refusal, refuse
from tapping_cell.logic.goal_validation import Refused
from tapping_cell.logic.task import Task
from tapping_cell.messages import (
    ArrangeObjects,
    ConfirmTap,
    ErrorCode,
    PoseStamped,
    PositionObject,
    SetBool,
    SingleTap,
    Trigger,
)

NOW = Now(100.0, 10**18)
SENT = 10**18


def request(stamp: int = 0, token: object = None) -> Request:
    asked = Request(PoseStamped(), 0.001, 0.0175, 0, 0.0, cast(Any, token))
    asked.message.header.stamp = to_stamp(stamp)
    return asked


def cell(fault: Any = None, foreign: Any = None) -> CellMonitor:
    return cast(CellMonitor, SimpleNamespace(fault=lambda: fault, foreign_object=lambda: foreign))


PRESENT = cast(Task, SimpleNamespace(sent=SENT))
RESULTS = {
    Request: PositionObject.Result,
    SingleTap.Goal: SingleTap.Result,
    ArrangeObjects.Goal: ArrangeObjects.Result,
}
ASKED = (request(), SingleTap.Goal(), ArrangeObjects.Goal())


@pytest.mark.parametrize("asked", ASKED, ids=lambda asked: type(asked).__qualname__)
@pytest.mark.parametrize("present", [None, PRESENT], ids=["idle", "at a goal"])
def test_a_fault_or_another_cells_object_refuses_every_request(asked, present):
    fault = (ErrorCode.ARM_ALARM, "alarm 1")
    refused = refusal(asked, present, cell(fault=fault))
    assert refused is not None and refused.code == ErrorCode.ARM_ALARM
    assert "alarm 1" in refused.sentence
    foreign = Refused(ErrorCode.OBJECT_NOT_SEEN, "another object")
    refused = refusal(asked, present, cell(foreign=(foreign.code, foreign.sentence)))
    assert refused == foreign
    busy = isinstance(asked, SingleTap.Goal) and present is not None
    refused = refusal(asked, present, cell())
    assert (refused.code if refused else 0) == (ErrorCode.PLANNER_BUSY if busy else 0)


@pytest.mark.parametrize(
    ("stamp", "token", "is_refused"),
    [
        (0, None, False),
        (1, None, True),
        (SENT - 1, None, True),
        (SENT, None, False),
        (SENT + 1, None, False),
        (SENT - 1, object(), False),
    ],
)
def test_a_goal_of_the_topic_that_is_older_than_the_present_one_is_refused(
    stamp, token, is_refused
):
    """A stamp of zero means that no stamp was given; the client of an action may repeat its
    goal."""
    refused = refusal(request(stamp, token), PRESENT, cell())
    assert (refused is not None) == is_refused
    assert refused is None or refused.code == ErrorCode.GOAL_STALE
    assert refusal(request(stamp, token), None, cell()) is None


@pytest.mark.parametrize("asked", ASKED, ids=lambda asked: type(asked).__qualname__)
@pytest.mark.parametrize("token", [None, 7])
def test_a_refusal_is_logged_and_answered(asked, token):
    refused = Refused(ErrorCode.GOAL_OFF_TABLE, "the goal is off the table")
    effects = list(refuse(refused, asked, cast(Any, token), NOW))
    (log,) = [effect for effect in effects if isinstance(effect, Log)]
    assert log.level is LogLevel.ERROR and refused.sentence in log.sentence
    assert str(refused.code) in log.sentence
    reports = [effect.topic for effect in effects if isinstance(effect, Publish)]
    assert reports == (["goal_report"] if isinstance(asked, Request) else [])
    answers = [effect for effect in effects if isinstance(effect, Answer)]
    assert len(answers) == (token is not None)
    for answer in answers:
        assert answer.token == token and type(answer.response) is RESULTS[type(asked)]
        message = cast(Any, answer.response)
        assert (message.error_code, message.error_msg) == (refused.code, refused.sentence)


@pytest.mark.parametrize(
    ("kind", "answer"),
    [
        (SetBool.Request, SetBool.Response),
        (Trigger.Request, Trigger.Response),
        (ConfirmTap.Request, ConfirmTap.Response),
        (SingleTap.Goal, SingleTap.Result),
        (ArrangeObjects.Goal, ArrangeObjects.Result),
        (PositionObject.Goal, PositionObject.Result),
    ],
)
def test_a_failure_has_the_class_of_the_answer_and_its_reason(kind, answer):
    message = cast(Any, failure(kind, ErrorCode.INTERNAL, "a defect"))
    assert type(message) is answer
    if hasattr(message, "success"):
        assert (message.success, message.message) == (False, "a defect")
    else:
        assert (message.error_code, message.error_msg) == (ErrorCode.INTERNAL, "a defect")
    if kind is PositionObject.Goal:
        assert math.isnan(message.residual_distance) and math.isnan(message.residual_rotation)
