"""The cycle of one tap, one function for each state.

    wait for the cell -> look -> plan -> (confirm) -> place -> fire -> settle -> look -> ...

Each function takes the record of the present state and the time, and yields effects, the record of
the next state (``Go``), or the end of the goal (``End``). The caller carries them out in this
order. ``tap_decision`` leads from a decision to the command of a tap, ``tap_steps`` has the steps
that several states share. If the outcome of a tap is not known, the object is observed again. No
tap is fired twice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from tapping_cell.logic import tap_counts
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import Job, Log, LogLevel, RunJob
from tapping_cell.logic.planner_states import (
    Confirming,
    Event,
    Firing,
    Looking,
    Placing,
    Planning,
    Settling,
    Steps,
    WaitingForCell,
    Working,
    failed,
)
from tapping_cell.logic.tap_counts import GIVEN_UP
from tapping_cell.logic.tap_decision import act, drop_proposal
from tapping_cell.logic.tap_steps import (
    MOVED_BEFORE_TAP,
    PlannerParts,
    check_cell,
    disturbed,
    give_up,
    moved_limits,
    new_look,
    not_observed,
    obstacles_changed,
    postpone,
    take_in,
    take_outcome,
    try_another_way,
    wait_again,
)
from tapping_cell.logic.transitions import Go
from tapping_cell.messages import ErrorCode, ObjectState, TapperState


def advance(at: Working, parts: PlannerParts, now: Now) -> Steps:
    """Do what follows in the present state from the messages received so far and the time."""
    task = at.task
    if now.steady > task.expires:
        yield failed(
            ErrorCode.DEADLINE_EXCEEDED,
            f"the goal was not reached within its time limit ({task.taps} finished"
            f" taps, last state {at.state.value}); send it again with a longer time limit",
        )
    elif not isinstance(at, Planning):  # its decision is received by ``decided``
        yield from HANDLERS[type(at)](at, parts, now)


def wait_for_cell(at: WaitingForCell, parts: PlannerParts, now: Now) -> Steps:
    """Wait until arm, tapper and camera are ready; end a tap left over from a former run."""
    missing = parts.monitor.why_not_ready(now)
    if missing is None:
        yield Go(Event.CELL_READY, new_look(at, parts, now))
        return
    unhomed = parts.monitor.homing_error()
    if at.task.is_resumed and unhomed is not None:
        # The arm may have been stopped while no planner ran. Homing must not continue the goal.
        yield failed(*unhomed)
        return
    yield from parts.sender.withdraw_orphan(now)
    if at.is_late(now.steady):
        code, sentence = missing
        yield failed(code, f"the cell was not ready: {sentence}")
    elif missing != at.missing:
        yield Go(None, replace(at, missing=missing))


def look(at: Looking, parts: PlannerParts, now: Now) -> Steps:
    """Observe the object at rest, evaluate the last tap, and decide on the next tap."""
    task, monitor, needed = at.task, parts.monitor, parts.settings.frames_needed
    # After a fixed tapper's tap, the object may be at rest before the striker has returned.
    has_rested = monitor.at_rest_after(at.struck_at, now)
    is_observed = task.observed(monitor, at.struck_at if has_rested else at.since, needed, now)
    seen = monitor.object
    if seen is None or not is_observed:
        yield from not_observed(at, parts, now)
        return
    if not task.ready:
        yield postpone(at, parts, now)
        return
    shot, at = at.shot, replace(at, shot=None)
    if shot is not None:
        # Before the obstacles change, because the model of the tap belongs to the present ones.
        if tap_counts.may_have_been_fired(shot, monitor.has_arm):
            yield from take_in(task, shot, seen, parts)
            yield Go(None, at)  # from here on, the tap's record counts
        else:
            yield Go(None, at)
            if tap_counts.count_unfired(task, shot, parts.settings, is_late=True):
                yield failed(ErrorCode.NOT_READY, GIVEN_UP)
                return
            yield from parts.resumption.keep(task, now, is_tapping=False)
    # While the arm may hide a part of the table, the camera does not search for unknown objects.
    search_since = at.since if monitor.is_withdrawn(now) else -math.inf
    unknown = parts.goals.update_free_space(task, at.since, search_since, now)
    if unknown is not None:
        if at.is_late(now.steady):
            yield failed(*unknown)
        return
    if not task.ready:  # other obstacles need another solution
        yield postpone(at, parts, now)
        return
    task.arm = monitor.tip
    frames = 0 if at.is_late(now.steady) else needed
    computation = task.computation(frames)
    if computation is None:
        yield from act(at, task.decide(seen, frames), seen, parts, now)
        return
    # The decision is computed by a job outside the lock, so that the planner keeps publishing its
    # state.
    number = next(parts.jobs)
    yield RunJob(Job(number, "plan", lambda _: computation()))
    yield Go(Event.OBSERVED, Planning(task=task, deadline=at.deadline, look=at, job=number))


def decided(at: Planning, result: Any, seen: ObjectState, parts: PlannerParts, now: Now) -> Steps:
    """Act on the decision that a job has computed, unless an object was moved meanwhile."""
    task = at.task
    outdated = task.outdated(parts.monitor, result, *moved_limits(parts))
    if outdated or obstacles_changed(task, parts):
        deadline = now.steady + parts.settings.observe_deadline
        yield Go(Event.OBSERVATION_REQUESTED, replace(at.look, deadline=deadline))
    else:
        yield from act(at, task.conclude(result), seen, parts, now)


def wait_for_person(at: Confirming, parts: PlannerParts, now: Now) -> Steps:
    """Wait until a person confirms or rejects the proposed tap; drop the proposal if an object
    moves."""
    if parts.monitor.is_disconnected(now):
        yield from wait_again(at, parts, now)
    elif disturbed(at.task, at.proposed, parts, now):
        yield from drop_proposal(at, "an object was moved", parts, now)
    elif at.is_late(now.steady):
        yield failed(
            ErrorCode.TAP_NOT_CONFIRMED,
            f"tap {at.proposed.number} was not confirmed within"
            f" {parts.settings.confirm_deadline:.0f} s; send the goal again and answer on the"
            " page or in the terminal",
        )


def wait_for_arm(at: Placing, parts: PlannerParts, now: Now) -> Steps:
    """Wait until the arm has moved the striker to its strike pose."""
    shot, monitor = at.shot, parts.monitor
    if disturbed(at.task, shot, parts, now):
        # arm_state may be late, so the tap may already have been fired. Only the tapper knows.
        yield Log(LogLevel.WARNING, MOVED_BEFORE_TAP)
        parts.confirmations.withdraw("an object was moved")
        yield from give_up(at, TapperState.UNKNOWN, parts, now)
    elif (unreachable := monitor.reach_error(shot.tap_id)) is not None:
        yield from try_another_way(at, *unreachable, parts, now)
    elif monitor.outcome(shot.tap_id) != TapperState.NONE:
        yield from take_outcome(at, parts, now)
    elif monitor.in_position(shot.tap_id):
        deadline = now.steady + parts.settings.fire_deadline
        yield Go(Event.IN_POSITION, Firing(task=at.task, deadline=deadline, shot=shot))
    else:
        limit = parts.settings.place_deadline
        sentence = f"the striker did not reach its strike pose within {limit:.0f} s"
        yield from check_cell(at, ErrorCode.ARM_TIMEOUT, sentence, parts, now)


def wait_for_tapper(at: Firing, parts: PlannerParts, now: Now) -> Steps:
    """Wait until the tapper has charged and fired once."""
    shot, monitor = at.shot, parts.monitor
    if monitor.outcome(shot.tap_id) != TapperState.NONE:
        yield from take_outcome(at, parts, now)
        return
    if disturbed(at.task, shot, parts, now):
        # Either an object was moved before the tap, or the tap itself moved the object and the
        # tapper's report has not arrived yet. In both cases, the tap is withdrawn, and the tapper
        # still reports the outcome.
        parts.confirmations.withdraw("an object was moved")
        yield from parts.sender.withdraw(shot.tap_id, now)
    if at.is_late(now.steady) or monitor.is_disconnected(now):
        yield Log(LogLevel.WARNING, "the tap's outcome is not known; observing the object")
        yield from give_up(at, TapperState.UNKNOWN, parts, now)


def settle(at: Settling, parts: PlannerParts, now: Now) -> Steps:
    """Wait until the arm has withdrawn and the camera has a free view."""
    if parts.monitor.is_withdrawn(now) and now.steady >= at.moves_until:
        yield Go(Event.WITHDRAWN, new_look(at, parts, now))
        return
    missing = "arm did not withdraw" if parts.monitor.has_arm else "striker did not return"
    sentence = f"the {missing} within {parts.settings.withdraw_deadline:.0f} s"
    yield from check_cell(at, ErrorCode.ARM_TIMEOUT, sentence, parts, now)


HANDLERS: Mapping[type[Working], Callable[[Any, PlannerParts, Now], Steps]] = {
    WaitingForCell: wait_for_cell,
    Looking: look,
    Confirming: wait_for_person,
    Placing: wait_for_arm,
    Firing: wait_for_tapper,
    Settling: settle,
}
