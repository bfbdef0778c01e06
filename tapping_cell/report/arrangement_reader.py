"""Extraction of an arrangement of several objects from its bag."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tapping_cell.report import error_codes
from tapping_cell.report.arrangement_run import ArrangedObject, ArrangedTap, ArrangementRun
from tapping_cell.report.bag import Bag, BagError, read_bag
from tapping_cell.report.message_values import pose_of, seconds_of
from tapping_cell.report.run import Picture
from tapping_cell.report.run_reader import (
    SAME_TIME_S,
    TRUTH_WITHIN_S,
    note_of,
    notes_of,
    pictures_of,
    records_of,
)
from tapping_cell.report.words import OUTCOMES, PROGRESS, word
from tapping_cell.se2 import Pose

NOT_MOVED = "not moved"
"""Outcome of an object that had no goal and was not tapped."""


def holds_arrangement(path: Path) -> bool:
    """Return whether a bag was recorded for an arrangement of several objects.

    Raises:
        BagError: the bag is unreadable.
    """
    return bool(notes_of(read_bag(path)).get("arrangement"))


def read_arranged_run(path: Path, name: str) -> tuple[ArrangementRun, tuple[Picture, ...]]:
    """Read an arrangement and its camera images, in order of time, from its bag.

    Raises:
        BagError: the bag is unreadable or contains no arrangement.
    """
    bag = read_bag(path)
    notes = notes_of(bag)
    since = float(notes.get("began", -math.inf)) - SAME_TIME_S
    reports = [
        message
        for _, message in bag.of("arrangement_state")
        if seconds_of(message.header.stamp) >= since
    ]
    with_objects = [report for report in reports if report.objects]
    if not with_objects:
        raise BagError(f"{path}: the bag contains no arrangement")
    last = with_objects[-1]
    began = float(notes.get("began", seconds_of(reports[0].header.stamp)))
    ended = seconds_of(reports[-1].header.stamp)
    code, sentence = int(last.error_code), str(last.error_msg)
    if not reports[-1].objects:
        code = error_codes.number("NOT_READY")
        sentence = "the planner was restarted during the arrangement"
    elif last.active:
        code = error_codes.number("SHUTTING_DOWN")
        sentence = "the recording ended before the arrangement did"
    run = ArrangementRun(
        name=name,
        began=began,
        seconds=max(0.0, ended - began),
        table_size=tuple(notes.get("table_size", (0.0, 0.0))),
        objects=_objects(bag, last, notes, ended),
        taps=_taps(bag, began),
        contacts=_contacts(bag, since),
        error_code=code,
        error_msg=sentence,
        note=note_of(bag, notes),
    )
    return run, pictures_of(bag, began)


def arranged_tap(
    number: int, record: Any, description: str, began: float | None = None
) -> ArrangedTap:
    """Return a tap of an arrangement from its ``TapRecord``.

    ``description``: text that the planner published before the tap. It gives the reason for the
    choice of the object, followed by the reason for the choice of the tap. ``began``: ROS time in s
    at which the arrangement began, if known.
    """
    at_rest = seconds_of(record.at_rest_at)
    measured = pose_of(record.measured_pose.pose)
    why_tap = record.reason or "asked again because"
    return ArrangedTap(
        number=number,
        name=str(record.object_id),
        before=pose_of(record.object_pose),
        predicted=pose_of(record.predicted_pose),
        measured=measured if math.isfinite(measured.x) else None,
        strike=pose_of(record.strike_pose),
        striker_speed=float(record.striker_speed),
        outcome=word(OUTCOMES, int(record.outcome)),
        purpose=description.partition(f"; {why_tap}")[0],
        reason=str(record.reason),
        at_rest_at=at_rest - began if at_rest and began is not None else None,
    )


def _taps(bag: Bag, began: float) -> tuple[ArrangedTap, ...]:
    """Return the finished taps. They are read from the planner's report or, if that is missing,
    from its state messages."""
    since = began - SAME_TIME_S
    plans = [m for _, m in bag.of("plan_state") if seconds_of(m.header.stamp) >= since]
    reports = [
        message
        for _, message in bag.of("goal_report")
        if seconds_of(message.header.stamp) >= since and not message.refused
    ]
    records: Sequence[Any] = reports[0].records if reports else records_of(plans)
    reasons = {
        int(plan.planned_tap.tap_id): str(plan.planned_tap.reason)
        for plan in plans
        if plan.planned_tap.tap_id
    }
    return tuple(
        arranged_tap(number, record, reasons.get(int(record.tap_id), ""), began)
        for number, record in enumerate(records, start=1)
    )


def _objects(
    bag: Bag, last: Any, notes: Mapping[str, Any], ended: float
) -> tuple[ArrangedObject, ...]:
    """Return the objects in the order of the cell's list."""
    progress = {str(each.object_id): each for each in last.objects}
    outlines = {
        str(each["name"]): tuple((float(x), float(y)) for x, y in each["outline"])
        for each in notes.get("objects", ())
    }
    seen = _poses(bag, "object_states", ended)
    true = {name: poses[-1] for name, poses in _poses(bag, "true_states", ended).items()}
    objects = []
    for name in dict.fromkeys((*outlines, *progress)):
        own, poses = progress.get(name), seen.get(name, [])
        end = poses[-1] if poses else None
        if own is not None and any(own.pose.covariance):
            end = pose_of(own.pose.pose)
        objects.append(
            ArrangedObject(
                name=name,
                outline=outlines.get(name, ()),
                start=poses[0] if poses else None,
                goal=pose_of(own.goal_pose) if own is not None and own.has_goal else None,
                end=end,
                end_true=true.get(name),
                outcome=NOT_MOVED if own is None else word(PROGRESS, int(own.state)),
                taps=0 if own is None else int(own.taps),
                tolerance=(float(own.position_tolerance), float(own.angle_tolerance))
                if own is not None and own.has_goal
                else None,
            )
        )
    return tuple(objects)


def _poses(bag: Bag, topic: str, ended: float) -> dict[str, list[Pose]]:
    """Return the poses of each object while it was visible, in order of time. Poses up to
    ``TRUTH_WITHIN_S`` after the end are included."""
    found: dict[str, list[Pose]] = {}
    for _, message in bag.of(topic):
        if seconds_of(message.header.stamp) > ended + TRUTH_WITHIN_S:
            continue
        for state in message.objects:
            if state.visible:
                found.setdefault(str(state.object_id), []).append(pose_of(state.pose.pose))
    return found


def _contacts(bag: Bag, since: float) -> tuple[tuple[str, str], ...] | None:
    """Return, for each contact in the ground truth, the names of the two objects that touched; None
    without ground truth."""
    if next(bag.of("true_states"), None) is None:
        return None
    return tuple(
        (str(message.object_id), str(message.other_id))
        for _, message in bag.of("true_contacts")
        if seconds_of(message.header.stamp) >= since
    )
