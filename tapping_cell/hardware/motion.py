"""The arm's moves around a tap, as pure functions: raise, travel, lower; back off, raise, park.

Every move is straight in joint space, so a move between two waypoints of one elbow side never
passes the straight elbow. When a pose is only reachable with the other elbow, the side changes in
the raised travel alone, above everything on the table. Below travel height the quill moves alone,
straight up or down. Above it all joints move together, on one straight line between two places at
travel height or higher.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.scara import Joints, ReachCode, ScaraGeometry, TipPose


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """Heights, speeds and the park pose of the tap moves; SI."""

    travel_height: float = 0.060
    """Tip above the table while travelling, m: above every object and the camera's markers."""
    travel_speed: float = 0.8
    """Fraction of the joint speeds while raised."""
    near_speed: float = 0.4
    """Fraction of the joint speeds while lowering, raising and backing off."""
    back_off: float = 0.005
    """Backwards along the line of travel before raising from a strike pose, m."""
    park: tuple[float, float, float, float] = (1.2, 1.2, -0.020, 0.0)
    """Joints where the arm waits out of the camera's view: rad, rad, m, rad."""

    def __post_init__(self) -> None:
        for name in ("travel_speed", "near_speed"):
            value = getattr(self, name)
            if not 0 < value <= 1:
                raise ValueError(f"{name} {value:g} must be in (0, 1]")
        if self.back_off < 0:
            raise ValueError(f"back_off {self.back_off:g} m must not be negative")


@dataclass(frozen=True, slots=True)
class Waypoint:
    """One move in joint space: where to, at which fraction of the joint speeds, and why."""

    joints: Joints
    speed: float
    phase: str
    """``raise``, ``travel``, ``lower`` or ``park``."""
    via: Joints | None = None
    """Passed on the way, straight to it and straight on."""


def strike_path(
    geometry: ScaraGeometry, current: Sequence[float], tip: TipPose, settings: MotionSettings
) -> tuple[Waypoint, ...]:
    """Waypoints from joints ``current`` to the tip pose in ``arm_base``: raise, travel, lower.

    Raises HardwareFault (UNREACHABLE) with the reason of the kinematics; moves of no length are
    left out.
    """
    near = settings.near_speed
    solution = geometry.inverse(tip, near=current)
    if solution.joints is None:
        raise HardwareFault(FaultReason.UNREACHABLE, solution.reason)
    clear = _clear_quill(geometry, settings)
    goal = solution.joints
    return _moves(
        Joints(*current),
        Waypoint(Joints(*current)._replace(quill=max(current[2], clear)), near, "raise"),
        Waypoint(goal._replace(quill=max(goal.quill, clear)), settings.travel_speed, "travel"),
        Waypoint(goal, near, "lower"),
    )


def withdraw_path(
    geometry: ScaraGeometry, current: Sequence[float], settings: MotionSettings
) -> tuple[Waypoint, ...]:
    """Waypoints from joints ``current`` to the park pose: back off while low, raise, travel, park.

    Backing off is left out when the tip is above travel height already or when the pose behind is
    out of reach; it spares a rod that stayed out from rubbing along the object.
    """
    start = Joints(*current)
    steps: list[Waypoint] = []
    here = geometry.forward(start)
    low, via = start, None
    if settings.back_off > 0 and here.z < settings.travel_height:
        behind = here._replace(
            x=here.x - settings.back_off * math.cos(here.yaw),
            y=here.y - settings.back_off * math.sin(here.yaw),
        )
        solution = geometry.inverse(behind, geometry.branch_of(start), near=start)
        if solution.joints is not None:
            # Should the line of this step be lost, the striker rises where it stands: no harm.
            low = via = solution.joints
    park = Joints(*settings.park)
    clear = _clear_quill(geometry, settings)
    raised = low._replace(quill=max(start.quill, clear))
    steps.append(Waypoint(raised, settings.near_speed, "raise", via))
    above = park._replace(quill=max(park.quill, clear))
    steps.append(Waypoint(above, settings.travel_speed, "travel"))
    steps.append(Waypoint(park, settings.near_speed, "park"))
    return _moves(start, *steps)


def move_duration(
    geometry: ScaraGeometry, start: Sequence[float], goal: Sequence[float], speed: float
) -> float:
    """Least time in s of a straight joint-space move from rest to rest at a fraction of the speeds.

    One trapezoid for all joints: along the line the speed is the largest that keeps every joint
    within its speed, the acceleration the largest that keeps every joint within its own.
    """
    distances = [abs(b - a) for a, b in zip(start, goal, strict=True)]
    at_speed = max(d / (v * speed) for d, v in zip(distances, geometry.max_speed, strict=True))
    if at_speed == 0:
        return 0.0
    # Acceleration along the line in 1/s2, with the whole line as the unit of length.
    pull = min(a / d for d, a in zip(distances, geometry.max_acceleration, strict=True) if d > 0)
    ramp = 1 / (at_speed * pull)
    return at_speed + ramp if ramp <= at_speed else 2 * math.sqrt(1 / pull)


def path_duration(
    geometry: ScaraGeometry, start: Sequence[float], path: Sequence[Waypoint]
) -> float:
    """Least time in s of a path with a stop at every place."""
    total, here = 0.0, tuple(start)
    for waypoint in path:
        if waypoint.via is not None:
            total += move_duration(geometry, here, waypoint.via, waypoint.speed)
            here = waypoint.via
        total += move_duration(geometry, here, waypoint.joints, waypoint.speed)
        here = waypoint.joints
    return total


def check_limits(geometry: ScaraGeometry, joints: Sequence[float]) -> None:
    """Raise HardwareFault (OUT_OF_RANGE) when a joint is not finite or outside its limits."""
    code, _ = geometry.limit_excess(joints)
    if code is ReachCode.REACHED:
        return
    if code is ReachCode.NOT_FINITE:
        raise HardwareFault(
            FaultReason.OUT_OF_RANGE, f"joints {tuple(joints)} are not four finite numbers"
        )
    index = code - ReachCode.SHOULDER_LIMIT
    scale, unit = (1e3, "mm") if index == 2 else (180 / math.pi, "deg")
    raise HardwareFault(
        FaultReason.OUT_OF_RANGE,
        f"joint {Joints._fields[index]} at {joints[index] * scale:.2f} {unit} is outside"
        f" {geometry.lower[index] * scale:.2f} to {geometry.upper[index] * scale:.2f} {unit}:"
        " choose a target inside",
    )


def _clear_quill(geometry: ScaraGeometry, settings: MotionSettings) -> float:
    """The quill with the tip at travel height."""
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
    """The waypoints without those that do not move."""
    moves: list[Waypoint] = []
    here = start
    for waypoint in waypoints:
        if max(abs(a - b) for a, b in zip(here, waypoint.joints, strict=True)) > 1e-9:
            moves.append(waypoint)
            here = waypoint.joints
    return tuple(moves)
