"""The contract between a machine and its host.

The host calls one handler at a time, under one lock for each machine, with the time read once the
lock is held, and carries out the effects that it returns before the next handler runs. Jobs run
outside the lock. A handler that raises is a defect: the host then calls ``on_defect``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import Content, Effect, JobEnded, JobProgress, Message, Token


@dataclass(frozen=True, slots=True)
class Configured:
    """Files are read, ports are open; nothing may move."""

    cell: Cell
    connected: Any = None
    """What the driver's ``connect`` returned; of a planner its GoalHandling."""
    kept_stop: Content | None = None
    """Of the last KeepStop of the node's life before."""
    kept_goal: Content | None = None
    """Of the last KeepGoal."""
    kept_goal_age: float = 0.0
    """s since the goal was kept or touched."""


@dataclass(frozen=True, slots=True)
class Unreachable:
    """The device did not answer when the node was to be configured; tried again later."""

    fault: HardwareFault


@dataclass(frozen=True, slots=True)
class Activated:
    """The machine may act."""


@dataclass(frozen=True, slots=True)
class Deactivated:
    """The machine must not act any more."""


@dataclass(frozen=True, slots=True)
class ShutDown:
    """The node ends in order: port closed, worker ended. Nothing of the job under way follows."""


LifecycleEvent = Configured | Unreachable | Activated | Deactivated | ShutDown


class Logic(Protocol):
    """A machine."""

    tick_period: float
    """Longest time between two calls of ``on_tick``, s."""

    def on_lifecycle(self, event: LifecycleEvent, now: Now) -> Sequence[Effect]:
        """The node's life cycle."""

    def on_message(self, topic: str, message: Message, now: Now) -> Sequence[Effect]:
        """A message, by its relative topic name; not to be changed or kept by the caller."""

    def on_request(
        self, service: str, request: Message, token: Token, now: Now
    ) -> Sequence[Effect]:
        """A service request or action goal, by the service's or action's name.

        ``Answer(token, ...)`` follows once, at once or later. The cancellation of an action goal
        comes as ``on_request("cancel", None, token)`` with the goal's token and has no answer of
        its own.
        """

    def on_answer(self, token: Token, response: Message | None, now: Now) -> Sequence[Effect]:
        """The answer to Call or AskStops; None where none came in time."""

    def on_job(self, event: JobProgress | JobEnded, now: Now) -> Sequence[Effect]:
        """A job tells of its progress or its end."""

    def on_tick(self, now: Now) -> Sequence[Effect]:
        """Time has passed."""

    def on_defect(self, error: Exception, now: Now) -> Sequence[Effect]:
        """A handler raised: go to a safe state and tell it as INTERNAL."""
