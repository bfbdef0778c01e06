"""From a decision to the command of a tap, with a person's confirmation between them if wanted."""

from __future__ import annotations

from dataclasses import replace

from tapping_cell.logic import tap_counts
from tapping_cell.logic.clock import NANOSECONDS, Now
from tapping_cell.logic.effects import Log, LogLevel
from tapping_cell.logic.goal_validation import REFUSALS
from tapping_cell.logic.planner_states import (
    Confirming,
    End,
    Event,
    Firing,
    Looking,
    Placing,
    Planning,
    Record,
    State,
    Steps,
    failed,
)
from tapping_cell.logic.tap_counts import LATE
from tapping_cell.logic.tap_steps import PlannerParts, wait_again
from tapping_cell.logic.task import Shot, Task
from tapping_cell.logic.transitions import Go
from tapping_cell.messages import ConfirmTap, ErrorCode, ObjectState
from tapping_cell.planning import Decision, Done, ObserveAgain, Refusal, RefusalReason, Strike
from tapping_cell.se2 import Pose


def act(
    at: Looking | Planning, decision: Decision, seen: ObjectState, parts: PlannerParts, now: Now
) -> Steps:
    """Carry out a decision that is based on the observation ``seen``."""
    task = at.task
    yield from _turn_to_object(task, parts)
    if isinstance(decision, Refusal):
        # If the tap is refused only because the object's pose is too uncertain, continue the
        # observation, because every further image reduces the uncertainty.
        is_coarse = decision.reason is RefusalReason.CAMERA_TOO_COARSE
        if not is_coarse or at.is_late(now.steady):
            yield failed(REFUSALS[decision.reason], decision.sentence)
            return
    if isinstance(decision, ObserveAgain | Refusal):
        if isinstance(at, Planning):  # fuse more images
            yield Go(Event.OBSERVATION_REQUESTED, at.look)
        return
    look = at.look if isinstance(at, Planning) else at
    if isinstance(at, Looking):
        at = Planning(task=task, look=look)
        yield Go(Event.OBSERVED, at)
    if isinstance(decision, Done):
        yield End(State.IDLE if task.prescribed else State.REACHED)
        return
    error = tap_counts.tap_limit_error(task, parts.settings, parts.monitor.pose_of(task.object_id))
    if error is not None:
        yield failed(*error)
    elif parts.monitor.why_not_ready(now) is not None:
        yield from wait_again(at, parts, now)
    else:
        yield from _plan(look, decision, task.before(seen), parts, now)


def _turn_to_object(task: Task, parts: PlannerParts) -> Steps:
    """Watch the object that is tapped now; warn about other objects that taps have moved."""
    parts.monitor.watch(task.object_id)
    names, task.touched = task.touched, []
    if names:
        yield Log(
            LogLevel.WARNING,
            f"{', '.join(map(repr, names))} moved although another object was tapped; "
            "the next move is planned again",
        )


def _plan(look: Looking, strike: Strike, before: Pose, parts: PlannerParts, now: Now) -> Steps:
    """Command or propose one tap."""
    task = look.task
    covariance = task.session.predicted_covariance(strike, before)
    parts.monitor.begin_track()
    shot = Shot(
        parts.sender.next_id(now),
        task.object_id,
        task.taps + 1,
        strike,
        before,
        covariance,
        purpose=task.purpose,
    )
    if strike.detour:
        yield Log(LogLevel.INFO, f"tap {shot.number}: {strike.detour}")
    is_confirmed = not parts.confirmations.asks(task)
    if not is_confirmed:
        is_confirmed, sentence = parts.confirmations.holds(shot, now.steady)
        if sentence:
            yield Log(LogLevel.INFO, sentence)
    if is_confirmed:
        yield from command(task, shot, parts, now)
        return
    patience = parts.settings.confirm_deadline
    yield Log(LogLevel.INFO, f"tap {shot.number} waits for confirmation (id {shot.tap_id})")
    yield Go(
        Event.TAP_PROPOSED,
        Confirming(
            task=task,
            deadline=now.steady + patience,
            look=look,
            proposed=shot,
            answer_by=now.ros + round(patience * NANOSECONDS),
        ),
    )


def not_awaited(tap_id: int, at: Record) -> ConfirmTap.Response:
    """Return the response to an answer for a tap that is not proposed now."""
    waiting = "no tap is waiting"
    if isinstance(at, Confirming):
        waiting = f"answer for tap {at.proposed.tap_id} instead"
    return ConfirmTap.Response(
        error_code=ErrorCode.TAP_NOT_AWAITED,
        error_msg=f"tap {tap_id} is not waiting for confirmation; {waiting}",
    )


def answered(
    at: Confirming, is_confirmed: bool, parts: PlannerParts, now: Now
) -> tuple[ConfirmTap.Response, Steps]:
    """Return the response to a person's answer, and what follows from the answer."""
    shot, task, monitor = at.proposed, at.task, parts.monitor
    accepted = ConfirmTap.Response(accepted=True)
    if not is_confirmed and task.prescribed:
        rejected = failed(ErrorCode.TAP_NOT_CONFIRMED, "a person rejected the single tap")
        return accepted, iter((rejected,))
    if not is_confirmed:
        task.skip(shot.strike)
        return accepted, drop_proposal(at, "it was skipped", parts, now)
    missing, needed = monitor.why_not_ready(now), parts.settings.frames_needed
    if missing is not None:
        steps = wait_again(at, parts, now)
    elif not task.observed(monitor, at.look.since, needed, now):
        missing = monitor.why_not_observed(None, needed, now)
        why = "the object has not been observed at rest in enough images"
        steps = drop_proposal(at, why, parts, now)
    else:
        parts.confirmations.confirm(shot, now.steady)
        return accepted, command(task, shot, parts, now)
    code, sentence = missing
    if code in LATE:
        parts.confirmations.confirm(shot, now.steady)
        return accepted, steps
    again = f"tap {shot.number} is planned again: {sentence}"
    return ConfirmTap.Response(error_code=code, error_msg=again), steps


def drop_proposal(at: Confirming, why: str, parts: PlannerParts, now: Now) -> Steps:
    """Drop the proposed tap, observe the object again and plan another tap."""
    shot = at.proposed
    yield Log(LogLevel.INFO, f"tap {shot.number} (id {shot.tap_id}) is planned again: {why}")
    deadline = now.steady + parts.settings.observe_deadline
    yield Go(Event.TAP_DROPPED, replace(at.look, since=now.steady, deadline=deadline))


def command(task: Task, shot: Shot, parts: PlannerParts, now: Now) -> Steps:
    """Command one tap."""
    settings = parts.settings
    # First, so that no crash loses the tap.
    yield from parts.resumption.keep(task, now, is_tapping=True)
    allowance = settings.place_deadline + settings.fire_deadline
    yield parts.sender.tap(shot, allowance, parts.goals.cell.strike_height, now)
    if parts.monitor.has_arm:
        deadline = now.steady + settings.place_deadline
        yield Go(Event.TAP_COMMANDED, Placing(task=task, deadline=deadline, shot=shot))
    else:
        deadline = now.steady + settings.fire_deadline
        yield Go(Event.TAP_COMMANDED, Firing(task=task, deadline=deadline, shot=shot))
