"""Data of the arm driver: homing strategies, settings, readings, counters."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from tapping_cell.hardware.scara import Joints


class HomingStrategy(Enum):
    """Method by which the arm's position is established."""

    FIRMWARE = "firmware"
    """The controller's own homing cycle with home switches (``$H``, ``G28``)."""
    MANUAL_POSE = "manual_pose"
    """A person moves the arm to the marked pose, which is then declared as its position."""
    NONE = "none"
    """No homing: the controller knows its position (absolute encoders)."""


@dataclass(frozen=True, slots=True)
class ArmSettings:
    """Wiring, homing and tolerances of the arm, in SI units."""

    axis_sign: tuple[int, int, int, int] = (1, 1, 1, 1)
    """Direction of each controller axis relative to its joint: 1 or -1."""
    home_joints: tuple[float, float, float, float] | None = (0.0, 1.5708, 0.0, 0.0)
    """Joint values at the end of homing or at the marked pose. If None, the values that the
    firmware itself sets are used."""
    homing_timeout: float = 60.0
    """Longest duration of homing, s."""
    reply_timeout: float = 2.0
    """Longest wait for the answer to a request, s."""
    move_factor: float = 1.5
    """The time limit of a move is ``move_factor`` times its computed duration plus
    ``move_margin``."""
    move_margin: float = 2.0
    """Constant part of the time limit of a move, s; see ``move_factor``."""
    tolerance_angle: float = 1e-3
    """Largest difference between a target and the joint angle read back, rad."""
    tolerance_quill: float = 1e-4
    """Largest difference between a target and the quill position read back, m."""
    settle_time: float = 0.15
    """Time for which the arm must rest at the last waypoint of a path before the arm counts as
    arrived, s."""
    quill_brake: bool = False
    """True if a brake or a counterweight holds the quill while its motor has no power."""

    def __post_init__(self) -> None:
        if any(sign not in (1, -1) for sign in self.axis_sign):
            raise ValueError(f"axis_sign {self.axis_sign}: each must be 1 or -1")


@dataclass(frozen=True, slots=True)
class ArmReading:
    """State of the arm, read from the controller."""

    joints: Joints
    moving: bool
    alarm: str
    """Reason why the controller refuses to move; empty if it accepts moves."""
    measured: bool
    """False if the controller can only report the commanded position."""
    stamp: float
    """Time of the transport's steady clock just before the request was sent, s."""


@dataclass(slots=True)
class ArmCounters:
    """Counters for diagnostics."""

    moves: int = 0
    retries: int = 0
    reconnects: int = 0
    stops: int = 0
    last_error: str = ""
