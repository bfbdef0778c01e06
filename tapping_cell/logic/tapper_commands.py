"""Ids of the tap commands that the tapper has received, so that no command takes effect twice."""

from __future__ import annotations

from collections import deque

from tapping_cell.logic import tap_commands
from tapping_cell.logic.clock import Now, to_nanoseconds
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.messages import ErrorCode, TapCommand

REFUSED_KEPT = 32
"""Number of refused commands and of withdrawals that are kept, so that later copies of the commands
are recognised."""


class ReceivedCommands:
    """See the module's docstring."""

    def __init__(self) -> None:
        self.last_tap_id = 0
        """Greatest id that was accepted or reported as refused."""
        self._refused: deque[tuple[int, int]] = deque(maxlen=REFUSED_KEPT)
        """Ids and stamps (ns) of the last commands that were refused while the outcome of another
        tap was not known. A copy that arrives later, perhaps after the withdrawal, is also
        refused."""
        self._withdrawn: deque[int] = deque(maxlen=REFUSED_KEPT)
        """Ids of the last taps that were withdrawn but not under way, perhaps because this process
        was started after their commands. A copy of such a command is refused."""

    def refusal(self, command: TapCommand, used: int | None, now: Now) -> CodedError | None:
        """Return why a command is refused because of its id or its content, or None. ``used``:
        greatest shot number of the board, None if it is not known."""
        if _id_and_stamp(command) in self._refused:
            return (
                ErrorCode.COMMAND_REPEATED,
                "this command was refused before; send a new tap with a greater id",
            )
        if command.tap_id in self._withdrawn:
            return (
                ErrorCode.COMMAND_REPEATED,
                "this tap was withdrawn before its command arrived; send a new tap with a greater"
                " id",
            )
        return tap_commands.refusal(command, now, max(self.last_tap_id, used or 0))

    def note_withdrawn(self, tap_id: int) -> None:
        """Store the id of a withdrawn tap that is not under way."""
        self._withdrawn.append(tap_id)

    def note_refused(
        self, command: TapCommand, used: int | None, awaits_outcome: bool, now: Now
    ) -> bool:
        """Store a refused command; return whether its tap may be reported as the last tap.

        Until the outcome of the last accepted tap is known, possibly after a stop, the published
        state refers only to that tap, so the refused tap is not reported. An id above the largest
        valid id is not stored either, because it would become the last id. The largest valid id
        does not depend on refused taps, so that these cannot raise it.
        """
        new = self.last_tap_id < command.tap_id <= tap_commands.largest_id(used or 0, now)
        if new and awaits_outcome:
            self._refused.append(_id_and_stamp(command))
        elif new:
            self.last_tap_id = command.tap_id
        return new and not awaits_outcome


def _id_and_stamp(command: TapCommand) -> tuple[int, int]:
    return command.tap_id, to_nanoseconds(command.header.stamp)
