"""Validation of tap commands, common to arm and tapper."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tapping_cell.logic.clock import NANOSECONDS, Now, to_nanoseconds
from tapping_cell.logic.poses import is_finite, quaternion_norm
from tapping_cell.messages import ErrorCode, TapCommand

LONGEST_EXPIRY_S = 900.0
"""Maximum time from receiving a command to its expiry. The limit exceeds the largest possible sum
of the planner's place and fire deadlines. If a command is abandoned, the arm waits at the strike
pose until the expiry, so a longer expiry would block the cell."""
CLOCK_TOLERANCE_S = 1.0
"""Maximum time by which a stamp may lie in the future, because the computers' clocks differ
slightly."""
LONGEST_WITHDRAWAL_S = 3.0
"""Maximum age of a withdrawal that moves the arm."""
LARGEST_JUMP = 2**28
"""Maximum amount by which a tap id may exceed the greater of two numbers: the last id, and the
clock's time in whole seconds. The limit corresponds to 8 years. Without this limit, one wrong id
could leave no greater ids for the following taps."""

CodedError = tuple[int, str]
"""Error code and message."""


def largest_id(last_tap_id: int, now: Now) -> int:
    """Return the greatest valid id."""
    return max(last_tap_id, now.ros // NANOSECONDS) + LARGEST_JUMP


def refusal(command: TapCommand, now: Now, last_tap_id: int) -> CodedError | None:
    """Return why a TAP or CLEAR_VIEW must be refused, or None if it is valid.

    ``last_tap_id``: greatest id executed so far. A stamp of zero means that no stamp was given.
    """
    if command.request not in (TapCommand.TAP, TapCommand.CLEAR_VIEW):
        return (
            ErrorCode.COMMAND_INVALID,
            f"its request {command.request} is neither TAP, WITHDRAW nor CLEAR_VIEW",
        )
    if command.header.frame_id != "table":
        sentence = f"its frame is '{command.header.frame_id}', but must be 'table'"
        return ErrorCode.COMMAND_INVALID, sentence
    if not (is_finite(command.strike_pose) and math.isfinite(command.striker_speed)):
        return ErrorCode.COMMAND_INVALID, "it contains a number that is not finite"
    if abs(quaternion_norm(command.strike_pose) - 1) > 0.01:
        return ErrorCode.COMMAND_INVALID, "the quaternion of its strike pose is not normalised"
    largest = largest_id(last_tap_id, now)
    if not 0 < command.tap_id <= largest:
        return (
            ErrorCode.COMMAND_INVALID,
            f"its tap id {command.tap_id} is outside 1 to {largest}; use the clock's"
            " time in whole seconds; the id must be greater than the last id",
        )
    if command.tap_id <= last_tap_id:
        return (
            ErrorCode.COMMAND_REPEATED,
            f"tap ids must increase, and {last_tap_id} was already executed; a tap is never "
            "executed twice",
        )
    ahead = (to_nanoseconds(command.header.stamp) - now.ros) / NANOSECONDS
    if ahead > CLOCK_TOLERANCE_S:
        return (
            ErrorCode.STAMP_INVALID,
            f"its stamp lies {ahead:.1f} s in the future (limit {CLOCK_TOLERANCE_S:.1f} s); "
            "synchronise the computers' clocks",
        )
    left = (to_nanoseconds(command.expiry) - now.ros) / NANOSECONDS
    if left > LONGEST_EXPIRY_S:
        return (
            ErrorCode.COMMAND_INVALID,
            f"it expires in {left:.0f} s; the limit is {LONGEST_EXPIRY_S:.0f} s",
        )
    return None


def named_tapper(name: str, tappers: Sequence[str]) -> str | None:
    """Return the tapper with this name, or None if there is none. An empty name selects the only
    tapper."""
    if name == "" and len(tappers) == 1:
        return tappers[0]
    return name if name in tappers else None


def unknown_tapper(name: str, tappers: Sequence[str]) -> CodedError:
    """Return the refusal of a command that does not name one of the cell's tappers."""
    known = ", ".join(f"'{tapper}'" for tapper in tappers)
    asked = (
        f"there is no tapper '{name}'"
        if name
        else "the command names no tapper, but the cell has several"
    )
    return ErrorCode.TAPPER_UNKNOWN, f"{asked}; name one of {known}"


def expired(command: TapCommand, now: Now) -> bool:
    """Return whether the command's expiry has passed."""
    return now.ros > to_nanoseconds(command.expiry)


def late_withdrawal(command: TapCommand, now: Now) -> str:
    """Return why a withdrawal is too old to move the arm; an empty string if it is not. A stamp of
    zero means that no stamp was given."""
    stamp = to_nanoseconds(command.header.stamp)
    age = (now.ros - stamp) / NANOSECONDS
    if stamp == 0 or age <= LONGEST_WITHDRAWAL_S:
        return ""
    return (
        f"it is {age:.1f} s old (limit {LONGEST_WITHDRAWAL_S:.1f} s); check the clocks of the"
        " computers and the network"
    )


def expiry_message(command: TapCommand, now: Now) -> str:
    """Return the error message for a command whose expiry has passed."""
    late = (now.ros - to_nanoseconds(command.expiry)) / NANOSECONDS
    return (
        f"its expiry passed {late:.1f} s ago; check the clocks of the computers and the network,"
        " then send a new tap"
    )
