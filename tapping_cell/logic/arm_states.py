"""States of the arm, and the transition table."""

from __future__ import annotations

from enum import Enum

from tapping_cell.logic.transitions import table
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
