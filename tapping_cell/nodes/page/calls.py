"""Call services and actions of other nodes at the request of a page, and report the outcome to the
page."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.task import Future
from tapping_cell_msgs.action import SingleTap
from tapping_cell_msgs.msg import ErrorCode

from tapping_cell.nodes.conversions import from_message
from tapping_cell.nodes.page.cell_view import with_code
from tapping_cell.nodes.page.server import Answer
from tapping_cell.report.error_codes import hint
from tapping_cell.report.words import counted


def answer_to(request: str, ok: bool, sentence: str) -> dict[str, object]:
    """Return the message that answers a request of a page."""
    return {"type": "answer", "to": request, "ok": ok, "text": sentence}


def call_service(
    client: Client,
    content: object,
    request: str,
    name: str,
    answer: Answer,
    on_reply: Callable[[Any], None] | None = None,
) -> None:
    """Call a service. The page receives the response of the service, or a message that no server is
    available. If ``on_reply`` is given, it answers the page instead. A service that is not a
    Trigger needs ``on_reply``."""
    if not client.service_is_ready():
        answer(answer_to(request, False, f"{name} does not answer; is it running?"))
        return

    def done(future: Future) -> None:
        response = future.result()
        if on_reply is not None:
            on_reply(response)
        else:
            answer(answer_to(request, response.success, f"{name}: {response.message}"))

    client.call_async(content).add_done_callback(done)


def send_goal(
    action: ActionClient,
    goal: object,
    request: str,
    what: str,
    answer: Answer,
    on_response: Callable[[], None] = lambda: None,
    done: Callable[[Any], str] | None = None,
) -> bool:
    """Send a goal to the planner. Send the goal's result to the page when the goal has ended.
    ``what``: name of the goal in messages. ``on_response`` is called when the planner has accepted
    or rejected the goal. ``done`` makes the message for a result without an error. Return False if
    the planner is not running."""
    if not action.server_is_ready():
        answer(answer_to(request, False, "the planner is not running; start tap_planner"))
        return False

    def taken(future: Future) -> None:
        on_response()
        handle = future.result()
        if not handle.accepted:
            answer(answer_to(request, False, f"the planner did not accept the {what}"))
            return
        answer(answer_to(request, True, f"{what} sent"))
        handle.get_result_async().add_done_callback(ended)

    def ended(future: Future) -> None:
        result = future.result().result
        if result.error_code == ErrorCode.NONE:
            reached = done or (lambda it: f"{what} reached after {counted(it.taps, 'tap')}")
            sentence = reached(result)
            answer(answer_to(request, True, sentence))
            return
        sentence = with_code(result.error_msg, result.error_code)
        answer({**answer_to(request, False, sentence), "hint": hint(result.error_code)})

    action.send_goal_async(goal).add_done_callback(taken)
    return True


def shot_words(result: SingleTap.Result) -> str:
    """Return what a shot at nothing did, for the operator."""
    record = result.record
    before, after = from_message(record.object_pose), from_message(record.measured_pose.pose)
    return f"fired at nothing; the object moved by {1e3 * before.distance_to(after):.1f} mm"
