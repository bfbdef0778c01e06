"""Tap commands of the planner: their ids, withdrawals, and commands that free the camera's view."""

from __future__ import annotations

import math
from collections.abc import Iterator

from tapping_cell.logic import tap_commands
from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import NANOSECONDS, Now, to_stamp
from tapping_cell.logic.effects import Publish
from tapping_cell.logic.peer_clock import SKEW_LIMIT_S
from tapping_cell.logic.task import Shot
from tapping_cell.messages import TapCommand

PARKING_S = 0.5
"""Time within which an arm that was commanded to move aside reports that it moves."""
WITHDRAW_AGAIN_S = 1.0
"""Time after which a withdrawal is published again if the arm still serves the tap. A withdrawal
that the arm receives twice makes it move to its park pose, so this time is much longer than the
delay of a message."""


class TapSender:
    """Makes the messages on ``tap_command``. No id is used twice."""

    def __init__(self, monitor: CellMonitor) -> None:
        self._monitor = monitor
        self._last_id = 0
        self._withdrawn_id = 0
        self._withdrawn_at = -math.inf
        self._parked_id = 0

    def next_id(self, now: Now) -> int:
        """Return a tap id that was never used before.

        Ids are whole seconds of the clock, so they increase across restarts of every node and fit
        the tapper's 32 bits until 2106. If the clock was set back, the id is instead one above the
        greatest id that planner, arm or tapper has used.
        """
        # Arm and tapper refuse greater ids than this one, so they cannot have used them.
        largest = tap_commands.largest_id(self._last_id, now)
        used = self._monitor.last_tap_id(largest)
        self._last_id = max(self._last_id + 1, now.ros // NANOSECONDS, used + 1)
        return self._last_id

    def tap(self, shot: Shot, allowance: float, height: float, now: Now) -> Publish:
        """Return the command of a tap that expires after ``allowance`` s. ``height``: height of the
        tip above the table, m."""
        expiry = now.ros + round(allowance * NANOSECONDS)
        return Publish("tap_command", shot.command(now.ros, expiry, height))

    def is_withdrawn(self, shot: Shot) -> bool:
        """Return whether the tap was withdrawn last."""
        return self._withdrawn_id == shot.tap_id

    def withdraw(self, tap_id: int, now: Now) -> Iterator[Publish]:
        """Withdraw a tap; repeated calls for the same tap have no effect."""
        if tap_id != self._withdrawn_id:
            self._withdrawn_id, self._withdrawn_at = tap_id, now.steady
            yield _withdrawal(tap_id, now)

    def withdraw_orphan(self, now: Now) -> Iterator[Publish]:
        """Withdraw a tap of a previous planner that the arm still serves, if any."""
        orphan = self._monitor.orphaned_tap_id()
        if orphan:
            yield from self.withdraw(orphan, now)

    def repeat_withdrawal(self, now: Now) -> Iterator[Publish]:
        """Publish the last withdrawal again if it was lost: the arm still serves the tap."""
        tap_id = self._withdrawn_id
        serving = tap_id and self._monitor.orphaned_tap_id() == tap_id
        due = now.steady > self._withdrawn_at + WITHDRAW_AGAIN_S
        if serving and due and not self._monitor.silent("arm", now):
            self._withdrawn_at = now.steady
            yield _withdrawal(tap_id, now)

    @property
    def may_park(self) -> bool:
        """Whether the last tap was withdrawn, and the arm was not yet told to move to its park
        pose."""
        return self._monitor.has_arm and self._withdrawn_id not in (0, self._parked_id)

    def park(self, now: Now) -> Iterator[Publish]:
        """Make the withdrawn arm continue to its park pose, by a second withdrawal."""
        if self.may_park:
            self._parked_id = self._withdrawn_id
            yield _withdrawal(self._withdrawn_id, now)

    def clear_view(self, now: Now) -> Publish:
        """Return the command to move the arm to a pose that uncovers the area that it hides. The
        command expires when the planner stops waiting, so that a late command does not move the
        arm."""
        command = _command(TapCommand.CLEAR_VIEW, self.next_id(now), now)
        # SKEW_LIMIT_S allows for the difference of the computers' clocks.
        command.expiry = to_stamp(now.ros + round((PARKING_S + SKEW_LIMIT_S) * NANOSECONDS))
        return Publish("tap_command", command)


def _command(request: int, tap_id: int, now: Now) -> TapCommand:
    command = TapCommand(request=request, tap_id=tap_id)
    command.header.stamp = to_stamp(now.ros)
    command.header.frame_id = "table"
    return command


def _withdrawal(tap_id: int, now: Now) -> Publish:
    return Publish("tap_command", _command(TapCommand.WITHDRAW, tap_id, now))
