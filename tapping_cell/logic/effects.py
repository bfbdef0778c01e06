"""What a machine asks its host to do. The host carries effects out in the order given."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from tapping_cell.logic.clock import Now

Message = Any
"""A dataclass of ``tapping_cell.messages``."""
Token = Any
"""Names a question or a request; hashable, chosen by whoever asks."""
Content = Mapping[str, Any]
"""What is kept over a restart: text, numbers, truth values, lists of them (JSON)."""


class JobContext(Protocol):
    """What a running job may use of its host."""

    @property
    def driver(self) -> Any:
        """The driver of the host's device; its clock is that of ``Now.steady``."""

    def now(self) -> Now:
        """The present moment."""

    def sleep(self, duration: float) -> None:
        """Let ``duration`` s pass."""

    def abandoned(self) -> bool:
        """Whether :class:`AbandonJob` was given for this job."""

    def post(self, content: object) -> None:
        """Hand :class:`JobProgress` with this content to the machine; returns once handled."""

    def ask(self, query: Callable[[Now], Any]) -> Any:
        """The answer of a side-effect-free method of the machine, in exclusion with its handlers.

        The time that the query gets is read once the exclusion is held.
        """


@dataclass(frozen=True, slots=True)
class Job:
    """A blocking sequence on the driver; jobs run one at a time, in the order given."""

    number: int
    """Unique in the machine's life."""
    name: str
    run: Callable[[JobContext], object]


@dataclass(frozen=True, slots=True)
class JobProgress:
    """What a running job tells."""

    job: int
    content: Any


@dataclass(frozen=True, slots=True)
class JobEnded:
    """The end of a job, exactly one for each: ``result`` is what ``run`` returned."""

    job: int
    result: Any = None
    fault: Exception | None = None
    """What ``run`` raised in place of returning: a HardwareFault, or a defect."""


class LogLevel(Enum):
    """As in ROS."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Publish:
    """Publish a message on a relative topic (``~/`` for the node's own)."""

    topic: str
    message: Message


@dataclass(frozen=True, slots=True)
class Call:
    """Call a service; ``on_answer(token, response)`` follows once, with None after ``timeout``."""

    service: str
    request: Message
    token: Token
    timeout: float
    """s."""


@dataclass(frozen=True, slots=True)
class AskStops:
    """Ask every publisher of ``emergency_stop`` for its present level.

    ``on_answer(token, StopLevels)`` follows once. The host asks by a new subscription, because a
    subscription that exists does not tell whose message it got.
    """

    token: Token


@dataclass(frozen=True, slots=True)
class StopLevels:
    """The answer to :class:`AskStops`."""

    asserted: bool
    """A publisher holds its stop now."""
    publishers: tuple[str, ...]
    """Names of the nodes that publish ``emergency_stop`` now."""
    gone: tuple[str, ...]
    """Nodes whose publisher existed when a stop was heard since the last
    ``KeepStop(None)``, and is gone."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a service request or action goal that ``on_request`` brought."""

    token: Token
    response: Message


@dataclass(frozen=True, slots=True)
class Feedback:
    """Feedback of an action goal that was not answered yet."""

    token: Token
    message: Message


@dataclass(frozen=True, slots=True)
class RunJob:
    """Run a job after those given before."""

    job: Job


@dataclass(frozen=True, slots=True)
class AbandonJob:
    """Set the flag that the job looks at between its steps; it still ends in its event."""

    job: int


@dataclass(frozen=True, slots=True)
class StopWire:
    """``driver.stop()`` at once, past the worker."""


@dataclass(frozen=True, slots=True)
class Log:
    """A sentence for the log."""

    level: LogLevel
    sentence: str


@dataclass(frozen=True, slots=True)
class KeepGoal:
    """Keep the goal under way over a crash; None removes it."""

    content: Content | None


@dataclass(frozen=True, slots=True)
class TouchGoal:
    """Mark the kept goal as still worked on: an old one is not resumed."""


@dataclass(frozen=True, slots=True)
class KeepStop:
    """Keep the stops that are held over a restart, on disk before anything else; None removes."""

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
