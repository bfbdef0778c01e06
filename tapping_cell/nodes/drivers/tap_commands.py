"""What arm and tapper both refuse of a tap command, whoever sent it."""

from __future__ import annotations

import math

from rclpy.time import Time
from tapping_cell_msgs.msg import ErrorCode, TapCommand

from tapping_cell.nodes.conversions import is_finite, quaternion_norm

LONGEST_EXPIRY_S = 900.0
"""Longer than all deadlines of a tap together can be set: what lives longer blocks the cell."""
CLOCK_TOLERANCE_S = 1.0
"""How far a command's stamp may lie in the future: clocks of two machines differ a little."""


def refusal(command: TapCommand, now: Time, last_tap_id: int) -> tuple[int, str] | None:
    """Code and sentence where a TAP must not be taken; None where it is sound.

    ``last_tap_id``: the greatest id served so far. A stamp of zero means that none was given.
    """
    if command.request != TapCommand.TAP:
        return (
            ErrorCode.COMMAND_INVALID,
            f"its request {command.request} is neither TAP nor WITHDRAW",
        )
    if command.header.frame_id != "table":
        sentence = f"its frame is '{command.header.frame_id}', but must be 'table'"
        return ErrorCode.COMMAND_INVALID, sentence
    if not (is_finite(command.strike_pose) and math.isfinite(command.striker_speed)):
        return ErrorCode.COMMAND_INVALID, "it holds a number that is not finite"
    if abs(quaternion_norm(command.strike_pose) - 1) > 0.01:
        return ErrorCode.COMMAND_INVALID, "the quaternion of its strike pose has no unit length"
    if command.tap_id <= last_tap_id:
        return (
            ErrorCode.COMMAND_REPEATED,
            f"tap ids rise, and {last_tap_id} was served already; a tap is never served twice",
        )
    ahead = (Time.from_msg(command.header.stamp) - now).nanoseconds * 1e-9
    if ahead > CLOCK_TOLERANCE_S:
        return (
            ErrorCode.STAMP_INVALID,
            f"its stamp lies {ahead:.1f} s in the future; set the machines' clocks",
        )
    left = (Time.from_msg(command.expiry) - now).nanoseconds * 1e-9
    if left > LONGEST_EXPIRY_S:
        return (
            ErrorCode.COMMAND_INVALID,
            f"it expires in {left:.0f} s; the most is {LONGEST_EXPIRY_S:.0f} s",
        )
    return None


def expired(command: TapCommand, now: Time) -> bool:
    """Whether the command's expiry has passed."""
    return bool(now > Time.from_msg(command.expiry))
