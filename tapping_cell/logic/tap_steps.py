"""Steps that several states of the planner share, and what each of them needs of the cell."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from tapping_cell.logic import tap_counts
from tapping_cell.logic.arrangement import ArrangementTask
from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now
from tapping_cell.logic.confirmation import Confirmations
from tapping_cell.logic.effects import Effect, Log, LogLevel
from tapping_cell.logic.goal_handling import GoalHandling
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.planner_states import (
    BetweenTaps,
    Confirming,
    Event,
    Firing,
    Looking,
    Placing,
    Planning,
    Record,
    Settling,
    Steps,
    WaitingForCell,
    Working,
    failed,
    shot_of,
)
from tapping_cell.logic.poses import from_message
from tapping_cell.logic.resumption import Resumption
from tapping_cell.logic.tap_counts import LATE
from tapping_cell.logic.tap_sender import PARKING_S, TapSender
from tapping_cell.logic.task import Shot, Task
from tapping_cell.logic.transitions import Go
from tapping_cell.messages import ErrorCode, ObjectState, TapperState

WITHDRAWN_BY_ANOTHER = (
    ErrorCode.NOT_READY,
    "another program ended the tap before it was fired; check which other nodes publish "
    "tap_command or tapper_state",
)
"""Error to report if a tap was not fired although the tapper reports no error."""
MOVED_BEFORE_TAP = "an object was moved before the tap; observing again"
HIDDEN_S = 0.7
"""Maximum time, s, for which the object may be unseen after the withdrawal. After this time, the
arm moves aside, because the arm may hide the object."""


@dataclass(frozen=True, slots=True)
class PlannerParts:
    """What the planner's parts beside the cycle offer to it."""

    settings: PlannerSettings
    monitor: CellMonitor
    goals: GoalHandling
    sender: TapSender
    confirmations: Confirmations
    resumption: Resumption
    jobs: Iterator[int]
    """Numbers of the jobs."""


def new_look(at: WaitingForCell | Settling, parts: PlannerParts, now: Now) -> Looking:
    """Return a new observation."""
    return Looking(
        task=at.task,
        deadline=now.steady + parts.settings.observe_deadline,
        shot=at.shot,
        moved_aside=at.moved_aside,
        since=now.steady,
        struck_at=at.struck_at if isinstance(at, Settling) else math.inf,
    )


def postpone(at: Looking, parts: PlannerParts, now: Now) -> Go[Event, Working]:
    """Postpone the deadline of the observation while a solver still computes the solution for the
    goal. The goal's time limit still applies."""
    return Go(None, replace(at, deadline=now.steady + parts.settings.observe_deadline))


def not_observed(at: Looking, parts: PlannerParts, now: Now) -> Steps:
    """Continue or end an observation without a usable image."""
    settings, monitor = parts.settings, parts.monitor
    if monitor.silent("object", now):
        # The camera's node may be restarting, so wait until the cell is ready again.
        yield from wait_again(at, parts, now)
        return
    unseen = min(now.steady - at.since, monitor.unseen_for(now))
    if monitor.has_arm and not at.moved_aside and unseen > HIDDEN_S:
        yield from _move_arm_aside(at, parts, now)
    elif at.is_late(now.steady):
        needed, waited = settings.frames_needed, settings.observe_deadline
        yield failed(*monitor.why_not_observed(waited, needed, now, at.moved_aside))


def _move_arm_aside(at: Looking, parts: PlannerParts, now: Now) -> Steps:
    """Move the arm, because the arm may hide the object. First move the arm to its park pose.
    If the object is still not seen, move the arm to a pose that uncovers the area that the arm
    hides."""
    is_last = not parts.sender.may_park
    if is_last:
        yield Log(
            LogLevel.WARNING,
            "the object is not seen; moving the arm aside in case it hides the object",
        )
        yield parts.sender.clear_view(now)
    else:
        yield from parts.sender.park(now)
    yield Go(
        Event.HIDDEN,
        Settling(
            task=at.task,
            deadline=now.steady + parts.settings.withdraw_deadline,
            shot=at.shot,
            moved_aside=is_last,
            struck_at=at.struck_at,
            moves_until=now.steady + PARKING_S,
        ),
    )


def take_in(task: Task, shot: Shot, seen: ObjectState, parts: PlannerParts) -> Steps:
    """Record and learn from a tap that was fired or may have been fired."""
    parts.confirmations.forget()
    task.take_in(shot, seen, parts.monitor.track(seen))
    warning = task.session.edge_warning(from_message(seen.pose.pose))
    if warning:
        yield Log(LogLevel.WARNING, warning)


def try_another_way(at: Placing, code: int, sentence: str, parts: PlannerParts, now: Now) -> Steps:
    """Plan a tap from another direction, because the present tap is out of the arm's reach."""
    task, shot = at.task, at.shot
    task.skip(shot.strike)
    parts.confirmations.withdraw(sentence)
    # The arm will not be in position for this tap, so the tapper cannot fire it.
    shot.outcome = shot.outcome or TapperState.NOT_FIRED
    if tap_counts.count_unfired(task, shot, parts.settings, is_late=False):
        yield failed(code, sentence)
        return
    yield Log(LogLevel.WARNING, f"tap {shot.number}: {sentence}; planning another tap")
    yield from give_up(at, TapperState.NOT_FIRED, parts, now)


def take_outcome(at: Placing | Firing, parts: PlannerParts, now: Now) -> Steps:
    """Process the outcome that the tapper reported."""
    task, shot = at.task, at.shot
    tapper = parts.monitor.tapper_of(shot.tap_id)
    assert tapper is not None
    was_withdrawn = parts.sender.is_withdrawn(shot)
    yield from parts.sender.withdraw(shot.tap_id, now)
    if shot.outcome == TapperState.NOT_FIRED and was_withdrawn and not tapper.error_code:
        yield Log(LogLevel.WARNING, MOVED_BEFORE_TAP)
    elif shot.outcome == TapperState.NOT_FIRED:
        code, sentence = tapper.error_code, tapper.error_msg
        if not code:
            code, sentence = WITHDRAWN_BY_ANOTHER
            parts.confirmations.withdraw(sentence)
        yield Log(LogLevel.WARNING, f"tap not fired: {sentence}")
        if parts.monitor.has_arm and code == ErrorCode.OBJECT_NOT_SEEN:
            # On its way to this strike pose, the arm itself may hide the object, so choose another
            # tap.
            task.skip(shot.strike)
        is_late = tapper.error_code in LATE
        if tap_counts.count_unfired(task, shot, parts.settings, is_late=is_late):
            yield failed(code, sentence)
            return
    else:
        task.not_fired = task.late = 0
    yield Go(Event.OUTCOME_REPORTED, _settle(at, parts, now))


def give_up(at: Placing | Firing, outcome: int, parts: PlannerParts, now: Now) -> Steps:
    """Give up the tap under way and have the arm withdraw. ``outcome``: outcome of the tap unless
    the tapper reports it."""
    at.shot.outcome = at.shot.outcome or outcome
    yield from parts.sender.withdraw(at.shot.tap_id, now)
    yield Go(Event.GIVEN_UP, replace(_settle(at, parts, now), struck_at=math.inf))


def _settle(at: Placing | Firing, parts: PlannerParts, now: Now) -> Settling:
    """Return the wait for the withdrawal after a tap."""
    shot = at.shot
    is_struck = not parts.monitor.has_arm and shot.outcome == TapperState.FIRED
    return Settling(
        task=at.task,
        deadline=now.steady + parts.settings.withdraw_deadline,
        shot=shot,
        struck_at=now.steady + shot.strike.plan.flight if is_struck else math.inf,
    )


def check_cell(at: Working, code: int, sentence: str, parts: PlannerParts, now: Now) -> Steps:
    """End a wait for arm or tapper if the connection to a driver is lost, if the arm has lost its
    reference, or if the deadline has passed."""
    if parts.monitor.is_disconnected(now):
        yield from wait_again(at, parts, now)
    elif (unhomed := parts.monitor.homing_error()) is not None:
        yield failed(*unhomed)
    elif at.is_late(now.steady):
        device = "arm" if parts.monitor.has_arm else "tapper"
        yield failed(code, f"{sentence}; check the {device}, then send the goal again")


def wait_again(at: Working, parts: PlannerParts, now: Now) -> Steps:
    """End the tap and wait until the cell is ready again."""
    yield from end_tap(at, parts.sender, now)
    before = at.look if isinstance(at, Planning | Confirming) else at
    yield Go(
        Event.CELL_NOT_READY,
        WaitingForCell(
            task=at.task,
            deadline=now.steady + parts.settings.ready_deadline,
            shot=shot_of(before),
            moved_aside=isinstance(before, BetweenTaps) and before.moved_aside,
        ),
    )


def end_tap(at: Record, sender: TapSender, now: Now) -> Iterator[Effect]:
    """Withdraw the tap under way, if any. Its outcome is unknown until the tapper reports it."""
    if isinstance(at, Placing | Firing):
        yield from sender.withdraw(at.shot.tap_id, now)
        at.shot.outcome = at.shot.outcome or TapperState.UNKNOWN


def moved_limits(parts: PlannerParts) -> tuple[float, float]:
    """Distance (m) and angle (rad) beyond which an object counts as moved."""
    return parts.settings.moved_limit, parts.settings.turned_limit


def disturbed(task: Task, shot: Shot, parts: PlannerParts, now: Now) -> bool:
    """Return whether the present object or another object was moved since the tap was planned."""
    limits = moved_limits(parts)
    if parts.monitor.seen_away_from(shot.before, *limits):
        return True
    if isinstance(task, ArrangementTask):
        return task.others_moved(parts.monitor, *limits) or obstacles_changed(task, parts)
    return parts.goals.others_moved(task, now)


def obstacles_changed(task: Task, parts: PlannerParts) -> bool:
    """Return whether the areas of unknown objects differ from those of the last decision."""
    if not isinstance(task, ArrangementTask):
        return False
    return task.obstacles != parts.goals.objects.unknown
