"""Duties of the node that measures the object's pose (``camera_pose``).

They are observed beside the running cell, with the object at rest in view.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from tapping_cell.conformance.stage import FRAME, Duty, Stage, Steps, check_rate
from tapping_cell.logic.clock import to_nanoseconds
from tapping_cell.logic.poses import covariance_from_message, from_message
from tapping_cell.messages import ObjectState, ObjectStates

NODE = "camera_pose"
STATES = "object_states"
LISTENS = (STATES,)
"""Topics of the node that the checks need."""
PLAYS = ()
"""Topics that the checks publish."""
OBSERVED_S = 4.0
DEVIATIONS = 5.0
"""Maximum deviation of a pose from the first one, in stated standard deviations."""


def begin(stage: Stage) -> Steps:
    """Wait until the object is seen at rest."""
    if not (yield from stage.until(lambda: stage.last(STATES), 5.0)):
        return "it publishes no object_states"

    def at_rest() -> bool:
        state = _own(stage, stage.last(STATES))
        return bool(state.visible and state.at_rest)

    if not (yield from stage.until(at_rest, 10.0)):
        why = _own(stage, stage.last(STATES)).error_msg or "it moves"
        return f"it does not show the object at rest ({why}); put the object into view"
    return ""


def _own(stage: Stage, message: ObjectStates) -> ObjectState:
    """Return the state of the cell's own object; that of another object if it has none."""
    name = stage.cell.object.name
    named = (state for state in message.objects if state.object_id == name)
    return next(named, next(iter(message.objects), ObjectState()))


def _each(judge: Callable[[Stage, ObjectState], str]) -> Callable[[Stage], Steps]:
    """Return a check of each state within ``OBSERVED_S``; ``judge`` returns what is wrong."""

    def check(stage: Stage) -> Steps:
        begun = stage.now()
        yield from stage.pause(OBSERVED_S)
        found = stage.received(STATES, begun)
        wrong = (judge(stage, _own(stage, message)) for _, message in found)
        return next(filter(None, wrong), "" if found else f"no {STATES}")

    check.__doc__ = judge.__doc__
    return check


def _reports(stage: Stage) -> Steps:
    """Publishes `object_states` for each image, at least every 0.45 s, stamped with the exposure;
    no stamp twice."""
    if found := (yield from check_rate(stage, STATES, 0.45, 0.45)):
        return found
    stamps = [to_nanoseconds(message.header.stamp) for _, message in stage.received(STATES)]
    return "" if len(set(stamps)) == len(stamps) else "two messages have the same stamp"


def _named(stage: Stage, state: ObjectState) -> str:
    """The frame is `table`, and `object_id` the name in the object file."""
    if state.header.frame_id != FRAME:
        return f"its frame is '{state.header.frame_id}', not 'table'"
    if state.object_id != stage.cell.object.name:
        return f"object_id is '{state.object_id}', not '{stage.cell.object.name}'"
    return ""


def _valid(stage: Stage, state: ObjectState) -> str:
    """A visible object has no error, a finite pose, and a positive covariance; an invisible one has
    an error or `hidden_by_arm`."""
    if not state.visible:
        explained = state.hidden_by_arm or (state.error_code and state.error_msg)
        return "" if explained else "not visible, with neither an error nor hidden_by_arm"
    if state.error_code:
        return f"visible with the error {state.error_code}"
    covariance = covariance_from_message(state.pose.covariance)
    if not all(map(math.isfinite, (*from_message(state.pose.pose), *covariance.flat))):
        return "a pose or covariance is not finite"
    if np.linalg.eigvalsh(covariance).min() <= 0.0 or not np.allclose(covariance, covariance.T):
        return "a covariance is not symmetric and positive"
    return ""


def _rests(stage: Stage, state: ObjectState) -> str:
    """An object at rest has `frames_fused` of at least 1, and `at_rest_since` before the stamp."""
    if not (state.visible and state.at_rest):
        return ""
    since = to_nanoseconds(state.at_rest_since)
    if state.frames_fused < 1 or not 0 < since <= to_nanoseconds(state.header.stamp):
        return f"at rest with {state.frames_fused} frames, since {since} ns"
    return ""


def _stated(stage: Stage) -> Steps:
    """Poses at rest differ by no more than their covariances state."""
    begun = stage.now()
    yield from stage.pause(OBSERVED_S)
    states = (_own(stage, message) for _, message in stage.received(STATES, begun))
    found = [state for state in states if state.visible and state.at_rest]
    if len(found) < 2:
        return "the object did not stay at rest"
    first = from_message(found[0].pose.pose)
    spread = covariance_from_message(found[0].pose.covariance)
    for state in found[1:]:
        pose = from_message(state.pose.pose)
        off = np.array([pose.x - first.x, pose.y - first.y, first.rotation_to(pose)])
        both = spread + covariance_from_message(state.pose.covariance)
        if off @ np.linalg.solve(both, off) > DEVIATIONS**2:
            return (
                f"two poses at rest differ by {1e3 * math.hypot(*off[:2]):.3f} mm and"
                f" {math.degrees(off[2]):.3f} deg, more than {DEVIATIONS:.0f} stated deviations"
            )
    return ""


def _lists(stage: Stage) -> Steps:
    """`object_states` has one state for each object of the cell."""
    begun = stage.now()
    yield from stage.pause(1.0)
    found = stage.received(STATES, begun)
    if not found:
        return "it publishes no object_states"
    names = [state.object_id for state in found[-1][1].objects]
    if stage.cell.object.name not in names or len(set(names)) != len(names):
        return f"object_states has {names}"
    return ""


DUTIES = (
    Duty("C1", _reports),
    Duty("C2", _each(_named)),
    Duty("C3", _each(_valid)),
    Duty("C4", _each(_rests)),
    Duty("C5", _stated),
    Duty("C6", _lists),
)
