"""The interface between a state machine and its host.

The host calls one handler at a time, under one lock per machine, and reads the time after it has
taken the lock. The host executes all effects that a handler returns, then calls the next handler.
Jobs run outside the lock. If a handler raises, the program has a defect, and the host calls
``on_defect``. The host does not execute the effects of the handler that raised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import Content, Effect, JobEnded, JobProgress, Message, Token
from tapping_cell.messages import Bool

ONE_PUBLISHER = (
    "object_states",
    "arm_state",
    "tapper_state",
    "plan_state",
    "tap_command",
)
"""Topics that one node of a cell publishes."""
ONE_SERVER = {"hold_still": "arm_state"}
"""Services that one node of a cell offers, each with the topic that the same node publishes."""


@dataclass(frozen=True, slots=True)
class Configured:
    """The node has read its files and opened its ports; nothing may move yet."""

    cell: Cell
    connected: Any = None
    """Return value of the driver's ``connect``; for the planner, its GoalHandling."""
    kept_goal: Content | None = None
    """Content of the last KeepGoal."""
    kept_goal_age: float = 0.0
    """Time since the last KeepGoal or TouchGoal, s."""


@dataclass(frozen=True, slots=True)
class Unreachable:
    """The device did not reply while the node was being configured; the connection will be tried
    again."""

    fault: HardwareFault


@dataclass(frozen=True, slots=True)
class Activated:
    """The machine may act."""


@dataclass(frozen=True, slots=True)
class Deactivated:
    """The node was deactivated; the machine must not act any more."""


@dataclass(frozen=True, slots=True)
class ShutDown:
    """The node shuts down and closes its port. A job that is still running sends no more events."""


LifecycleEvent = Configured | Unreachable | Activated | Deactivated | ShutDown


@dataclass(frozen=True, slots=True)
class UnansweredRequest:
    """A request whose handler raised, so that its client still waits for an answer."""

    service: str
    request: Message
    token: Token


LostEvent = UnansweredRequest | JobEnded | Bool | LifecycleEvent
"""Event whose handler has raised and that must not be lost: a request, the end of a job, a message
on ``emergency_stop``, or a life-cycle event, of which activation and deactivation still count."""


class Logic(Protocol):
    """Interface of a state machine."""

    tick_period: float
    """Maximum time between two calls of ``on_tick``, s."""

    def on_lifecycle(self, event: LifecycleEvent, now: Now) -> Sequence[Effect]:
        """Handle a lifecycle event of the node."""

    def on_message(self, topic: str, message: Message, now: Now) -> Sequence[Effect]:
        """Handle a message on a relative topic. The caller must not change or keep the message."""

    def on_request(
        self, service: str, request: Message, token: Token, now: Now
    ) -> Sequence[Effect]:
        """Handle a service request or action goal, given the service's or action's name.

        ``Answer(token, ...)`` follows once, immediately or later. The cancellation of an action
        goal is passed as ``on_request("cancel", None, token)`` with the goal's token and is not
        answered separately.
        """

    def on_answer(self, token: Token, response: Message | None, now: Now) -> Sequence[Effect]:
        """Handle the answer to Call or AskStops; None after the timeout."""

    def on_job(self, event: JobProgress | JobEnded, now: Now) -> Sequence[Effect]:
        """Handle the progress or the end of a job."""

    def on_conflict(self, sentence: str, now: Now) -> Sequence[Effect]:
        """Handle that several nodes publish a topic or offer a service for which the cell has one
        node. ``sentence`` names them; it is empty when the conflict is over."""

    def on_tick(self, now: Now) -> Sequence[Effect]:
        """Handle the timer."""

    def on_defect(
        self, error: Exception, now: Now, lost: LostEvent | None = None
    ) -> Sequence[Effect]:
        """Go to a safe state and report INTERNAL after a handler has raised ``error``.

        ``lost``: the event of the handler, if it must not be lost. A request is answered with a
        failure, a stop is latched, and after a deactivation the machine is inactive.
        """
