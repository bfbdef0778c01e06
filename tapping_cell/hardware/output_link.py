"""What the driver needs of a digital output that fires a tapper: switch it, and hear of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from tapping_cell.hardware.transport import Connection


class Answer(Enum):
    """What became of a request to the output."""

    PENDING = "pending"
    DONE = "done"
    REFUSED = "refused"
    UNTOLD = "untold"
    """The way to the output carries no answers."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A level of an input and when it came, s of the link's steady clock."""

    level: bool
    received: float


class OutputLink(Connection, Protocol):
    """The way to one digital output, with the guard's input and perhaps a read-back.

    ``stop`` ignores its bytes, and switches off.
    """

    @property
    def interface(self) -> str:
        """How the output is switched: service, topic, commands or pulse."""

    @property
    def times_pulse(self) -> bool:
        """Whether the other side times the pulse, so that it is sent with its length."""

    @property
    def reads_back(self) -> bool:
        """Whether a read-back is expected."""

    @property
    def guard(self) -> Heard | None:
        """Whether the guard is closed; None before anything was heard."""

    @property
    def read_back(self) -> Heard | None:
        """Whether the output is on, as it was read back last."""

    @property
    def last_on(self) -> float:
        """When a read-back last told that the output is on, s; minus infinity if never."""

    @property
    def rivals(self) -> tuple[str, ...]:
        """Other nodes that could switch the output."""

    def switch(self, on: bool) -> int:
        """Send a level; returns a number to ask ``answer`` with."""

    def pulse(self, duration: float) -> int:
        """Send a pulse of ``duration`` s, where the other side times it; 0 ends one."""

    def answer(self, number: int) -> Answer:
        """What became of a request."""

    def wait(self, duration: float) -> None:
        """Wait for news, for up to ``duration`` s."""

    def sleep(self, duration: float) -> None:
        """Let ``duration`` s pass, stop or not."""
