"""Effects: actions that a state machine returns for its host to execute in the given order."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from tapping_cell.logic.clock import Now

Message = Any
"""A dataclass of ``tapping_cell.messages``."""
Token = Any
"""Hashable identifier of a call or a request, chosen by the caller."""
Content = Mapping[str, Any]
"""JSON content that is stored across a restart: strings, numbers, booleans and lists of them."""


class JobContext(Protocol):
    """Interface of the host to a running job."""

    @property
    def driver(self) -> Any:
        """Driver of the host's device; the driver uses the clock of ``Now.steady``."""

    def now(self) -> Now:
        """Return the present time."""

    def sleep(self, duration: float) -> None:
        """Sleep for ``duration`` s."""

    def abandoned(self) -> bool:
        """Return whether :class:`AbandonJob` was requested for this job."""

    def post(self, content: object) -> None:
        """Send a :class:`JobProgress` with this content to the machine; return once the machine has
        handled it."""

    def ask(self, query: Callable[[Now], Any]) -> Any:
        """Call ``query`` while the lock of the machine's handlers is held. ``query``: a method of
        the machine without side effects.

        The time that is passed to ``query`` is read after the lock was taken.
        """


@dataclass(frozen=True, slots=True)
class Job:
    """A blocking function that uses the driver; jobs run one at a time, in the given order."""

    number: int
    """Number that is unique within the lifetime of the machine."""
    name: str
    run: Callable[[JobContext], object]


@dataclass(frozen=True, slots=True)
class JobProgress:
    """Progress report of a running job."""

    job: int
    content: Any


@dataclass(frozen=True, slots=True)
class JobEnded:
    """End of a job, sent exactly once per job. ``result``: return value of ``run``."""

    job: int
    result: Any = None
    fault: Exception | None = None
    """Exception that ``run`` raised: a HardwareFault, or any other exception if the program has a
    defect."""


class LogLevel(Enum):
    """Log levels as in ROS."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Publish:
    """Publish a message on a relative topic (``~/`` for a private topic of the node)."""

    topic: str
    message: Message


@dataclass(frozen=True, slots=True)
class Call:
    """Call a service. ``on_answer(token, response)`` is then called once; the response is None
    after ``timeout``, or if several nodes offer the service, because each of them would handle the
    request."""

    service: str
    request: Message
    token: Token
    timeout: float
    """Timeout of the call, s."""


@dataclass(frozen=True, slots=True)
class AskStops:
    """Query the present level of every publisher of ``emergency_stop``.

    ``on_answer(token, StopLevels)`` is then called once. The host creates a new subscription for
    this query, because messages of an existing subscription do not identify their publisher.
    """

    token: Token


@dataclass(frozen=True, slots=True)
class StopLevels:
    """Answer to :class:`AskStops`."""

    asserted: bool
    """Whether at least one publisher asserts its stop at present."""
    publishers: tuple[str, ...]
    """Names of the nodes that publish ``emergency_stop`` at present."""
    gone: tuple[str, ...]
    """Nodes whose publisher existed when a stop was received, but does not exist at present. Only
    stops since the last reset (``KeepStop(None)``) count."""
    silent: tuple[str, ...] = ()
    """If there are several publishers: nodes whose publisher does not resend its level to a new
    subscription."""


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer to a service request or action goal that ``on_request`` received."""

    token: Token
    response: Message


@dataclass(frozen=True, slots=True)
class Feedback:
    """Feedback of an action goal that has not been answered yet."""

    token: Token
    message: Message


@dataclass(frozen=True, slots=True)
class RunJob:
    """Run a job after all jobs that were queued before it."""

    job: Job


@dataclass(frozen=True, slots=True)
class AbandonJob:
    """Request that the job ends after its current step (see ``JobContext.abandoned``). A JobEnded
    event still follows."""

    job: int


@dataclass(frozen=True, slots=True)
class StopWire:
    """Call ``driver.stop()`` immediately, without waiting for the worker thread."""


@dataclass(frozen=True, slots=True)
class Log:
    """Write a sentence to the log."""

    level: LogLevel
    sentence: str


@dataclass(frozen=True, slots=True)
class KeepGoal:
    """Store the goal under way, for a restart after a crash; None removes the stored goal."""

    content: Content | None


@dataclass(frozen=True, slots=True)
class TouchGoal:
    """Reset the age of the stored goal. A goal that is too old is not resumed."""


@dataclass(frozen=True, slots=True)
class KeepStop:
    """Write the latched stops to disk, to restore them after a restart; None removes them. The host
    executes this effect before any other effect."""

    content: Content | None


Effect = (
    Publish
    | Call
    | AskStops
    | Answer
    | Feedback
    | RunJob
    | AbandonJob
    | StopWire
    | Log
    | KeepGoal
    | TouchGoal
    | KeepStop
)
