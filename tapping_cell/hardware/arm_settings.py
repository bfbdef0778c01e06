"""What the arm's driver is told and what it tells: homing, tolerances, readings, counts."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from tapping_cell.hardware.scara import Joints


class HomingStrategy(Enum):
    """How the arm learns where it is."""

    FIRMWARE = "firmware"
    """The controller's own cycle with home switches (``$H``, ``G28``)."""
    MANUAL_POSE = "manual_pose"
    """A person has moved the arm to the marked pose; it is declared to be there."""
    NONE = "none"
    """The controller knows its position by itself (absolute encoders)."""


@dataclass(frozen=True, slots=True)
class ArmSettings:
    """The arm's wiring, homing and tolerances; SI."""

    axis_sign: tuple[int, int, int, int] = (1, 1, 1, 1)
    """Direction of each controller axis against the joint: 1 or -1."""
    home_joints: tuple[float, float, float, float] | None = (0.0, 1.5708, 0.0, 0.0)
    """Joints where homing ends or the marked pose stands; None trusts the firmware's own zero."""
    homing_timeout: float = 60.0
    """s."""
    reply_timeout: float = 2.0
    """Longest time without any answer to a question, s."""
    move_factor: float = 1.5
    """A move may take this times its computed duration ..."""
    move_margin: float = 2.0
    """... and this much more, s."""
    tolerance_angle: float = 1e-3
    """Largest difference between a target and the position read back, rad."""
    tolerance_quill: float = 1e-4
    """The same for the quill, m."""
    settle_time: float = 0.15
    """Rest after the last waypoint of a path before it counts as reached, s."""
    quill_brake: bool = False
    """Whether a brake or a counterweight holds the quill while its motor has no power."""

    def __post_init__(self) -> None:
        if any(sign not in (1, -1) for sign in self.axis_sign):
            raise ValueError(f"axis_sign {self.axis_sign}: each must be 1 or -1")


@dataclass(frozen=True, slots=True)
class ArmReading:
    """Where the arm is, read from the controller."""

    joints: Joints
    moving: bool
    alarm: str
    """Empty, or why the controller refuses to move."""
    measured: bool
    """False where the controller can only repeat what it was commanded."""
    stamp: float
    """Time of the transport's steady clock just before the question was sent, s."""


@dataclass(slots=True)
class ArmCounters:
    """Figures for diagnostics."""

    moves: int = 0
    retries: int = 0
    reconnects: int = 0
    stops: int = 0
    last_error: str = ""
