"""States of the planner: the transition table, and a record of the data of each state.

A record exists only while its state lasts, so no data is valid "only while" something else holds.
``tap_cycle`` leads from one record to the next.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

from tapping_cell.logic.cell_monitor import CodedError
from tapping_cell.logic.effects import Effect
from tapping_cell.logic.goal_watch import FINAL_STATES
from tapping_cell.logic.task import Shot, Task
from tapping_cell.logic.transitions import Go, table
from tapping_cell.messages import ErrorCode, PlanState


class State(Enum):
    """States of the planner."""

    IDLE = "Idle"
    WAITING_FOR_CELL = "WaitingForCell"
    LOOKING = "Looking"
    PLANNING = "Planning"
    CONFIRMING = "Confirming"
    PLACING = "Placing"
    FIRING = "Firing"
    SETTLING = "Settling"
    REACHED = "Reached"
    FAILED = "Failed"
    CANCELED = "Canceled"


class Event(Enum):
    """Events of the planner."""

    GOAL_ACCEPTED = "goal accepted"
    CELL_READY = "cell ready"
    CELL_NOT_READY = "cell not ready"
    OBSERVED = "object observed at rest"
    TAP_PROPOSED = "tap proposed"
    TAP_DROPPED = "proposed tap dropped"
    TAP_COMMANDED = "tap commanded"
    IN_POSITION = "arm in position"
    OUTCOME_REPORTED = "tapper reported the outcome"
    GIVEN_UP = "tap given up"
    WITHDRAWN = "arm withdrawn"
    HIDDEN = "object hidden"
    OBSERVATION_REQUESTED = "longer observation requested"
    GOAL_MET = "goal met"
    GOAL_FAILED = "goal failed"
    GOAL_CANCELED = "goal canceled"


S = State
ENDED = (S.IDLE, S.REACHED, S.FAILED, S.CANCELED)
WORKING = (
    S.WAITING_FOR_CELL,
    S.LOOKING,
    S.PLANNING,
    S.CONFIRMING,
    S.PLACING,
    S.FIRING,
    S.SETTLING,
)
TAPPING = (S.PLACING, S.FIRING)
"""States in which the commanded tap may still be fired."""

TABLE = table(
    [
        (ENDED, Event.GOAL_ACCEPTED, (S.WAITING_FOR_CELL,)),
        ((S.WAITING_FOR_CELL,), Event.CELL_READY, (S.LOOKING,)),
        (
            (S.LOOKING, S.PLANNING, S.CONFIRMING, S.PLACING, S.SETTLING),
            Event.CELL_NOT_READY,
            (S.WAITING_FOR_CELL,),
        ),
        ((S.LOOKING,), Event.OBSERVED, (S.PLANNING,)),
        ((S.PLANNING,), Event.OBSERVATION_REQUESTED, (S.LOOKING,)),
        ((S.PLANNING,), Event.TAP_PROPOSED, (S.CONFIRMING,)),
        ((S.CONFIRMING,), Event.TAP_DROPPED, (S.LOOKING,)),
        # With a fixed tapper, no arm moves, so the planner goes to FIRING directly.
        ((S.PLANNING, S.CONFIRMING), Event.TAP_COMMANDED, (S.PLACING, S.FIRING)),
        ((S.PLACING,), Event.IN_POSITION, (S.FIRING,)),
        (TAPPING, Event.OUTCOME_REPORTED, (S.SETTLING,)),
        (TAPPING, Event.GIVEN_UP, (S.SETTLING,)),
        ((S.SETTLING,), Event.WITHDRAWN, (S.LOOKING,)),
        ((S.LOOKING,), Event.HIDDEN, (S.SETTLING,)),
        ((S.PLANNING,), Event.GOAL_MET, (S.REACHED, S.IDLE)),
        (WORKING, Event.GOAL_FAILED, (S.FAILED,)),
        (WORKING, Event.GOAL_CANCELED, (S.CANCELED,)),
    ]
)
WIRE = {state: getattr(PlanState, state.name) for state in State}
WORKING_STATES = tuple(WIRE[state] for state in WORKING)
"""Values of ``plan_state`` while a goal is under way."""
FINAL = tuple(state for state in State if WIRE[state] in FINAL_STATES)


@dataclass(frozen=True, slots=True)
class Resting:
    """No goal is under way."""

    state: State = S.IDLE


@dataclass(frozen=True, slots=True, kw_only=True)
class Working:
    """A goal is under way. ``deadline``: end of the wait in this state, s of the steady clock."""

    state: ClassVar[State]
    task: Task
    deadline: float = math.inf

    def is_late(self, steady: float) -> bool:
        """Return whether the wait has taken too long."""
        return steady > self.deadline


@dataclass(frozen=True, slots=True, kw_only=True)
class BetweenTaps(Working):
    """The planner waits for no tap. One that it gave up may still be fired until the tapper has
    received its withdrawal."""

    shot: Shot | None = None
    """The last tap while its result has not been observed."""
    moved_aside: bool = False
    """Whether the arm was moved aside since the last tap, because the object was not seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WaitingForCell(BetweenTaps):
    """Arm, tapper or camera are not ready."""

    state = S.WAITING_FOR_CELL
    missing: CodedError | None = None
    """What the cell lacks, as last reported."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Looking(BetweenTaps):
    """The camera observes the object at rest."""

    state = S.LOOKING
    since: float
    """Start of the observation, s of the steady clock."""
    struck_at: float = math.inf
    """Time at which a fixed tapper struck the object, s of the steady clock; infinite if none did
    since the cell was ready. Images of a fixed tapper's cell show the result of the tap even before
    the striker has returned."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Planning(Working):
    """A job computes the decision that follows from the observation ``look``."""

    state = S.PLANNING
    look: Looking
    job: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Confirming(Working):
    """A person is asked whether the tap ``proposed`` may be fired."""

    state = S.CONFIRMING
    look: Looking
    proposed: Shot
    answer_by: int
    """Deadline for the answer, ROS time in ns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placing(Working):
    """The tap ``shot`` is commanded, and the arm moves the striker to its strike pose."""

    state = S.PLACING
    shot: Shot


@dataclass(frozen=True, slots=True, kw_only=True)
class Firing(Working):
    """The arm is in position for the tap ``shot``, or there is no arm; the tapper charges and
    fires."""

    state = S.FIRING
    shot: Shot


@dataclass(frozen=True, slots=True, kw_only=True)
class Settling(BetweenTaps):
    """The arm withdraws, so that the camera's view is free."""

    state = S.SETTLING
    struck_at: float = math.inf
    """See :class:`Looking`."""
    moves_until: float = -math.inf
    """Time until which an arm that was told to move aside may not have begun yet, s of the steady
    clock."""


Record = Resting | Working


def shot_of(record: Record) -> Shot | None:
    """Return the last commanded tap while its result has not been observed; None if there is
    none."""
    return record.shot if isinstance(record, BetweenTaps | Placing | Firing) else None


@dataclass(frozen=True, slots=True)
class End:
    """End the goal, with an error code and message."""

    state: State = S.FAILED
    code: int = ErrorCode.NONE
    sentence: str = ""

    @property
    def event(self) -> Event:
        """Event that ends the goal in this way."""
        return {S.FAILED: Event.GOAL_FAILED, S.CANCELED: Event.GOAL_CANCELED}.get(
            self.state, Event.GOAL_MET
        )


def failed(code: int, sentence: str) -> End:
    """Return the failure of the goal."""
    return End(S.FAILED, code, sentence)


Steps = Iterator[Effect | Go[Event, Working] | End]
"""Effects, changes of the record and the end of the goal, carried out in this order."""
