"""Manual steps of the arm in set-up mode: limits of a step, and the joints at its end."""

from __future__ import annotations

import math

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.hardware.motion import check_limits
from tapping_cell.hardware.scara import REVOLUTE, Joints
from tapping_cell.logic.error_codes import of_arm
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.messages import ErrorCode, Jog

LARGEST_STEP_M = 0.010
LARGEST_STEP_RAD = math.radians(5.0)
LARGEST_JOINT_CHANGE_RAD = math.radians(20.0)
"""Maximum change of a joint by a step of the tip. Near a straight or folded elbow, a small step
needs large angles, and at its limit the tool would turn once around."""
OLDEST_READING_S = 1.0
"""Maximum age of the measured position from which a step is computed, s."""
_SLACK = 1e-9
AXES = {
    **{axis: (Jog.Request.TIP, index) for index, axis in enumerate(("x", "y", "z", "yaw"))},
    **{joint: (Jog.Request.JOINTS, index) for index, joint in enumerate(Joints._fields)},
}
"""Kind and index among the four numbers of a step, by the name of the axis or joint."""
LENGTHS = {Jog.Request.JOINTS: (2,), Jog.Request.TIP: (0, 1, 2)}
"""Indices of the lengths among the four numbers of a step; the others are angles."""


def is_length(axis: str) -> bool:
    """Return whether a step along this axis of ``AXES`` is a length, not an angle."""
    kind, index = AXES[axis]
    return index in LENGTHS[kind]


def request(axis: str, step: float) -> Jog.Request:
    """Return the request for a step, in m or rad, along an axis of ``AXES``."""
    kind, index = AXES[axis]
    return Jog.Request(kind=kind, step=[step if index == each else 0.0 for each in range(4)])


def target(cell: Cell, here: Joints, request: Jog.Request) -> Joints | CodedError:
    """Return the joints after a step of the joints or the tip from ``here``, or why the step is
    refused."""
    if (invalid := _invalid(request)) is not None:
        return invalid
    geometry = cell.arm.geometry()
    step = [float(value) for value in request.step]
    if request.kind == Jog.Request.JOINTS:
        goal = Joints(*(a + b for a, b in zip(here, step, strict=True)))
    else:
        tip, yaw = geometry.forward(here), cell.arm_base.theta
        x = math.cos(yaw) * step[0] + math.sin(yaw) * step[1]
        y = -math.sin(yaw) * step[0] + math.cos(yaw) * step[1]
        pose = (tip.x + x, tip.y + y, tip.z + step[2], tip.yaw + step[3])
        solution = geometry.inverse(pose, geometry.branch_of(here), near=here)
        if solution.joints is None:
            return ErrorCode.ARM_OUT_OF_REACH, solution.reason
        goal = solution.joints
        change = max(abs(goal[index] - here[index]) for index in REVOLUTE)
        if change > LARGEST_JOINT_CHANGE_RAD:
            return (
                ErrorCode.ARM_JOINT_LIMIT,
                f"this step of the tip turns a joint by {math.degrees(change):.0f} deg (limit "
                f"{math.degrees(LARGEST_JOINT_CHANGE_RAD):.0f} deg); step the joints instead",
            )
    try:
        check_limits(geometry, goal)
    except HardwareFault as fault:
        return of_arm(fault), fault.sentence
    return goal


def _invalid(request: Jog.Request) -> CodedError | None:
    """Return why the numbers of a request are refused, or None."""
    if request.kind not in LENGTHS:
        return (
            ErrorCode.COMMAND_INVALID,
            f"the kind {request.kind} of the jog is none of JOINTS, TIP and PARK",
        )
    for index, value in enumerate(request.step):
        length = index in LENGTHS[request.kind]
        limit = LARGEST_STEP_M if length else LARGEST_STEP_RAD
        if not abs(value) <= limit + _SLACK:
            scale, unit = (1e3, "mm") if length else (180.0 / math.pi, "deg")
            shown, most = f"{scale * value:g} {unit}", f"{scale * limit:g} {unit}"
            axis = next(name for name, at in AXES.items() if at == (request.kind, index))
            return (
                ErrorCode.COMMAND_INVALID,
                f"the step of {axis} is {shown}; a step is at most {most}",
            )
    return None
