"""``report.html``: the report of one run in one file, for screens, phones and printing."""

from __future__ import annotations

import math
from datetime import datetime

import numpy as np

from tapping_cell.report import activities, palette
from tapping_cell.report.learnt_words import launch_words, learnt_words, object_of
from tapping_cell.report.palette import GOAL, PREDICTED, REST, START
from tapping_cell.report.photograph import photograph
from tapping_cell.report.rendering import render, unbroken
from tapping_cell.report.replay import player
from tapping_cell.report.residual_charts import residual_charts
from tapping_cell.report.run import (
    CANCELED,
    FAILED,
    NOT_TRULY_REACHED,
    REFUSED,
    Learnt,
    Run,
    TapRow,
)
from tapping_cell.report.run_reader import IllustratedRun
from tapping_cell.report.svg import MOUNT_MM, NAME_BEHIND_MM, Plan, window
from tapping_cell.report.tap_words import tap_sentence
from tapping_cell.report.velocity_chart import velocity_chart
from tapping_cell.report.words import counted, motion, remaining_error
from tapping_cell.se2 import Array, Pose, transform_points

SHORTEST_SHOWN_S = 0.05
_HEADLINES = {
    NOT_TRULY_REACHED: "Measured at the goal, but the true pose is outside the tolerance",
    FAILED: "Goal failed",
    CANCELED: "Goal canceled",
    REFUSED: "Goal refused",
}
_COLOURS = {
    # of the devices' activities
    activities.TRAVELS: palette.PREDICTED,
    activities.LOWERS: palette.LOWERING,
    activities.CHARGES: palette.STRIKE,
    activities.SLIDES: palette.SLIDING,
    activities.WITHDRAWS: palette.WITHDRAWING,
    activities.FLIES: palette.PREDICTED,
    activities.MEASURES: palette.REST,
    activities.PLANS: palette.WAITING,
    activities.ASKS: palette.CONFIRMING,
    # of the planner's states
    "waiting for the cell": palette.WAITING,
    "looking": palette.REST,
    "planning": palette.PLANNING,
    "placing the striker": palette.PREDICTED,
    "firing": palette.STRIKE,
    "waiting for rest": palette.SLIDING,
}


def page(illustrated: IllustratedRun) -> str:
    """Return the page of a run, which loads no other files."""
    run, pictures = illustrated.run, illustrated.pictures
    return render(
        "run.html",
        run=run,
        headline=headline(run),
        failed=run.outcome in (FAILED, NOT_TRULY_REACHED),
        task=_task(run),
        details=_details(run),
        results=_results(run),
        overview=overview(run),
        last_image=photograph(pictures[-1]) if pictures else None,
        replay=player(run, illustrated.tracks, _replay_plan(run)),
        charts=residual_charts([run], [REST]),
        timeline=_timeline(run),
        taps=[_tap(run, tap, illustrated) for tap in run.taps],
        versions=[f"{name} {version}" for name, version in run.versions.items()],
    )


def headline(run: Run) -> str:
    """Summarise the outcome of a run in a few words."""
    taps = counted(len(run.taps), "tap")
    if run.reached:
        return f"Goal reached in {taps}" if run.taps else "Goal reached without a tap"
    headline_text = _HEADLINES.get(run.outcome, "The end of the goal was not recorded")
    return f"{headline_text} after {taps}" if run.taps else headline_text


def _task(run: Run) -> str:
    if run.first.start is None or run.first.goal is None:
        return ""
    return unbroken(f"Started {remaining_error(run.first.start, run.first.goal)} from the goal.")


def _details(run: Run) -> list[str]:
    when = "time unknown"
    if math.isfinite(run.began):
        when = datetime.fromtimestamp(run.began).strftime("%d %B %Y, %H:%M:%S")
    words = (when, run.first.name, run.planner and f"planner {run.planner}")
    return [word for word in words if word]


def _results(run: Run) -> list[tuple[str, str, str]]:
    """Return name, value and note of every main result."""
    limit, turn = 1000 * run.first.tolerance[0], math.degrees(run.first.tolerance[1])
    results = []
    for name, pose in (("measured", run.first.end), ("true", run.first.end_true)):
        if pose is not None and run.first.goal is not None:
            off = 1000 * pose.distance_to(run.first.goal)
            angle = math.degrees(abs(pose.rotation_to(run.first.goal)))
            results.append((f"{name} distance", f"{off:.2f} mm", f"tolerance {limit:g} mm"))
            results.append((f"{name} rotation", f"{angle:.2f} deg", f"tolerance {turn:g} deg"))
    taps = len(run.taps)
    each = f"{run.wall_time / taps:.1f} s per tap" if taps else "no tap was made"
    results.append(("taps", str(taps), each))
    results.append(("time", f"{run.wall_time:.1f} s", "from goal to end"))
    return results


def _outline(run: Run) -> Array:
    return np.asarray(run.first.outline, dtype=float).reshape(-1, 2)


def _table_plan(run: Run) -> Plan:
    """Create a plan of the table that contains all poses of the run."""
    half = 500 * np.asarray(run.table_size)
    measured = (tap.measured for tap in run.taps if tap.seen)
    places = [pose for pose in (run.first.start, run.first.goal, *measured) if pose]
    low, high = -half - 12, half + 12
    if run.first.goal is not None and half.any():
        # A rejected goal may be outside the table, so the plan is extended to the goal, up to four
        # times the table's size.
        rim = 1000 * float(np.max(np.hypot(*_outline(run).T), initial=0.02)) + 12
        middle = 1000 * np.array([run.first.goal.x, run.first.goal.y])
        near = np.clip(middle, 4 * low, 4 * high)
        low, high = np.minimum(low, near - rim), np.maximum(high, near + rim)
    if not half.any():
        low, high = window([(1000 * p.x, 1000 * p.y) for p in places], 60.0, 200.0)
    for _, tip in run.mounts:
        body = 1000 * transform_points(tip, MOUNT_MM / 1000)
        low, high = np.minimum(low, body.min(axis=0) - 15), np.maximum(high, body.max(axis=0) + 15)
    plan = Plan((low[0], low[1]), (high[0], high[1]))
    if half.any():
        plan.table(half)
    _draw_mounts(plan, run)
    return plan


def _draw_mounts(plan: Plan, run: Run) -> None:
    """Draw the fixed tappers that lie inside the plan with their names."""
    for name, tip in run.mounts:
        behind = 1000 * transform_points(tip, [[-(NAME_BEHIND_MM + 5.0) / 1000, 0.0]])[0]
        if np.all(behind > plan.low) and np.all(behind < plan.high):
            plan.mount(name, tip)


def _replay_plan(run: Run) -> Plan:
    """Create a plan of the part of the table in which the object and the strikes are."""
    poses = [pose for tap in run.taps for pose in (tap.before, tap.predicted, tap.measured)]
    poses += [pose for pose in (run.first.start, run.first.goal) if pose is not None]
    rim = 1000 * float(np.max(np.hypot(*_outline(run).T), initial=0.02))
    near = [(1000 * p.x, 1000 * p.y) for p in poses if math.isfinite(p.x)]
    low, high = window(near, rim + 95.0, 200.0)
    plan = Plan((low[0], low[1]), (high[0], high[1]))
    half = 500 * np.asarray(run.table_size)
    if half.any():
        plan.table(half)
    _draw_mounts(plan, run)
    return plan


def overview(run: Run) -> str:
    """Draw a plan of the table with start, resting poses, goal and strikes."""
    plan, outline = _table_plan(run), _outline(run)
    if run.first.start is not None:
        plan.outline(outline, run.first.start, START)
    for tap in run.taps:
        if tap.seen:
            plan.outline(outline, tap.measured, REST)
    if run.first.goal is not None:
        plan.outline(outline, run.first.goal, GOAL, dashed=True, fill=0.15)
    for tap in run.taps:
        plan.strike(tap.strike, tap.number, 42.0, 0.6)
    plan.scale_bar()
    plan.axes()
    return plan.drawing("the table from above")


def _timeline(run: Run) -> dict[str, object] | None:
    """Return the activities of the cell over time, or the planner's states if none were recorded.

    The drawing of the run is 1000 units wide. ``bars``: name, duration in s, position, width and
    colour of each activity; ``shots``: number and position of each tap; ``legend``: total duration
    and colour of each activity.
    """
    steps = run.activities or run.phases
    if len(steps) < 2 or run.wall_time <= 0:
        return None
    unit = 1000 / run.wall_time
    total: dict[str, float] = {}
    bars = []
    for step, end in zip(steps, [*(s.began for s in steps[1:]), run.wall_time], strict=True):
        seconds = end - step.began
        if step.name not in _COLOURS or seconds <= 0:
            continue
        if seconds > SHORTEST_SHOWN_S:
            total[step.name] = total.get(step.name, 0.0) + seconds
        width = max(1.0, unit * seconds)
        bars.append((step.name, seconds, unit * step.began, width, _COLOURS[step.name]))
    return {
        "bars": bars,
        "shots": [(t.number, unit * t.fired_at) for t in run.taps if math.isfinite(t.fired_at)],
        "legend": [(f"{name} {span:.1f}\u00a0s", _COLOURS[name]) for name, span in total.items()],
    }


def _tap(run: Run, tap: TapRow, illustrated: IllustratedRun) -> dict[str, object]:
    before = [picture for picture in illustrated.pictures if picture.at <= tap.commanded_at]
    gate = (
        f", measured {1000 * tap.measured_speed:.0f} mm/s"
        if math.isfinite(tap.measured_speed)
        else ""
    )
    rows = [
        ("commanded", motion(Pose(0.0, 0.0, 0.0), tap.commanded, 2)),
        ("predicted", motion(tap.before, tap.predicted, 2)),
        ("measured", motion(tap.before, tap.measured, 2)),
        ("measured - predicted", motion(tap.predicted, tap.measured, 2)),
        ("striker", f"{1000 * tap.striker_speed:.0f} mm/s{gate}; {tap.outcome}"),
    ]
    if run.first.goal is not None:
        rows.append(("remaining", motion(tap.measured, run.first.goal, 2)))
    if math.isfinite(tap.fired_at):
        at_rest = f", at rest at {tap.at_rest_at:.1f} s" if math.isfinite(tap.at_rest_at) else ""
        rows.append(("when", f"fired at {tap.fired_at:.1f} s{at_rest}"))
    if tap.launch.is_known:
        rows.append(("launch", launch_words(tap.launch)))
    if tap.learnt.slide_distance > 0.0:
        known = object_of(run.files, tap.object_name or run.first.name)
        rows.append(("learnt object", learnt_words(tap.learnt, known)))
    if math.isfinite(tap.learnt.distance):
        rows += [("learnt", _gains(tap.learnt)), ("learnt aiming error", _aim(tap.learnt))]
    return {
        "row": tap,
        "sentence": tap_sentence(tap, run.first.goal),
        "image": photograph(before[-1]) if before else None,
        "drawing": _close_up(run, tap),
        "velocity": velocity_chart(tap, illustrated.tracks.get(run.first.name, [])),
        "values": rows,
    }


def _close_up(run: Run, tap: TapRow) -> str:
    """Draw one tap to scale, with the object's initial, predicted and measured poses."""
    outline = _outline(run)
    reach = 1000 * float(np.max(np.hypot(*outline.T), initial=0.02))
    poses = (tap.before, tap.predicted, tap.measured)
    middles = [(1000 * pose.x, 1000 * pose.y) for pose in poses if math.isfinite(pose.x)]
    back = 0.5 * reach
    tail = (
        1000 * tap.strike.x - back * math.cos(tap.strike.theta),
        1000 * tap.strike.y - back * math.sin(tap.strike.theta),
    )
    rims = [
        (x + dx, y + dy) for x, y in middles for dx in (-reach, reach) for dy in (-reach, reach)
    ]
    low, high = window([*rims, tail], 0.25 * reach, 2.5 * reach)
    plan = Plan((low[0], low[1]), (high[0], high[1]))
    if run.first.goal is not None:
        plan.outline(outline, run.first.goal, GOAL, dashed=True, fill=0.12)
    plan.outline(outline, tap.before, START)
    if tap.predicted_covariance is not None:
        plan.ellipse(np.array(tap.predicted_covariance)[:2, :2], tap.predicted, PREDICTED)
    plan.outline(outline, tap.predicted, PREDICTED, dashed=True)
    if tap.seen:
        plan.outline(outline, tap.measured, REST)
        plan.arrow(middles[0], middles[-1], REST, 0.5)
    plan.strike(tap.strike, tap.number, back, 0.6)
    plan.scale_bar()
    plan.axes()
    return plan.drawing(f"tap {tap.number} from above")


def _gains(learnt: Learnt) -> str:
    return (
        f"relative to the model: distance {learnt.distance:.2f} \u00b1 "
        f"{learnt.distance_deviation:.2f}, rotation per distance {learnt.rotation:.2f} \u00b1 "
        f"{learnt.rotation_deviation:.2f}"
    )


def _aim(learnt: Learnt) -> str:
    offset = math.degrees(1e-3) * math.hypot(learnt.offset_x, learnt.offset_y)
    spread = math.degrees(1e-3) * math.hypot(learnt.offset_x_deviation, learnt.offset_y_deviation)
    return (
        f"direction {math.degrees(learnt.direction):+.2f} \u00b1 "
        f"{math.degrees(learnt.direction_deviation):.2f} deg; rotation due to off-centre mass or "
        f"friction {offset:.3f} \u00b1 {spread:.3f} deg per mm of travel"
    )
