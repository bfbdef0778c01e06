"""Animation of a run that consists only of SVG and CSS, so that every browser can play it."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.report.palette import GOAL, REST, START, STRIKE
from tapping_cell.report.run import Run
from tapping_cell.report.svg import Plan, stroke
from tapping_cell.se2 import Array, Pose, transform_points

TAP_S = 2.0
"""Duration of each tap in the animation, in s."""
END_S = 2.0
"""Duration of the final state before the animation restarts, in s."""
APPROACH, SLIDE = 0.25, 0.55
"""Fractions of ``TAP_S`` at which the striker arrives, and at which the object has stopped."""
ARROW_MM = 42.0


def animation(run: Run, plan: Plan) -> str:
    """Draw the animation into a plan of the table; return "" if no tap has a measured result."""
    taps = [tap for tap in run.taps if tap.seen]
    if run.first.start is None or not taps:
        return ""
    outline = np.asarray(run.first.outline, dtype=float).reshape(-1, 2)
    total = TAP_S * len(taps) + END_S
    if run.first.goal is not None:
        plan.outline(outline, run.first.goal, GOAL, dashed=True, fill=0.15)
    plan.outline(outline, taps[0].before, START)
    frames = [_frame(0.0, taps[0].before, taps[0].before.theta)]
    turned = taps[0].before.theta
    style = []
    for index, tap in enumerate(taps):
        begin = TAP_S * index / total
        share = TAP_S / total
        frames.append(_frame(begin + APPROACH * share, tap.before, turned, "ease-out"))
        turned += tap.before.rotation_to(tap.measured)
        frames.append(_frame(begin + SLIDE * share, tap.measured, turned))
        _add_arrow(plan, tap.strike, index)
        style.append(
            f"@keyframes strike{index}{{0%,{_percent(begin)}{{opacity:0}}"
            f"{_percent(begin + 0.6 * APPROACH * share)},{_percent(begin + SLIDE * share)}"
            f"{{opacity:1}}{_percent(begin + 0.9 * share)},100%{{opacity:0}}}}"
            f"#strike{index}{{animation:strike{index} {total:.1f}s linear infinite}}"
        )
    frames.append(_frame(1.0, taps[-1].measured, turned))
    style.append(
        f"@keyframes object{{{''.join(frames)}}}#moving{{animation:object {total:.1f}s linear "
        "infinite}@media (prefers-reduced-motion:reduce){#moving,[id^=strike]{animation:none}}"
        "@media print{#moving,[id^=strike]{animation:none}}"
    )
    _add_object(plan, outline, taps[-1].measured)
    plan.scale_bar()
    plan.axes()
    return f"<style>{''.join(style)}</style>{plan.drawing('the run, tap by tap, as a film')}"


def _frame(at: float, pose: Pose, angle: float, easing: str = "") -> str:
    """Return the CSS key frame at the fraction ``at`` of the animation. ``angle`` is used instead
    of the angle of ``pose``, because it includes full turns."""
    timing = f";animation-timing-function:{easing}" if easing else ""
    return f"{_percent(at)}{{transform:{_transform(pose, angle)}{timing}}}"


def _transform(pose: Pose, angle: float) -> str:
    x, y = 1000 * pose.x, -1000 * pose.y
    return f"translate({x:.2f}px,{y:.2f}px) rotate({-math.degrees(angle):.3f}deg)"


def _percent(share: float) -> str:
    return f"{100 * share:.3f}%"


def _add_object(plan: Plan, outline: Array, resting: Pose) -> None:
    """Add the object that the animation moves. Without animation, as in print, it is at the pose
    ``resting``."""
    with plan.group(f'id="moving" style="transform:{_transform(resting, resting.theta)}"'):
        middle = Pose(0.0, 0.0, 0.0)
        plan.polygon(1000 * transform_points(middle, outline), f'fill="{REST}" fill-opacity="0.35"')
        plan.outline(outline, middle, REST)


def _add_arrow(plan: Plan, strike: Pose, index: int) -> None:
    along = np.array([math.cos(strike.theta), math.sin(strike.theta)])
    tip = 1000 * np.array([strike.x, strike.y])
    with plan.group(f'id="strike{index}"'):
        plan.strike(strike, index + 1, ARROW_MM, 0.8)
        plan.polygon([tip, tip + 6 * along], stroke(STRIKE, 0.4 * plan.unit, True), closed=False)
