"""States of the tapper: the transition table, and a record of the data of each state in which a tap
is under way. ``tapper_cycle`` leads from one record to the next."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

from tapping_cell.logic.device import Abandon, Run
from tapping_cell.logic.effects import Effect
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.logic.transitions import Go, table
from tapping_cell.messages import TapperState
from tapping_cell.se2 import Pose


class State(Enum):
    """States of the tapper."""

    DISCONNECTED = "Disconnected"
    SAFE = "Safe"
    WAITING = "Waiting"
    """A tap is accepted and the arm is moving to its strike pose."""
    CHARGING = "Charging"
    CHARGED = "Charged"
    """The arm is still lowering the striker, or ``hold_still`` was called."""
    FIRING = "Firing"
    RETURNING = "Returning"
    """A striker at a fixed mount was released and has not returned yet."""
    DISCHARGING = "Discharging"
    FAULT = "Fault"
    STOPPED = "Stopped"
    CLEARING = "Clearing"


class Event(Enum):
    """Events of the tapper."""

    CONNECTED = "connected"
    TAP = "tap"
    ARM_READY = "arm above or at the strike pose"
    CHARGED = "charged"
    HELD = "arm holds still"
    FIXED = "mount is fixed"
    RELEASED = "released from a fixed mount"
    RETURNED = "striker is back"
    GIVEN_UP = "given up"
    ENDED = "ended"
    FAILED = "failed"
    STOP = "stop"
    CLEAR = "clear_fault"
    CLEARED = "cleared"
    CLOSED = "closed"


S = State
UNSTOPPED = tuple(state for state in State if state is not S.STOPPED)
TABLE = table(
    [
        ((S.DISCONNECTED,), Event.CONNECTED, (S.SAFE, S.STOPPED)),
        ((S.SAFE,), Event.TAP, (S.WAITING,)),
        ((S.WAITING,), Event.ARM_READY, (S.CHARGING,)),
        ((S.CHARGING,), Event.CHARGED, (S.CHARGED,)),
        ((S.CHARGED,), Event.HELD, (S.FIRING,)),
        ((S.CHARGED,), Event.FIXED, (S.FIRING,)),
        ((S.FIRING,), Event.RELEASED, (S.RETURNING,)),
        ((S.RETURNING,), Event.RETURNED, (S.SAFE,)),
        ((S.WAITING,), Event.GIVEN_UP, (S.SAFE,)),
        ((S.CHARGING, S.CHARGED, S.FIRING), Event.GIVEN_UP, (S.DISCHARGING,)),
        ((S.CHARGING, S.FIRING, S.DISCHARGING), Event.ENDED, (S.SAFE,)),
        (UNSTOPPED, Event.FAILED, (S.FAULT, S.DISCONNECTED, S.STOPPED)),
        (tuple(State), Event.STOP, (S.STOPPED,)),
        ((S.FAULT, S.STOPPED, S.DISCONNECTED), Event.CLEAR, (S.CLEARING,)),
        ((S.CLEARING,), Event.CLEARED, (S.SAFE,)),
        (tuple(State), Event.CLOSED, (S.DISCONNECTED,)),
    ]
)
WIRE = {
    S.DISCONNECTED: TapperState.DISCONNECTED,
    S.SAFE: TapperState.SAFE,
    S.WAITING: TapperState.SAFE,
    S.CHARGING: TapperState.CHARGING,
    S.CHARGED: TapperState.CHARGED,
    S.FIRING: TapperState.FIRING,
    S.RETURNING: TapperState.FIRING,
    S.DISCHARGING: TapperState.CHARGED,
    S.FAULT: TapperState.FAULT,
    S.STOPPED: TapperState.STOPPED,
    S.CLEARING: TapperState.STOPPED,
}
"""Value of ``tapper_state`` for each state."""


@dataclass(frozen=True, slots=True)
class Tap:
    """The tap under way."""

    tap_id: int
    channel: int
    """Channel of the striking tapper, counted across the boards."""
    energy: float
    """J."""
    expiry: int
    """ROS time, ns."""
    planned: Pose
    """Pose of the object for which the tap was planned."""
    strike: Pose
    """Pose of the tip for the strike. An arm moves it there; a fixed tapper is always there."""
    flight: float
    """Time from the release of the striker to the end of its stroke, s; the arm stands still during
    this time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Serving:
    """A tap is under way. ``given_up``: why it ends without being fired, once that is certain for
    every shot that has not begun."""

    state: ClassVar[State]
    tap: Tap
    given_up: CodedError | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Waiting(Serving):
    """The tap is accepted and waits for the arm."""

    state = S.WAITING
    obstacle: CodedError | None = None
    """Why the tap waits, apart from the arm's way to its strike pose."""
    obstacle_since: float = math.inf
    """Time at which the obstacle was first found, s of the steady clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Charging(Serving):
    """A job charges the striker."""

    state = S.CHARGING


@dataclass(frozen=True, slots=True, kw_only=True)
class Charged(Serving):
    """The striker is charged, and the arm is asked to stand still once it is in position."""

    state = S.CHARGED
    charged_at: float
    """End of charging, s of the steady clock."""
    attempts: int = 0
    """Number of calls of ``hold_still`` for this tap."""
    asked_at: float = -math.inf
    """Time of the last call of ``hold_still``, s of the steady clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Firing(Serving):
    """A job fires. ``still_until``: end of the arm's promise to stand still for this tap, s of the
    steady clock; infinite for a tapper at a fixed mount, which cannot move."""

    state = S.FIRING
    still_until: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Discharging(Serving):
    """A job discharges the striker, or the job that charges it ends by discharging it."""

    state = S.DISCHARGING


@dataclass(frozen=True, slots=True)
class Over:
    """The tap is over and the tapper is at rest; ``error`` is reported."""

    event: Event
    outcome: int
    error: CodedError


Steps = Iterator[Effect | Go[Event, Serving] | Run | Abandon | Over]
"""Effects, changes of the record and jobs, carried out in this order."""
