"""The arm's promise to stand still, and how long it waits for a charged striker."""

from __future__ import annotations

import math

from tapping_cell.configuration.cell import Cell
from tapping_cell.logic import permit
from tapping_cell.logic.clock import Now
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.messages import ErrorCode, HoldStill, TapperState

DISCHARGED_S = 0.7
"""Maximum time from the last report of a charged striker until the board has discharged it
automatically: the board waits for 0.5 s without a request, then its drive returns."""
LONGEST_WAIT_S = 3.0
"""Maximum time for which the arm waits until the striker is discharged, s: once after the end of a
tap, and again in each job that moves the arm."""
CHARGED = (TapperState.CHARGING, TapperState.CHARGED, TapperState.FIRING)


class StandingStill:
    """Until when the arm must not move. Times in s of the steady clock.

    A promise outlasts the states of the arm: it is kept after a fault and after a new connection.
    """

    def __init__(self) -> None:
        self.until = -math.inf
        """End of the promise."""
        self._longest_hold = 0.0
        self._outcome_received = 0
        """Id of the last tap of which the tapper has reported the outcome."""
        self._charged_until = -math.inf

    def configure(self, cell: Cell, now: Now) -> None:
        """Use the limits of this cell."""
        self._longest_hold = permit.longest_hold(cell)
        # Before a restart, this node may have granted a promise to stand still, possibly to a
        # tapper with another cell file. Assume that the longest possible promise was granted.
        self.until = max(self.until, now.steady + permit.LONGEST_HOLD_S)

    def duration_error(self, request: HoldStill.Request) -> CodedError | None:
        """Return why a request is refused because of its duration, or None."""
        if 0 < request.duration <= self._longest_hold:
            return None
        return (
            ErrorCode.COMMAND_INVALID,
            f"the duration of hold_still is {request.duration:g} s; it must be above 0 and at "
            f"most {self._longest_hold:g} s",
        )

    def repetition_error(self, request: HoldStill.Request) -> CodedError | None:
        """Return why a request is refused because its tap is over, or None."""
        if self._outcome_received != request.tap_id:
            return None
        return (
            ErrorCode.COMMAND_REPEATED,
            f"hold_still is refused, because the outcome of tap {request.tap_id} was already "
            "reported",
        )

    def promise(self, request: HoldStill.Request, now: Now) -> HoldStill.Response:
        """Grant a request."""
        # The requested time begins now, when the request is handled, not when it was sent.
        self.until = max(self.until, now.steady + request.duration)
        return HoldStill.Response(granted=True, duration=request.duration)

    def on_tapper_state(
        self, message: TapperState, last_tap_id: int, is_trusted: bool, now: Now
    ) -> bool:
        """Process ``tapper_state``. Return whether the striker of the arm's last tap is discharged
        since this message; ``is_trusted``: whether only one node publishes it."""
        if message.tap_id in (0, self._outcome_received) or message.tap_id != last_tap_id:
            return False
        if message.state in CHARGED:
            self._charged_until = now.steady + DISCHARGED_S
        elif message.outcome in (TapperState.FIRED, TapperState.NOT_FIRED):
            self._outcome_received = message.tap_id
            if message.state == TapperState.SAFE and is_trusted:
                self._charged_until = -math.inf
                return True
        return False

    def free_at(self, now: Now) -> float:
        """Return the earliest time at which a motion may begin that has waited since ``now``. From
        this time on, the arm does not have to stand still and the striker is no longer charged. The
        wait for the striker is limited to ``LONGEST_WAIT_S``."""
        return max(self.until, min(self._charged_until, now.steady + LONGEST_WAIT_S))

    def waits_for_striker(self, since: float, now: Now) -> bool:
        """Return whether a motion that has waited since ``since`` still waits for a charged
        striker."""
        return now.steady < min(self._charged_until, since + LONGEST_WAIT_S)
