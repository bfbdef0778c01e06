"""Timeline of a cell's activities, derived from the recorded states of its nodes."""

from __future__ import annotations

import math
from typing import Any

from tapping_cell.report.recorded import Bag
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
_OBJECT = "object"
LOWERED_M = 0.003
"""A move counts as lowering the striker once the tip is this distance, in m, below its highest
point in the move."""
_ARM_MOVING, _ARM_IN_POSITION, _ARM_WITHDRAWING = 4, 5, 6
_TAPPER_CHARGING, _TAPPER_CHARGED, _TAPPER_FIRING = 2, 3, 4
_PLAN_CONFIRMING, _PLAN_LOOKING = 10, 2


def seconds_of(stamp: Any) -> float:
    """Return a ROS time in s."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def activities(bag: Bag, began: float, ended: float) -> tuple[Phase, ...]:
    """Return the activities from ``began`` to ``ended`` in s; empty if neither ``arm_state`` nor
    the state of fixed tappers was recorded."""
    messages: list[tuple[float, str, Any]] = []
    for topic in ("arm_state", "plan_state", "tapper_state"):
        messages += [(seconds_of(m.header.stamp), topic, m) for _, m in bag.of(topic)]
    messages += [(seconds_of(m.header.stamp), _OBJECT, m) for m in bag.of_own_object()]
    has_arm = any(topic == "arm_state" for _, topic, _ in messages)
    if not has_arm and not any(getattr(m, "fixed_mounts", False) for _, _, m in messages):
        return ()
    latest: dict[str, Any] = {}
    found: list[Phase] = []
    highest = -math.inf
    for at, topic, message in sorted(messages, key=lambda entry: entry[0]):
        if at > ended:
            break
        latest[topic] = message
        if has_arm and ("arm_state" not in latest or topic == "tapper_state"):
            continue
        name = _activity(latest)
        if has_arm:
            arm = latest["arm_state"]
            height = float(arm.tip_pose.position.z)
            if topic == "arm_state":
                highest = max(highest, height) if arm.state == _ARM_MOVING else height
            if name == TRAVELS and height < highest - LOWERED_M:
                name = LOWERS
        if not found or found[-1].name != name:
            found.append(Phase(max(0.0, at - began), name))
        if at < began:
            found = [Phase(0.0, name)]
    return tuple(found)


def _activity(latest: dict[str, Any]) -> str:
    """Return the activity according to the latest message of each topic."""
    plan, seen = latest.get("plan_state"), latest.get(_OBJECT)
    if plan is not None and plan.state == _PLAN_CONFIRMING:
        return ASKS
    if "arm_state" in latest:
        striking, afterwards = _of_arm(latest["arm_state"])
    else:
        striking, afterwards = _of_fixed_tapper(latest.get("tapper_state"))
    if striking:
        return striking
    if seen is not None and seen.visible and not seen.at_rest:
        return SLIDES
    if afterwards:
        return afterwards
    return MEASURES if plan is not None and plan.state == _PLAN_LOOKING else PLANS


def _of_arm(arm: Any) -> tuple[str, str]:
    """Return the arm's activity before the tap and its activity after the tap; each is empty if
    there is none. The activity after the tap applies only if the object does not slide."""
    before = {_ARM_MOVING: TRAVELS, _ARM_IN_POSITION: CHARGES}
    return before.get(arm.state, ""), WITHDRAWS if arm.state == _ARM_WITHDRAWING else ""


def _of_fixed_tapper(tapper: Any) -> tuple[str, str]:
    """Return the activities of a fixed tapper, as :func:`_of_arm` does for an arm."""
    if tapper is None:
        return "", ""
    firing = tapper.state == _TAPPER_FIRING
    charging = tapper.state in (_TAPPER_CHARGING, _TAPPER_CHARGED)
    return CHARGES if charging or (firing and not tapper.outcome) else "", FLIES if firing else ""
