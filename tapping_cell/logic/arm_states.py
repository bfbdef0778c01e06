"""States of the arm: the transition table, and a record of the data of each state in which a tap is
under way or the arm withdraws. ``arm_cycle`` leads from one record to the next."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

from tapping_cell.hardware.scara import Joints, TipPose
from tapping_cell.logic.device import Abandon, Run
from tapping_cell.logic.transitions import Go, table
from tapping_cell.logic.withdrawal import Scene
from tapping_cell.messages import ArmState


class State(Enum):
    """States of the arm."""

    DISCONNECTED = "Disconnected"
    NOT_HOMED = "NotHomed"
    HOMING = "Homing"
    IDLE = "Idle"
    PLACING = "Placing"
    IN_POSITION = "InPosition"
    LEAVING = "Leaving"
    """The tap is over. The arm waits until its job has ended and the arm need not stand still any
    longer."""
    WITHDRAWING = "Withdrawing"
    FOLLOWING = "Following"
    INACTIVE = "Inactive"
    FAULT = "Fault"
    STOPPED = "Stopped"
    CLEARING = "Clearing"


class Event(Enum):
    """Events of the arm."""

    CONNECTED = "connected"
    ACTIVATED = "activated"
    DEACTIVATED = "deactivated"
    HOME = "home"
    HOMED = "homed"
    TAP = "tap"
    PLACED = "placed"
    GIVEN_UP = "withdraw or expiry"
    FREE = "promise over"
    WITHDRAWN = "withdrawn"
    PARK = "withdraw again"
    CLEAR_VIEW = "clear view"
    TRAJECTORY = "trajectory"
    JOG = "jog"
    FOLLOWED = "followed"
    FAILED = "failed"
    STOP = "stop"
    CLEAR = "clear_fault"
    CLEARED = "cleared"
    CLOSED = "closed"


S = State
UNSTOPPED = tuple(state for state in State if state is not S.STOPPED)
TABLE = table(
    [
        ((S.DISCONNECTED,), Event.CONNECTED, (S.NOT_HOMED, S.IDLE, S.INACTIVE)),
        ((S.NOT_HOMED, S.IDLE, S.INACTIVE), Event.ACTIVATED, (S.NOT_HOMED, S.IDLE)),
        # A fault lasts until it is cleared, as a stop does.
        (
            tuple(state for state in UNSTOPPED if state is not S.FAULT),
            Event.DEACTIVATED,
            (S.INACTIVE,),
        ),
        ((S.NOT_HOMED, S.IDLE), Event.HOME, (S.HOMING,)),
        ((S.HOMING,), Event.HOMED, (S.IDLE,)),
        ((S.IDLE,), Event.TAP, (S.PLACING,)),
        ((S.PLACING,), Event.PLACED, (S.IN_POSITION,)),
        ((S.PLACING, S.IN_POSITION), Event.GIVEN_UP, (S.LEAVING,)),
        ((S.LEAVING,), Event.FREE, (S.WITHDRAWING,)),
        ((S.WITHDRAWING,), Event.WITHDRAWN, (S.IDLE,)),
        ((S.IDLE, S.WITHDRAWING), Event.PARK, (S.WITHDRAWING,)),
        ((S.IDLE,), Event.CLEAR_VIEW, (S.WITHDRAWING,)),
        ((S.IDLE,), Event.TRAJECTORY, (S.FOLLOWING,)),
        ((S.IDLE,), Event.JOG, (S.FOLLOWING,)),
        ((S.FOLLOWING,), Event.FOLLOWED, (S.IDLE,)),
        (UNSTOPPED, Event.FAILED, (S.FAULT, S.NOT_HOMED, S.DISCONNECTED)),
        (tuple(State), Event.STOP, (S.STOPPED,)),
        (
            (S.FAULT, S.STOPPED, S.DISCONNECTED, S.NOT_HOMED, S.INACTIVE),
            Event.CLEAR,
            (S.CLEARING,),
        ),
        ((S.CLEARING,), Event.CLEARED, (S.NOT_HOMED, S.IDLE, S.INACTIVE)),
        (UNSTOPPED, Event.CLOSED, (S.DISCONNECTED,)),
    ]
)
WIRE = {
    S.DISCONNECTED: ArmState.DISCONNECTED,
    S.NOT_HOMED: ArmState.NOT_HOMED,
    S.HOMING: ArmState.HOMING,
    S.IDLE: ArmState.IDLE,
    S.PLACING: ArmState.MOVING,
    S.IN_POSITION: ArmState.IN_POSITION,
    S.LEAVING: ArmState.WITHDRAWING,
    S.WITHDRAWING: ArmState.WITHDRAWING,
    S.FOLLOWING: ArmState.MOVING,
    S.INACTIVE: ArmState.FAULT,
    S.FAULT: ArmState.FAULT,
    S.STOPPED: ArmState.STOPPED,
    S.CLEARING: ArmState.FAULT,
}
"""Value of ``arm_state`` for each state."""
HEALTHY = frozenset(
    {S.HOMING, S.IDLE, S.PLACING, S.IN_POSITION, S.LEAVING, S.WITHDRAWING, S.FOLLOWING}
)
AT_WORK = HEALTHY - {S.IDLE}
"""States in which the arm moves, or stands at the strike pose and may move again."""


@dataclass(frozen=True, slots=True)
class Tap:
    """The tap under way."""

    tap_id: int
    expiry: int
    """ROS time, ns."""
    strike: TipPose
    """Pose of the tip for the strike, in ``arm_base``."""
    scene: Scene | None
    """What the camera must see after the tap; None: the arm withdraws to its park pose."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Serving:
    """The arm serves a tap, or withdraws. ``tap_id``: id of the tap; 0 without one."""

    state: ClassVar[State]
    tap_id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Placing(Serving):
    """A job moves the tip to the strike pose."""

    state = S.PLACING
    tap: Tap


@dataclass(frozen=True, slots=True, kw_only=True)
class InPosition(Serving):
    """The tip was read back at the strike pose."""

    state = S.IN_POSITION
    tap: Tap
    joints: Joints
    """Joint values at the strike pose."""
    deviating: int = 0
    """Number of consecutive readings that deviate from these values."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Leaving(Serving):
    """The tap is over, and the arm must not move yet."""

    state = S.LEAVING
    since: float
    """Time of the end of the tap, s of the steady clock."""
    scene: Scene | None
    """What the camera must see after the withdrawal; None: the park pose is the target."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Withdrawing(Serving):
    """A job withdraws the arm."""

    state = S.WITHDRAWING
    scene: Scene | None
    """What the camera must see after the withdrawal; None: the park pose is the target."""
    then_park: bool = False
    """Whether the arm moves on to its park pose."""


Steps = Iterator[Go[Event, Serving] | Run | Abandon]
"""Changes of the record and jobs, carried out in this order."""
