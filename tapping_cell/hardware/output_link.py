"""Interface to a digital output that fires a tapper: switching and read-back."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from tapping_cell.hardware.transport import Connection


class Answer(Enum):
    """Result of a request to the output."""

    PENDING = "pending"
    DONE = "done"
    REFUSED = "refused"
    UNREPORTED = "unreported"
    """Not available, because the interface does not return answers."""


@dataclass(frozen=True, slots=True)
class InputLevel:
    """Level of an input, and the time of its reception on the link's steady clock, s."""

    level: bool
    received: float


class OutputLink(Connection, Protocol):
    """Connection to one digital output, with the guard input and an optional read-back.

    ``stop`` switches the output off and ignores the bytes that are passed to it.
    """

    @property
    def interface(self) -> str:
        """Interface that switches the output: service, topic, commands or pulse."""

    @property
    def times_pulse(self) -> bool:
        """True if the remote side times the pulse, so that a pulse is sent with its length."""

    @property
    def reads_back(self) -> bool:
        """True if a read-back is expected."""

    @property
    def guard(self) -> InputLevel | None:
        """Last level of the guard input (True: closed); None before the first message."""

    @property
    def read_back(self) -> InputLevel | None:
        """Last level read back (True: the output is on); None before the first message."""

    @property
    def last_on(self) -> float:
        """Time when a read-back last reported the output as on, s; minus infinity if never."""

    @property
    def other_commanders(self) -> tuple[str, ...]:
        """Other nodes that could switch the output."""

    def switch(self, on: bool) -> int:
        """Send a level; return a request number for ``answer``."""

    def pulse(self, duration: float) -> int:
        """Send a pulse of ``duration`` s that the remote side times; 0 ends a pulse."""

    def answer(self, number: int) -> Answer:
        """Return the result of a request."""

    def wait(self, duration: float) -> None:
        """Wait for new input for up to ``duration`` s."""

    def sleep(self, duration: float) -> None:
        """Sleep for ``duration`` s, even during a stop; not at all if it is negative."""
