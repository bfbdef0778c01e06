"""How the taps of a goal count that were not fired or had no effect, and what arm and tapper report
of a tap."""

from __future__ import annotations

import math

from tapping_cell.logic.cell_monitor import CellMonitor, CodedError
from tapping_cell.logic.clock import Now
from tapping_cell.logic.confirmation import Confirmations
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.task import MIN_EFFECT, Shot, Task
from tapping_cell.messages import ArmState, ErrorCode, TapperState
from tapping_cell.se2 import Pose

GIVEN_UP = (
    "no tap could be fired, because the object was moved each time before the tap, or because arm"
    " or tapper was restarted; see the log of tap_planner"
)
"""Error message for a goal whose taps were given up before they were fired."""
LATE = frozenset(
    (
        ErrorCode.ARM_SILENT,
        ErrorCode.CAMERA_SILENT,
        ErrorCode.NOT_READY,
        ErrorCode.TAPPER_ARM_NOT_IN_POSITION,
    )
)
"""The tapper's codes for a tap that was not fired because a message or image came too late."""


def note_position(shot: Shot, monitor: CellMonitor) -> None:
    """Store that the arm was in position for this tap."""
    arm = monitor.arm
    if arm is not None and arm.tap_id == shot.tap_id:
        shot.in_position = shot.in_position or arm.state == ArmState.IN_POSITION


def note_outcome(shot: Shot, monitor: CellMonitor, confirmations: Confirmations, now: Now) -> None:
    """Store the outcome that the tapper reports of this tap, possibly after the planner has given
    up the tap."""
    tapper = monitor.tapper_of(shot.tap_id)
    if tapper is None or tapper.outcome == TapperState.NONE:
        return
    shot.outcome = tapper.outcome
    if shot.outcome == TapperState.NOT_FIRED and tapper.error_code not in (0, *LATE):
        confirmations.withdraw(tapper.error_msg)
    if math.isfinite(tapper.measured_speed):
        shot.measured_speed = tapper.measured_speed
    if shot.fired_at is None:
        shot.fired_at = now.ros


def may_have_been_fired(shot: Shot, has_arm: bool) -> bool:
    """Return whether a tap of the past was or may have been fired. If the tapper has lost the
    outcome, for example by a restart, the tap was not fired unless the arm was in position."""
    if shot.outcome == TapperState.UNKNOWN:
        return shot.in_position or not has_arm
    return shot.outcome != TapperState.NOT_FIRED


def count_unfired(task: Task, shot: Shot, settings: PlannerSettings, *, is_late: bool) -> bool:
    """Count a tap that was commanded and not fired, once. Return whether no further tap is made:
    another attempt is as safe as the first, but their number is limited."""
    if shot.counted:
        return False
    shot.counted = True
    task.late += is_late
    task.not_fired += not is_late
    return task.not_fired >= settings.attempts or task.late >= settings.late_attempts


def tap_limit_error(task: Task, settings: PlannerSettings, pose: Pose | None) -> CodedError | None:
    """Return why no further tap is made, or None if a further tap may be made. ``pose``: present
    pose of the object, None while it is not seen."""
    if task.without_effect >= settings.attempts:
        return (
            ErrorCode.TAP_WITHOUT_EFFECT,
            f"{task.without_effect} taps in a row moved the object by less than"
            f" {100 * MIN_EFFECT:.0f} % of the wanted distance; check that the striker hits"
            " it at the right height, and calibrate arm and tapper",
        )
    if task.taps >= task.max_taps:
        distance, rotation = task.residual(pose)
        return (
            ErrorCode.TAP_LIMIT_REACHED,
            f"the object is not at the goal after {task.taps} of at most"
            f" {task.max_taps} taps; {1000 * distance:.2f} mm and"
            f" {math.degrees(rotation):.2f} deg remain; allow more taps, or"
            " check the striker, the camera and the object's file",
        )
    return None
