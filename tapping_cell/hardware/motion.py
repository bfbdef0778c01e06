"""Planning of the arm's moves before a tap (raise, travel, lower) and after it (back off, raise,
park).

Every move is straight in joint space, so a move between two waypoints on the same elbow side never
passes the singular pose with a straight elbow. If a pose is reachable only with the other elbow
side, the side changes during the raised travel, above everything on the table. Below travel height
the quill moves alone, straight up or down. Above travel height all joints move together, on one
straight line between two points at travel height or higher.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.scara import (
    JOINT_LIMITS,
    Branch,
    Joints,
    ReachCode,
    ScaraGeometry,
    TipPose,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """Heights, speeds and the park pose of the tap moves, in SI units."""

    travel_height: float = 0.060
    """Height of the tip above the table while travelling, m; higher than every object and camera
    marker."""
    travel_speed: float = 0.8
    """Fraction of the maximum joint speeds while raised."""
    near_speed: float = 0.4
    """Fraction of the maximum joint speeds while backing off and at the end of lowering."""
    near_height: float = 0.015
    """Height above the strike pose at which lowering slows to ``near_speed``, m."""
    back_off: float = 0.005
    """Backward distance along the line of travel before raising from a strike pose, m."""
    park: tuple[float, float, float, float] = (1.2, 1.2, -0.020, 0.0)
    """Joints where the arm waits outside the camera's view: rad, rad, m, rad."""

    def __post_init__(self) -> None:
        for name in ("travel_speed", "near_speed"):
            value = getattr(self, name)
            if not 0 < value <= 1:
                raise ValueError(f"{name} {value:g} must be in (0, 1]")
        if self.back_off < 0:
            raise ValueError(f"back_off {self.back_off:g} m must not be negative")


@dataclass(frozen=True, slots=True)
class Waypoint:
    """One move in joint space: target, fraction of the maximum joint speeds, and phase."""

    joints: Joints
    speed: float
    phase: str
    """``raise``, ``travel``, ``lower`` or ``park``."""
    via: Joints | None = None
    """Intermediate joints; the moves to and from them are straight."""
    via_speed: float | None = None
    """Fraction of the maximum joint speeds up to ``via``; None uses ``speed``."""


def strike_path(
    geometry: ScaraGeometry,
    current: Sequence[float],
    tip: TipPose,
    settings: MotionSettings,
    hides: Callable[[Joints], bool] = lambda joints: False,
) -> tuple[Waypoint, ...]:
    """Return the waypoints from joints ``current`` to the tip pose in ``arm_base``.

    The path is raise, travel, lower; moves of zero length are left out. The elbow changes its side
    if the tip pose requires it, or if the arm ``hides`` the object on its present side only. Raises
    HardwareFault (UNREACHABLE) with the reason from the kinematics.
    """
    near = settings.near_speed
    solution = geometry.inverse(tip, near=current)
    goal = solution.joints
    if goal is None:
        raise HardwareFault(FaultReason.UNREACHABLE, solution.reason)
    if hides(goal):
        other = next(side for side in Branch if side is not solution.branch)
        flipped = geometry.inverse(tip, other, near=current)
        if flipped.joints is not None and not hides(flipped.joints):
            goal = flipped.joints
    clear = _clear_quill(geometry, settings)
    above = goal._replace(quill=max(goal.quill, clear))
    fast = settings.travel_speed
    slow_from = goal._replace(quill=goal.quill + settings.near_height)
    brief = slow_from.quill >= above.quill - 1e-9
    # The descent is fast down to `slow_from` and slow below it. If the command for the fast part is
    # lost, the whole descent is slow, which is harmless.
    lower = Waypoint(goal, near, "lower", None if brief else slow_from, None if brief else fast)
    return _moves(
        Joints(*current),
        Waypoint(Joints(*current)._replace(quill=max(current[2], clear)), near, "raise"),
        Waypoint(above, fast, "travel"),
        lower,
    )


def strike_durations(
    geometry: ScaraGeometry, current: ArrayLike, tips: ArrayLike, settings: MotionSettings
) -> Array:
    """Return ``path_duration`` of many strike paths from joints (..., 4) to tip poses (..., 4). The
    two arrays are broadcast; the duration is infinite for an unreachable pose."""
    start, tip = np.broadcast_arrays(
        np.asarray(current, dtype=float), np.asarray(tips, dtype=float)
    )
    negative = start[..., 1] + geometry.joint_offset[1] < 0
    sides = [geometry.inverse_many(tip, side, start).joints for side in Branch]
    own, other = (np.where(negative[..., None], *pair) for pair in (sides[::-1], sides))
    goal = np.where(np.isfinite(own), own, other)
    clear = _clear_quill(geometry, settings)
    raised, above, slow = start.copy(), goal.copy(), goal.copy()
    raised[..., 2] = np.maximum(start[..., 2], clear)
    above[..., 2] = np.maximum(goal[..., 2], clear)
    slow[..., 2] = np.minimum(goal[..., 2] + settings.near_height, above[..., 2])
    near, fast = settings.near_speed, settings.travel_speed
    moves = ((start, raised, near), (raised, above, fast), (above, slow, fast), (slow, goal, near))
    total = sum(move_durations(geometry, *move) for move in moves)
    return np.asarray(np.where(np.isfinite(goal[..., 0]), total, np.inf))


def withdraw_path(
    geometry: ScaraGeometry, current: Sequence[float], settings: MotionSettings
) -> tuple[Waypoint, ...]:
    """Return the waypoints from joints ``current`` to the park pose: back off if low, raise,
    travel, park."""
    park = Joints(*settings.park)
    above = park._replace(quill=max(park.quill, _clear_quill(geometry, settings)))
    return _moves(
        Joints(*current),
        raise_step(geometry, current, settings),
        Waypoint(above, settings.travel_speed, "travel"),
        Waypoint(park, settings.near_speed, "park"),
    )


def clear_view_path(
    geometry: ScaraGeometry,
    current: Sequence[float],
    target: Sequence[float],
    settings: MotionSettings,
) -> tuple[Waypoint, ...]:
    """Return the path from ``current`` to ``target`` at travel height: back off, raise, travel."""
    return _moves(
        Joints(*current),
        raise_step(geometry, current, settings),
        Waypoint(Joints(*target), settings.travel_speed, "travel"),
    )


def raise_step(
    geometry: ScaraGeometry, current: Sequence[float], settings: MotionSettings
) -> Waypoint:
    """Return the waypoint that moves the striker backwards from joints ``current``, then up to
    travel height.

    Backing off along the line of travel keeps a striker that is still extended from rubbing along
    the object. The step backwards is left out if the tip is already above travel height, or if the
    pose behind is out of reach.
    """
    start = Joints(*current)
    here = geometry.forward(start)
    low, via = start, None
    if settings.back_off > 0 and here.z < settings.travel_height:
        behind = here._replace(
            x=here.x - settings.back_off * math.cos(here.yaw),
            y=here.y - settings.back_off * math.sin(here.yaw),
        )
        solution = geometry.inverse(behind, geometry.branch_of(start), near=start)
        if solution.joints is not None:
            # If the command for this step backwards is lost, the striker only rises vertically,
            # which is harmless.
            low = via = solution.joints
    raised = low._replace(quill=max(start.quill, _clear_quill(geometry, settings)))
    # Only the step backwards is close to the object, so the arm may be raised fast.
    return Waypoint(raised, settings.travel_speed, "raise", via, settings.near_speed)


def move_duration(
    geometry: ScaraGeometry, start: Sequence[float], goal: Sequence[float], speed: float
) -> float:
    """Return the shortest time in s of a straight joint-space move from rest to rest.

    All joints follow one trapezoidal profile. Its speed and acceleration along the line are the
    largest that keep every joint within its limits. ``speed``: fraction of the maximum joint
    speeds.
    """
    return float(move_durations(geometry, start, goal, speed))


def move_durations(
    geometry: ScaraGeometry, start: ArrayLike, goal: ArrayLike, speed: float
) -> Array:
    """Return ``move_duration`` of many moves. ``start`` and ``goal`` (..., 4) are broadcast; the
    duration is NaN where one of them is NaN."""
    distances = np.abs(np.asarray(goal, dtype=float) - np.asarray(start, dtype=float))
    at_speed = np.max(distances / (np.array(geometry.max_speed) * speed), axis=-1)
    # Reciprocal of the acceleration along the move. Lengths are fractions of the whole move,
    # without a unit, so the unit of the reciprocal is s^2.
    pull = np.max(distances / np.array(geometry.max_acceleration), axis=-1)
    ramp = pull / np.where(at_speed > 0, at_speed, 1.0)
    return np.where(ramp <= at_speed, at_speed + ramp, 2 * np.sqrt(pull))


def speed_for(
    geometry: ScaraGeometry, start: Sequence[float], goal: Sequence[float], duration: float
) -> float:
    """Return the speed at which a move as in :func:`move_duration` takes ``duration`` s, as a
    fraction of the maximum joint speeds; 1 if the move takes longer than that even at full speed.
    """
    distances = np.abs(np.asarray(goal, dtype=float) - np.asarray(start, dtype=float))
    at_full_speed = float(np.max(distances / np.array(geometry.max_speed)))
    pull = float(np.max(distances / np.array(geometry.max_acceleration)))
    if at_full_speed == 0.0 or duration**2 <= 4.0 * pull:
        return 1.0
    # The duration is x + pull / x, where x is the time of the move without its ramps.
    without_ramps = 0.5 * (duration + math.sqrt(duration**2 - 4.0 * pull))
    return min(1.0, at_full_speed / without_ramps)


def path_duration(
    geometry: ScaraGeometry, start: Sequence[float], path: Sequence[Waypoint]
) -> float:
    """Return the shortest time in s of a path with a stop at every waypoint."""
    total, here = 0.0, tuple(start)
    for waypoint in path:
        if waypoint.via is not None:
            speed = waypoint.speed if waypoint.via_speed is None else waypoint.via_speed
            total += move_duration(geometry, here, waypoint.via, speed)
            here = waypoint.via
        total += move_duration(geometry, here, waypoint.joints, waypoint.speed)
        here = waypoint.joints
    return total


def check_limits(geometry: ScaraGeometry, joints: Sequence[float]) -> None:
    """Raise HardwareFault (OUT_OF_RANGE) if a joint is not finite or outside its limits."""
    code, _ = geometry.limit_excess(joints)
    if code is ReachCode.REACHED:
        return
    if code is ReachCode.NOT_FINITE:
        raise HardwareFault(
            FaultReason.OUT_OF_RANGE, f"joints {tuple(joints)} are not four finite numbers"
        )
    index = JOINT_LIMITS.index(code)
    scale, unit = (1e3, "mm") if index == 2 else (180 / math.pi, "deg")
    raise HardwareFault(
        FaultReason.OUT_OF_RANGE,
        f"joint {Joints._fields[index]} at {joints[index] * scale:.2f} {unit} is outside"
        f" {geometry.lower[index] * scale:.2f} to {geometry.upper[index] * scale:.2f} {unit}:"
        " choose a target inside",
    )


def _clear_quill(geometry: ScaraGeometry, settings: MotionSettings) -> float:
    """Return the quill value at which the tip is at travel height."""
    clear = settings.travel_height - geometry.tip_height
    if clear > geometry.upper[2] + 1e-9:
        raise HardwareFault(
            FaultReason.OUT_OF_RANGE,
            f"travel height {settings.travel_height * 1e3:.1f} mm needs the quill at"
            f" {clear * 1e3:.1f} mm, above its limit of {geometry.upper[2] * 1e3:.1f} mm:"
            " lower travel_height",
        )
    return clear


def _moves(start: Joints, *waypoints: Waypoint) -> tuple[Waypoint, ...]:
    """Return the waypoints without moves of zero length."""
    moves: list[Waypoint] = []
    here = start
    for waypoint in waypoints:
        if max(abs(a - b) for a, b in zip(here, waypoint.joints, strict=True)) > 1e-9:
            moves.append(waypoint)
            here = waypoint.joints
    return tuple(moves)
