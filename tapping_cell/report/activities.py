"""Timeline of a cell's activities, derived from the recorded states of its nodes."""

from __future__ import annotations

import math
from typing import Any

from tapping_cell.report.bag import Bag
from tapping_cell.report.run import Phase

TRAVELS, LOWERS, CHARGES, SLIDES, WITHDRAWS, FLIES, MEASURES, PLANS, ASKS = (
    "the arm travels",
    "the arm lowers the striker",
    "the tapper charges and fires",
    "the object slides",
    "the arm withdraws",
    "the striker flies or returns",
    "the camera measures",
    "the planner waits or plans",
    "waiting for confirmation",
)
LOWERED_M = 0.003
"""A move counts as lowering the striker once the tip is lower by this distance, in m, than its
highest point in the move."""
_ARM_MOVING, _ARM_IN_POSITION, _ARM_WITHDRAWING = 4, 5, 6
_TAPPER_CHARGING, _TAPPER_CHARGED, _TAPPER_FIRING = 2, 3, 4
_PLAN_CONFIRMING, _PLAN_LOOKING = 10, 2


def activities(bag: Bag, began: float, ended: float) -> tuple[Phase, ...]:
    """Return the activities from ``began`` to ``ended`` in s; empty if neither ``arm_state`` nor
    the state of fixed tappers was recorded."""
    messages: list[tuple[float, str, Any]] = []
    for topic in ("arm_state", "object_state", "plan_state", "tapper_state"):
        messages += [(_seconds(m.header.stamp), topic, m) for _, m in bag.of(topic)]
    if not any(topic == "arm_state" for _, topic, _ in messages):
        fixed = any(m.fixed_mounts for _, topic, m in messages if topic == "tapper_state")
        return _of_fixed_tappers(messages, began, ended) if fixed else ()
    latest: dict[str, Any] = {}
    found: list[Phase] = []
    highest = -math.inf
    for at, topic, message in sorted(messages, key=lambda entry: entry[0]):
        if at > ended:
            break
        latest[topic] = message
        if "arm_state" not in latest or topic == "tapper_state":
            continue
        if topic == "arm_state":
            height = float(message.tip_pose.position.z)
            highest = max(highest, height) if message.state == _ARM_MOVING else height
        name = _activity(latest)
        lowered = latest["arm_state"].tip_pose.position.z < highest - LOWERED_M
        if name == TRAVELS and lowered:
            name = LOWERS
        if not found or found[-1].name != name:
            found.append(Phase(max(0.0, at - began), name))
        if at < began:
            found = [Phase(0.0, name)]
    return tuple(found)


def _of_fixed_tappers(
    messages: list[tuple[float, str, Any]], began: float, ended: float
) -> tuple[Phase, ...]:
    latest: dict[str, Any] = {}
    found: list[Phase] = []
    for at, topic, message in sorted(messages, key=lambda entry: entry[0]):
        if at > ended:
            break
        latest[topic] = message
        name = _activity_of_fixed_tappers(latest)
        if not found or found[-1].name != name:
            found.append(Phase(max(0.0, at - began), name))
        if at < began:
            found = [Phase(0.0, name)]
    return tuple(found)


def _activity_of_fixed_tappers(latest: dict[str, Any]) -> str:
    tapper, seen, plan = (
        latest.get(name) for name in ("tapper_state", "object_state", "plan_state")
    )
    if plan is not None and plan.state == _PLAN_CONFIRMING:
        return ASKS
    state, outcome = (tapper.state, tapper.outcome) if tapper is not None else (0, 0)
    if state in (_TAPPER_CHARGING, _TAPPER_CHARGED) or (state == _TAPPER_FIRING and not outcome):
        return CHARGES
    if seen is not None and seen.visible and not seen.at_rest:
        return SLIDES
    if state == _TAPPER_FIRING:
        return FLIES
    if plan is not None and plan.state == _PLAN_LOOKING:
        return MEASURES
    return PLANS


def _activity(latest: dict[str, Any]) -> str:
    arm, seen, plan = (latest.get(name) for name in ("arm_state", "object_state", "plan_state"))
    assert arm is not None
    if plan is not None and plan.state == _PLAN_CONFIRMING:
        return ASKS
    if arm.state == _ARM_MOVING:
        return TRAVELS
    if arm.state == _ARM_IN_POSITION:
        return CHARGES
    if seen is not None and seen.visible and not seen.at_rest:
        return SLIDES
    if arm.state == _ARM_WITHDRAWING:
        return WITHDRAWS
    if plan is not None and plan.state == _PLAN_LOOKING:
        return MEASURES
    return PLANS


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec) if stamp is not None else math.nan
