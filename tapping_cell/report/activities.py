"""Timeline of a cell's activities, derived from the recorded states of arm, camera and planner."""

from __future__ import annotations

import math
from typing import Any

from tapping_cell.report.bag import Bag
from tapping_cell.report.run import Phase

TRAVELS, LOWERS, CHARGES, SLIDES, WITHDRAWS, MEASURES, PLANS, ASKS = (
    "the arm travels",
    "the arm lowers the striker",
    "the tapper charges and fires",
    "the object slides",
    "the arm withdraws",
    "the camera measures",
    "the planner waits or plans",
    "waiting for confirmation",
)
LOWERED_M = 0.003
"""Descent of the tip during a move, in m, above which the arm is lowering the striker."""
_ARM_MOVING, _ARM_IN_POSITION, _ARM_WITHDRAWING = 4, 5, 6
_PLAN_CONFIRMING, _PLAN_LOOKING = 10, 2


def activities(bag: Bag, began: float, ended: float) -> tuple[Phase, ...]:
    """Return the activities from ``began`` to ``ended`` in s; empty without ``arm_state``."""
    messages: list[tuple[float, str, Any]] = []
    for topic in ("arm_state", "object_state", "plan_state"):
        messages += [(_seconds(m.header.stamp), topic, m) for _, m in bag.of(topic)]
    if not any(topic == "arm_state" for _, topic, _ in messages):
        return ()
    latest: dict[str, Any] = {}
    found: list[Phase] = []
    highest = -math.inf
    for at, topic, message in sorted(messages, key=lambda entry: entry[0]):
        if at > ended:
            break
        latest[topic] = message
        if "arm_state" not in latest:
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
