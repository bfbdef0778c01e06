"""``report.html``: the report of one run in one file, for screens, phones and printing."""

from __future__ import annotations

import math
from datetime import datetime
from html import escape
from pathlib import Path

import numpy as np

from tapping_cell.report import error_codes
from tapping_cell.report.activities import (
    ASKS,
    CHARGES,
    FLIES,
    LOWERS,
    MEASURES,
    PLANS,
    SLIDES,
    TRAVELS,
    WITHDRAWS,
)
from tapping_cell.report.animation import TAP_S, animation
from tapping_cell.report.page_style import (
    cards_section,
    document,
    failure_section,
    scrolling_table,
)
from tapping_cell.report.palette import (
    CONFIRMING,
    GOAL,
    LINE,
    LOWERING,
    PLANNING,
    PREDICTED,
    REST,
    SLIDING,
    START,
    STRIKE,
    TABLE,
    WAITING,
    WITHDRAWING,
)
from tapping_cell.report.photograph import photograph
from tapping_cell.report.run import (
    CANCELED,
    FAILED,
    NOT_TRULY_REACHED,
    REFUSED,
    Learnt,
    Picture,
    Run,
    TapRow,
)
from tapping_cell.report.run_reader import IllustratedRun
from tapping_cell.report.svg import Plan, chart, window
from tapping_cell.report.tap_words import tap_sentence
from tapping_cell.report.words import counted
from tapping_cell.se2 import Array, Pose

SHORTEST_SHOWN_S = 0.05
_HEADLINES = {
    NOT_TRULY_REACHED: "Measured at the goal, but the true pose is outside the tolerance",
    FAILED: "Goal failed",
    CANCELED: "Goal canceled",
    REFUSED: "Goal refused",
}
_ACTIVITY_COLOURS = {
    TRAVELS: PREDICTED,
    LOWERS: LOWERING,
    CHARGES: STRIKE,
    SLIDES: SLIDING,
    WITHDRAWS: WITHDRAWING,
    FLIES: PREDICTED,
    MEASURES: REST,
    PLANS: WAITING,
    ASKS: CONFIRMING,
}
_PHASE_COLOURS = {
    "waiting for the cell": WAITING,
    "looking": REST,
    "planning": PLANNING,
    "placing the striker": PREDICTED,
    "firing": STRIKE,
    "waiting for rest": SLIDING,
    "waiting for confirmation": CONFIRMING,
}


def page(illustrated: IllustratedRun) -> str:
    """Return the page of a run, which loads no other files."""
    run = illustrated.run
    parts = [
        _head(run),
        failure_section(run.error_code, run.error_msg),
        _figures(run),
        '<section class="two">',
        f"<figure>{overview(run)}<figcaption>{_legend(run)}</figcaption></figure>",
        photograph(illustrated.pictures[-1], "the last image") if illustrated.pictures else "",
        "</section>",
        _film(run),
        _charts(run),
        _timeline(run),
        *(_tap(run, tap, illustrated.pictures) for tap in run.taps),
        _errors(run),
        _configuration(run),
    ]
    return document(f"{headline(run)} - {run.name}", "".join(parts))


def headline(run: Run) -> str:
    """Summarise the outcome of a run in a few words."""
    taps = counted(len(run.taps), "tap")
    if run.reached:
        return f"Goal reached in {taps}" if run.taps else "Goal reached without a tap"
    headline_text = _HEADLINES.get(run.outcome, "The end of the goal was not recorded")
    return f"{headline_text} after {taps}" if run.taps else headline_text


def _head(run: Run) -> str:
    when = (
        datetime.fromtimestamp(run.began).strftime("%d %B %Y, %H:%M:%S")
        if math.isfinite(run.began)
        else "time unknown"
    )
    kind = (
        "good" if run.reached else ("bad" if run.outcome in (FAILED, NOT_TRULY_REACHED) else "so")
    )
    task = ""
    if run.start is not None and run.goal is not None:
        turn = math.degrees(run.start.rotation_to(run.goal))
        away = 1000 * run.start.distance_to(run.goal)
        task = f"{away:.1f}&nbsp;mm and {turn:+.1f}&nbsp;deg from the goal. "
    details = " &middot; ".join(
        escape(word)
        for word in (when, run.object_name, run.planner and f"planner {run.planner}")
        if word
    )
    return (
        f'<header class="{kind}"><p class="badge">{escape(run.outcome)}</p>'
        f"<h1>{escape(headline(run))}</h1><p>{task}{details}</p></header>"
    )


def _figures(run: Run) -> str:
    limit, turn = 1000 * run.tolerance[0], math.degrees(run.tolerance[1])
    cards = []
    for name, pose in (("measured", run.final_measured), ("true", run.final_true)):
        if pose is None or run.goal is None:
            continue
        off, angle = (
            1000 * pose.distance_to(run.goal),
            math.degrees(abs(pose.rotation_to(run.goal))),
        )
        cards.append((f"{name} distance", f"{off:.2f} mm", f"tolerance {limit:g} mm"))
        cards.append((f"{name} rotation", f"{angle:.2f} deg", f"tolerance {turn:g} deg"))
    cards.append(("taps", str(len(run.taps)), _each(run)))
    cards.append(("time", f"{run.wall_time:.1f} s", "from goal to end"))
    return cards_section(cards)


def _each(run: Run) -> str:
    return f"{run.wall_time / len(run.taps):.1f} s per tap" if run.taps else "no tap was made"


def _outline(run: Run) -> Array:
    return np.asarray(run.outline, dtype=float).reshape(-1, 2)


def _film(run: Run) -> str:
    drawing = animation(run, _table_plan(run))
    if not drawing:
        return ""
    return (
        f'<section><h2>Animation of the run</h2><figure class="film">{drawing}<figcaption>'
        f"Every tap takes {TAP_S:g} s here; the run took {run.wall_time:.1f} s.</figcaption>"
        "</figure></section>"
    )


def _table_plan(run: Run) -> Plan:
    """Create a plan of the table that contains all poses of the run."""
    half = 500 * np.asarray(run.table_size)
    places = [pose for pose in (run.start, run.goal, *(t.measured for t in run.taps)) if pose]
    low, high = -half - 12, half + 12
    if run.goal is not None and half.any():
        # A rejected goal may be outside the table.
        rim = 1000 * float(np.max(np.hypot(*_outline(run).T), initial=0.02)) + 12
        middle = 1000 * np.array([run.goal.x, run.goal.y])
        near = np.clip(middle, 4 * low, 4 * high)
        low, high = np.minimum(low, near - rim), np.maximum(high, near + rim)
    if not half.any():
        low, high = window([(1000 * p.x, 1000 * p.y) for p in places], 60.0, 200.0)
    plan = Plan((low[0], low[1]), (high[0], high[1]))
    if half.any():
        plan.rectangle(-half, half, f'fill="{TABLE}" stroke="{LINE}" stroke-width="1"')
    return plan


def overview(run: Run) -> str:
    """Draw a plan of the table with start, resting poses, goal and strikes."""
    plan, outline = _table_plan(run), _outline(run)
    if run.start is not None:
        plan.outline(outline, run.start, START)
    for tap in run.taps:
        plan.outline(outline, tap.measured, REST)
    if run.goal is not None:
        plan.outline(outline, run.goal, GOAL, dashed=True, fill=0.15)
    for tap in run.taps:
        _strike(plan, tap, 42.0)
    plan.scale_bar()
    plan.axes()
    return plan.drawing("the table from above")


def _legend(run: Run) -> str:
    entries = [(START, "start"), (REST, "at rest after a tap"), (GOAL, "goal")]
    entries += [(STRIKE, "strike, with the tap's number")] if run.taps else []
    return " ".join(
        f'<span class="key"><i style="background:{colour}"></i>{label}</span>'
        for colour, label in entries
    )


def _strike(plan: Plan, tap: TapRow, length: float) -> None:
    along = np.array([math.cos(tap.strike.theta), math.sin(tap.strike.theta)])
    tip = 1000 * np.array([tap.strike.x, tap.strike.y])
    tail = tip - length * along
    plan.arrow(tail, tip, STRIKE, 0.6)
    x, y = tail - 3 * plan.unit * along
    plan.text(float(x), float(y), str(tap.number), STRIKE, 3.6)


def _charts(run: Run) -> str:
    goal = run.goal
    if goal is None or run.start is None or not run.taps:
        return ""
    poses = [run.start, *(tap.measured for tap in run.taps)]
    distance = [1000 * pose.distance_to(goal) for pose in poses]
    rotation = [abs(math.degrees(pose.rotation_to(goal))) for pose in poses]
    return (
        '<section class="two">'
        + chart([("distance", distance, REST)], 1000 * run.tolerance[0], "remaining distance (mm)")
        + chart(
            [("rotation", rotation, REST)],
            math.degrees(run.tolerance[1]),
            "remaining rotation (deg)",
        )
        + "</section>"
    )


def _timeline(run: Run) -> str:
    """Draw the activities of the cell over time, or the planner's states if none were recorded."""
    steps = run.activities or run.phases
    colours = _ACTIVITY_COLOURS if run.activities else _PHASE_COLOURS
    if len(steps) < 2 or run.wall_time <= 0:
        return ""
    ends = [step.began for step in steps[1:]] + [run.wall_time]
    total: dict[str, float] = {}
    pieces = []
    for phase, end in zip(steps, ends, strict=True):
        span = max(0.0, end - phase.began)
        if phase.name not in colours or span <= 0:
            continue
        if span > SHORTEST_SHOWN_S:
            total[phase.name] = total.get(phase.name, 0.0) + span
        pieces.append(
            f'<rect x="{1000 * phase.began / run.wall_time:.1f}" y="0" height="46" '
            f'width="{max(1.0, 1000 * span / run.wall_time):.1f}" '
            f'fill="{colours[phase.name]}">'
            f"<title>{escape(phase.name)}: {span:.2f} s</title></rect>"
        )
    marks = "".join(
        f'<text x="{1000 * tap.fired_at / run.wall_time:.0f}" y="64" text-anchor="middle" '
        f'font-size="15" fill="{STRIKE}">{tap.number}</text>'
        for tap in run.taps
        if math.isfinite(tap.fired_at)
    )
    legend = " ".join(
        f'<span class="key"><i style="background:{colours[name]}"></i>'
        f"{escape(name)} {seconds:.1f}&nbsp;s</span>"
        for name, seconds in total.items()
    )
    return (
        f"<section><h2>Time</h2><svg class='band' viewBox='0 0 1000 70' role='img' "
        f"aria-label='activities of the cell over time'>{''.join(pieces)}{marks}</svg>"
        f"<p>{legend}</p></section>"
    )


def _tap(run: Run, tap: TapRow, pictures: tuple[Picture, ...]) -> str:
    before = [picture for picture in pictures if picture.at <= tap.commanded_at]
    photo = photograph(before[-1], f"the image before tap {tap.number}") if before else ""
    missed = 1000 * tap.predicted.distance_to(tap.measured)
    turned = math.degrees(tap.predicted.rotation_to(tap.measured))
    gate = (
        f", measured {1000 * tap.measured_speed:.0f} mm/s"
        if math.isfinite(tap.measured_speed)
        else ""
    )
    rows = [
        ("commanded", _move(tap.commanded)),
        ("predicted", _between(tap.before, tap.predicted)),
        ("measured", _between(tap.before, tap.measured)),
        ("measured - predicted", f"{missed:.2f} mm, {turned:+.2f} deg"),
        ("striker", f"{1000 * tap.striker_speed:.0f} mm/s{gate}; {tap.outcome}"),
    ]
    if run.goal is not None:
        rows.append(("remaining", _to_go(tap.measured, run.goal)))
    if math.isfinite(tap.fired_at):
        at_rest = f", at rest at {tap.at_rest_at:.1f} s" if math.isfinite(tap.at_rest_at) else ""
        rows.append(("when", f"fired at {tap.fired_at:.1f} s{at_rest}"))
    if math.isfinite(tap.learnt.distance):
        rows += [("learnt", _gains(tap.learnt)), ("learnt aiming error", _aim(tap.learnt))]
    table = "".join(f"<tr><th>{name}</th><td>{escape(text)}</td></tr>" for name, text in rows)
    return (
        f'<section class="tap"><h2>Tap {tap.number} <small>{escape(tap.method)}</small></h2>'
        f"<p>{escape(tap_sentence(tap, run.goal))}</p>"
        f'<div class="three">{photo}<figure>{_close_up(run, tap)}<figcaption>'
        f"{_close_up_legend(run)}</figcaption></figure><table>{table}</table></div></section>"
    )


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
    if run.goal is not None:
        plan.outline(outline, run.goal, GOAL, dashed=True, fill=0.12)
    plan.outline(outline, tap.before, START)
    if tap.predicted_covariance is not None:
        plan.ellipse(np.array(tap.predicted_covariance)[:2, :2], tap.predicted, PREDICTED)
    plan.outline(outline, tap.predicted, PREDICTED, dashed=True)
    if math.isfinite(tap.measured.x):
        plan.outline(outline, tap.measured, REST)
        plan.arrow(middles[0], middles[-1], REST, 0.5)
    _strike(plan, tap, back)
    plan.scale_bar()
    plan.axes()
    return plan.drawing(f"tap {tap.number} from above")


def _close_up_legend(run: Run) -> str:
    entries = [
        (START, "before"),
        (PREDICTED, "predicted, with the 95 % ellipse of the centre"),
        (REST, "measured"),
        (STRIKE, "strike"),
    ]
    entries += [(GOAL, "goal")] if run.goal is not None else []
    return " ".join(
        f'<span class="key"><i style="background:{colour}"></i>{label}</span>'
        for colour, label in entries
    )


def _move(move: Pose) -> str:
    length = 1000 * math.hypot(move.x, move.y)
    return f"{length:.2f} mm, {math.degrees(move.theta):+.2f} deg"


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
        f"{math.degrees(learnt.direction_deviation):.2f} deg; off centre by "
        f"{offset:.3f} \u00b1 {spread:.3f} deg/mm"
    )


def _between(one: Pose, other: Pose) -> str:
    turn = math.degrees(one.rotation_to(other))
    return f"{1000 * one.distance_to(other):.2f} mm, {turn:+.2f} deg"


def _to_go(pose: Pose, goal: Pose) -> str:
    turn = math.degrees(pose.rotation_to(goal))
    return f"{1000 * pose.distance_to(goal):.2f} mm, {turn:+.2f} deg"


def _errors(run: Run) -> str:
    if not run.errors:
        return ""
    rows = "".join(
        f"<tr><td>{event.at:.1f} s</td><td>{escape(event.source)}</td>"
        f"<td>{escape(error_codes.name(event.code))} <small>{event.code}</small></td>"
        f"<td>{escape(event.sentence)}<br><small>{escape(error_codes.hint(event.code))}</small></td></tr>"
        for event in run.errors
    )
    head = "<tr><th>when</th><th>topic</th><th>code</th><th>problem and remedy</th></tr>"
    return (
        "<section><h2>Warnings and errors</h2>"
        f"{scrolling_table('Warnings and errors', head + rows)}</section>"
    )


def _configuration(run: Run) -> str:
    files = "".join(
        f"<details><summary>{escape(Path(name).name)} <small>{escape(name)}</small></summary>"
        f"<pre>{escape(text)}</pre></details>"
        for name, text in run.files.items()
    )
    versions = ", ".join(f"{name} {version}" for name, version in run.versions.items())
    seed = f"Seed of the simulated world: {run.seed}. " if run.seed is not None else ""
    return (
        f"<section><h2>Configuration</h2>{files}<p>{seed}Versions: {escape(versions)}.</p>"
        f'<p class="quiet">The bag in the folder of this page contains every topic of this '
        "run: open the <code>.mcap</code> file in Foxglove, or run <code>ros2 bag play bag</code>."
        " To write this page again, run <code>python -m tapping_cell report</code> with the "
        "folder.</p></section>"
    )
