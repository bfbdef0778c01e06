"""Acceptance of requests for a goal, and their refusals."""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterator

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import NANOSECONDS, Now, to_nanoseconds
from tapping_cell.logic.effects import Answer, Effect, Log, LogLevel, Message, Publish, Token
from tapping_cell.logic.goal_handling import GoalHandling, Request
from tapping_cell.logic.goal_validation import Refused
from tapping_cell.logic.planner_reports import refusal_report
from tapping_cell.logic.task import Task
from tapping_cell.messages import (
    ArrangeObjects,
    ConfirmTap,
    ErrorCode,
    PositionObject,
    SetBool,
    SingleTap,
    Trigger,
)
from tapping_cell.planning import PlanningError

NAMES: dict[type, str] = {
    PositionObject.Goal: "goal",
    SingleTap.Goal: "single tap",
    ArrangeObjects.Goal: "arrangement",
}
"""What each action requests, for the log."""
NOT_ACTIVE = Refused(ErrorCode.NOT_ACTIVE, "the planner is not active; activate it first")


def to_request(asked: PositionObject.Goal, token: Token) -> Request:
    """Convert the goal of the action ``position_object``."""
    return Request(
        asked.goal_pose,
        asked.position_tolerance,
        asked.angle_tolerance,
        asked.max_taps,
        asked.time_limit,
        token,
        asked.probe,
        asked.ask,
        asked.object_id,
    )


def accept(
    asked: Request | SingleTap.Goal | ArrangeObjects.Goal,
    token: Token | None,
    goals: GoalHandling,
    present: Task | None,
    monitor: CellMonitor,
    now: Now,
) -> tuple[Task | Refused, str]:
    """Return the task for a request, or why the request is refused, and the traceback of a defect.
    ``present``: the goal under way. If the check of the request raises, only this request ends,
    because the check changes nothing of the goal under way."""
    try:
        if present is not None:
            # The new task begins with what the goal under way has learnt so far.
            goals.learn(present)
        if isinstance(asked, Request):
            return goals.accept(asked, now), ""
        if isinstance(asked, SingleTap.Goal):
            return goals.accept_tap(asked, token, monitor.pose, now), ""
        return goals.accept_arrangement(asked, token, now), ""
    except PlanningError as error:
        return Refused(ErrorCode.COMMAND_INVALID, str(error)), ""
    except Exception as error:
        return Refused(ErrorCode.INTERNAL, internal_error(error)), traceback.format_exc()


def refusal(
    asked: Request | SingleTap.Goal | ArrangeObjects.Goal,
    present: Task | None,
    monitor: CellMonitor,
) -> Refused | None:
    """Return why the cell or the goal under way does not allow a request; None if they do."""
    fault = monitor.fault()
    if fault is not None:
        return Refused(fault[0], f"the cell is faulted: {fault[1]}")
    foreign = monitor.foreign_object()
    if foreign is not None:
        return Refused(*foreign)
    if isinstance(asked, SingleTap.Goal) and present is not None:
        sentence = "a goal is under way; wait for its end, or cancel it"
        return Refused(ErrorCode.PLANNER_BUSY, sentence)
    if isinstance(asked, Request) and present is not None:
        return _outdated(asked, present)
    return None


def _outdated(request: Request, present: Task) -> Refused | None:
    """Return a refusal if a goal of the topic is older than the goal under way, or None. The client
    of an action learns what becomes of its goal, and may send it again."""
    sent = to_nanoseconds(request.message.header.stamp)
    if request.token is not None or sent <= 0 or sent >= present.sent:
        return None
    return Refused(
        ErrorCode.GOAL_STALE,
        f"the goal's stamp is {(present.sent - sent) / NANOSECONDS:.1f} s older than the goal under"
        " way; send the goal again with a current stamp or with stamp 0",
    )


def refuse(
    refused: Refused,
    asked: Request | SingleTap.Goal | ArrangeObjects.Goal,
    token: Token | None,
    now: Now,
) -> Iterator[Effect]:
    """Report that a request was refused, and answer it if it has a token."""
    code, sentence = refused.code, refused.sentence
    kind = PositionObject.Goal if isinstance(asked, Request) else type(asked)
    if isinstance(asked, Request):
        yield Publish("goal_report", refusal_report(refused, asked, now))
    yield Log(LogLevel.ERROR, f"{NAMES[kind]} refused ({code}): {sentence}")
    if token is not None:
        yield Answer(token, failure(kind, code, sentence))


def internal_error(error: Exception) -> str:
    """Return the error message for a defect of the program."""
    return f"internal error ({error!r}): report it with the log"


def failure(kind: type[Message], code: int, sentence: str) -> Message:
    """Return the answer to a request of this class that is refused or whose handler raised."""
    if kind in (SetBool.Request, Trigger.Request):
        return (SetBool if kind is SetBool.Request else Trigger).Response(
            success=False, message=sentence
        )
    if kind is ConfirmTap.Request:
        return ConfirmTap.Response(error_code=code, error_msg=sentence)
    if kind is SingleTap.Goal:
        return SingleTap.Result(error_code=code, error_msg=sentence)
    if kind is ArrangeObjects.Goal:
        return ArrangeObjects.Result(error_code=code, error_msg=sentence)
    return PositionObject.Result(
        error_code=code,
        error_msg=sentence,
        residual_distance=math.nan,
        residual_rotation=math.nan,
    )
