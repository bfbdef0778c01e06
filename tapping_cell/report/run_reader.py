"""Extraction of a run from its bag, for all files of a run folder."""

from __future__ import annotations

import bisect
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tapping_cell import __version__
from tapping_cell.report import error_codes
from tapping_cell.report.activities import activities, seconds_of
from tapping_cell.report.columns import from_record
from tapping_cell.report.recorded import NO_BAGS, Bag, BagError
from tapping_cell.report.run import (
    CANCELED,
    FAILED,
    NOT_TRULY_REACHED,
    REACHED,
    REFUSED,
    TIP,
    UNFINISHED,
    ErrorEvent,
    Phase,
    Picture,
    Poses,
    Run,
    RunObject,
    TapRow,
)
from tapping_cell.report.versions import version_key
from tapping_cell.report.words import PHASES, PROGRESS, word
from tapping_cell.se2 import Pose, from_message

NOTES = "run_notes"
"""Topic (``std_msgs/String``, JSON) with information on a run that no other topic contains."""
PICTURES = "camera/image_annotated/compressed"
_STATE_TOPICS = ("plan_state", "arm_state", "tapper_state")
TRUTH_WITHIN_S = 0.2
"""Maximum time difference between a measured pose and its ground truth, in s. A pose counts as a
final pose up to this time after the end of the run."""
SAME_TIME_S = 1e-6
_FINAL_WORDS = ("reached", "failed", "canceled")
NOT_MOVED = "not moved"
"""Outcome of an object that had no goal and was not tapped."""


@dataclass(frozen=True, slots=True)
class IllustratedRun:
    """A run and its camera images, in order of time.

    ``tracks``: recorded poses of each object and of the striker's tip (``TIP``), at times since
    the start of the run.
    """

    run: Run
    pictures: tuple[Picture, ...]
    tracks: Mapping[str, Poses] = field(default_factory=dict)


def inside(goal: Pose, pose: Pose | None, tolerance: tuple[float, float]) -> bool:
    """Return whether the pose is known and within the tolerance (m, rad) of the goal."""
    return (
        pose is not None
        and pose.distance_to(goal) <= tolerance[0]
        and abs(pose.rotation_to(goal)) <= tolerance[1]
    )


def read_illustrated_run(path: Path, name: str = "") -> IllustratedRun:
    """Read the run in a bag, which is a folder or an ``.mcap`` file.

    Raises:
        tapping_cell.report.recorded.BagError: there is no bag, or it has no goal.
    """
    try:
        from tapping_cell.report.bag import read_bag
    except ModuleNotFoundError as error:
        raise BagError(NO_BAGS) from error
    return illustrated_run(read_bag(path), name or path.stem)


def illustrated_run(bag: Bag, name: str) -> IllustratedRun:
    """Extract the run from a bag; a truncated bag gives the recorded part of the run.

    Raises:
        tapping_cell.report.recorded.BagError: the bag has no goal, or a damaged message type.
    """
    notes = notes_of(bag)
    try:
        run = (_arranged if notes.get("arrangement") else _positioned)(bag, name, notes)
        return IllustratedRun(run, pictures_of(bag, run.began), _tracks(bag, run))
    except AttributeError as error:  # a message lacks a field
        raise BagError(f"{bag.path} is damaged: {error}") from error


def _run(
    bag: Bag,
    name: str,
    notes: Mapping[str, Any],
    times: tuple[float, float],
    plans: Sequence[Any],
    end: tuple[str, int, str],
    **others: Any,
) -> Run:
    """Return a run. ``times``: start and end, s; ``plans``: its messages of the planner; ``end``:
    outcome, error code and message."""
    began, ended = times
    outcome, code, sentence = end
    if outcome == UNFINISHED and not code:
        code = error_codes.number("SHUTTING_DOWN")
        sentence = "the recording ended before the goal did"
    return Run(
        name=name,
        outcome=outcome,
        wall_time=max(0.0, ended - began),
        seed=notes.get("seed"),
        versions=notes.get("versions", {}),
        error_code=code,
        error_msg=sentence,
        table_size=tuple(notes.get("table_size", (0.0, 0.0))),
        mounts=tuple((name, Pose(*place)) for name, *place in notes.get("mounts", ())),
        began=began,
        phases=_phases(plans, began),
        activities=activities(bag, began, ended),
        errors=_errors(bag, began, ended),
        files=notes.get("files", {}),
        note=note_of(bag, notes),
        **others,
    )


def _positioned(bag: Bag, name: str, notes: Mapping[str, Any]) -> Run:
    """Return the run of a goal of one object.

    Raises:
        BagError: the bag has no goal.
    """
    plans = [message for _, message in bag.of("plan_state")]
    report = _own_report([message for _, message in bag.of("goal_report")], notes)
    own = [
        plan for plan in plans if plan.goal.header.frame_id and plan.state in range(1, len(PHASES))
    ]
    if report is None and not own:
        cause = f"; {bag.missing}" if bag.missing else ""
        raise BagError(f"{bag.path}: the bag contains no goal{cause}")
    last = report if report is not None else own[-1]
    refused = report is not None and report.refused
    since = float(notes.get("began", -math.inf))
    mine = [
        plan
        for plan in own
        if not refused
        and _same_goal(plan.goal, last.goal)
        and seconds_of(plan.header.stamp) >= since - SAME_TIME_S
    ]
    began = float(notes.get("began", seconds_of((mine or [last])[0].header.stamp)))
    ended = seconds_of(last.header.stamp)
    states = [(seconds_of(m.header.stamp), m) for m in bag.of_own_object()]
    truths = [(seconds_of(m.header.stamp), from_message(m.pose)) for _, m in bag.of("ground_truth")]
    records = report.records if report is not None else records_of(mine)
    seen = [(at, m) for at, m in states if m.visible and m.at_rest and not m.error_code]
    after = [(at, m) for at, m in seen if at <= ended + TRUTH_WITHIN_S]
    final = after[-1] if after else None
    taps = _taps(records, bag, lambda record: truths, began)
    # A client sets the stamp of a goal to the stamp of the observation to which the goal refers, to
    # the time of sending, or to zero.
    asked = seconds_of(last.goal.header.stamp) or began
    one = RunObject(
        name=str(notes.get("object", "")),
        outline=tuple((float(x), float(y)) for x, y in notes.get("outline", ())),
        start=_start(seen, asked, taps),
        goal=from_message(last.goal.pose) if _is_pose(last.goal.pose) else None,
        end=from_message(final[1].pose.pose) if final else None,
        end_true=_truth_at(truths, final[0]) if final else None,
        tolerance=(_finite(last.position_tolerance), _finite(last.angle_tolerance)),
        taps=len(taps),
    )
    end = _outcome(last, refused, one), int(last.error_code), str(last.error_msg)
    return _run(
        bag,
        name,
        notes,
        (began, ended),
        mine,
        end,
        objects=(one,),
        taps=taps,
        planner=str(last.planner),
    )


def _arranged(bag: Bag, name: str, notes: Mapping[str, Any]) -> Run:
    """Return the run of an arrangement of objects.

    Raises:
        BagError: the bag contains no arrangement.
    """
    since = float(notes.get("began", -math.inf)) - SAME_TIME_S
    reports = _since(bag, "arrangement_state", since)
    with_objects = [report for report in reports if report.objects]
    if not with_objects:
        raise BagError(f"{bag.path}: the bag contains no arrangement")
    last = with_objects[-1]
    began = float(notes.get("began", seconds_of(reports[0].header.stamp)))
    ended = seconds_of(reports[-1].header.stamp)
    plans = _since(bag, "plan_state", began - SAME_TIME_S)
    seen, true = _poses(bag, "object_states"), _poses(bag, "true_states")
    taps = _arranged_taps(bag, plans, true, began)
    objects = _objects(last, notes, seen, true, ended)
    contacts = tuple(
        (str(message.object_id), str(message.other_id))
        for message in _since(bag, "true_contacts", since)
    )
    end = FAILED, int(last.error_code), str(last.error_msg)
    if not reports[-1].objects:
        end = (
            FAILED,
            error_codes.number("NOT_READY"),
            "the planner was restarted during the arrangement",
        )
    elif last.active:
        code = error_codes.number("SHUTTING_DOWN")
        end = UNFINISHED, code, "the recording ended before the arrangement did"
    elif not end[1]:
        truly = all(_truly_inside(one) for one in objects if one.goal is not None)
        end = REACHED if truly else NOT_TRULY_REACHED, 0, ""
    elif end[1] in (error_codes.number("GOAL_CANCELED"), error_codes.number("GOAL_REPLACED")):
        end = CANCELED, *end[1:]
    return _run(
        bag,
        name,
        notes,
        (began, ended),
        plans,
        end,
        objects=objects,
        taps=taps,
        planner=taps[0].method if taps else "",
        contacts=contacts if true else None,
    )


def _since(bag: Bag, topic: str, since: float) -> list[Any]:
    """Return the messages of a topic that are not older than a time in s."""
    return [m for _, m in bag.of(topic) if seconds_of(m.header.stamp) >= since]


def _arranged_taps(
    bag: Bag, plans: Sequence[Any], true: Mapping[str, Poses], began: float
) -> tuple[TapRow, ...]:
    """Return the finished taps of an arrangement. They are read from the planner's report or, if
    that is missing, from its state messages.

    Before a tap, the planner publishes the reason for the choice of the object, followed by the
    reason for the choice of the tap.
    """
    reports = [m for m in _since(bag, "goal_report", began - SAME_TIME_S) if not m.refused]
    reasons = {
        int(plan.planned_tap.tap_id): str(plan.planned_tap.reason)
        for plan in plans
        if plan.planned_tap.tap_id
    }
    records = reports[0].records if reports else records_of(plans)
    rows = []
    own = _taps(records, bag, lambda record: true.get(str(record.object_id), []), began)
    for number, row in enumerate(own, start=1):
        why_tap = row.reason or "asked again because"
        purpose = reasons.get(row.tap_id, "").partition(f"; {why_tap}")[0]
        rows.append(replace(row, number=number, purpose=purpose))
    return tuple(rows)


def _objects(
    last: Any,
    notes: Mapping[str, Any],
    seen: Mapping[str, Poses],
    true: Mapping[str, Poses],
    ended: float,
) -> tuple[RunObject, ...]:
    """Return the objects of an arrangement in the order of the cell's list."""
    progress = {str(each.object_id): each for each in last.objects}
    outlines = {
        str(each["name"]): tuple((float(x), float(y)) for x, y in each["outline"])
        for each in notes.get("objects", ())
    }
    objects = []
    for name in dict.fromkeys((*outlines, *progress)):
        own = progress.get(name)
        poses, truths = (
            [pose for at, pose in found.get(name, ()) if at <= ended + TRUTH_WITHIN_S]
            for found in (seen, true)
        )
        one = RunObject(
            name=name,
            outline=outlines.get(name, ()),
            start=poses[0] if poses else None,
            end=poses[-1] if poses else None,
            end_true=truths[-1] if truths else None,
            outcome=NOT_MOVED,
        )
        if own is not None:
            one = replace(one, outcome=word(PROGRESS, int(own.state)), taps=int(own.taps))
            if any(own.pose.covariance):
                one = replace(one, end=from_message(own.pose.pose))
            if own.has_goal:
                tolerance = float(own.position_tolerance), float(own.angle_tolerance)
                one = replace(one, goal=from_message(own.goal_pose), tolerance=tolerance)
        objects.append(one)
    return tuple(objects)


def _poses(bag: Bag, topic: str) -> dict[str, Poses]:
    """Return the poses of each object while it was visible."""
    found: dict[str, Poses] = {}
    for _, message in bag.of(topic):
        for state in message.objects:
            if state.visible:
                found.setdefault(str(state.object_id), []).append(
                    (seconds_of(message.header.stamp), from_message(state.pose.pose))
                )
    return found


def _tracks(bag: Bag, run: Run) -> dict[str, Poses]:
    """Return the recorded poses of the objects and of the striker's tip during a run."""
    if len(run.objects) > 1:
        found = _poses(bag, "object_states")
    else:
        states = ((seconds_of(m.header.stamp), m) for m in bag.of_own_object() if m.visible)
        found = {run.first.name: [(at, from_message(m.pose.pose)) for at, m in states]}
    arm = ((seconds_of(m.header.stamp), m) for _, m in bag.of("arm_state") if m.homed)
    found[TIP] = [(at, from_message(m.tip_pose)) for at, m in arm]
    return {
        name: [
            (at - run.began, pose)
            for at, pose in poses
            if 0.0 <= at - run.began <= run.wall_time + TRUTH_WITHIN_S
        ]
        for name, poses in found.items()
    }


def pictures_of(bag: Bag, began: float) -> tuple[Picture, ...]:
    """Return the camera images in order of time; ``began`` is the start of the run, in s."""
    return tuple(
        Picture(seconds_of(m.header.stamp) - began, bytes(m.data)) for _, m in bag.of(PICTURES)
    )


def note_of(bag: Bag, notes: Mapping[str, Any]) -> str:
    """Return why a report from the bag may show less than the run had, or an empty text."""
    writer = str(notes.get("versions", {}).get("tapping_cell", __version__))
    newer = ""
    if version_key(writer) > version_key(__version__):
        newer = (
            f"the run was recorded by tapping_cell {writer}, which is newer than this version "
            f"({__version__}); use the newer version"
        )
    return "; ".join(filter(None, (bag.missing, newer)))


def notes_of(bag: Bag) -> dict[str, Any]:
    """Return the recorder's own notes; empty for a bag of another recorder."""
    found: dict[str, Any] = {}
    for _, message in bag.of(NOTES):
        try:
            found.update(json.loads(message.data))
        except ValueError as error:
            raise BagError(f"{bag.path}: the topic {NOTES} is not JSON: {error}") from error
    return found


def _own_report(reports: list[Any], notes: Mapping[str, Any]) -> Any:
    """Select the report of this run's goal. A bag may also contain an earlier report, because the
    topic is latched."""
    began = float(notes.get("began", -math.inf)) - SAME_TIME_S
    since = [report for report in reports if seconds_of(report.header.stamp) >= began]
    if notes.get("refused") is not None:
        since = [report for report in since if bool(report.refused) == notes["refused"]]
    return since[0] if since else None


def _same_goal(one: Any, other: Any) -> bool:
    return bool(one.header == other.header and one.pose == other.pose)


def records_of(plans: Sequence[Any]) -> list[Any]:
    """Collect the finished taps from the planner's state messages, each of which contains the last
    tap."""
    by_id = {plan.last_tap.tap_id: plan.last_tap for plan in plans if plan.last_tap.tap_id}
    return sorted(by_id.values(), key=lambda record: int(record.number))


def _taps(
    records: Sequence[Any], bag: Bag, truths: Callable[[Any], Poses], began: float
) -> tuple[TapRow, ...]:
    """Return the taps of records. ``truths`` returns the true poses of a record's object;
    ``began``: start of the run, s."""
    commanded = {
        int(m.tap_id): seconds_of(m.header.stamp)
        for _, m in bag.of("tap_command")
        if m.request == 0
    }
    rows = []
    for record in records:
        at_rest, fired = seconds_of(record.at_rest_at), seconds_of(record.fired_at)
        rows.append(
            TapRow(
                **from_record(TapRow, record),
                true_pose=_truth_at(truths(record), at_rest),
                commanded_at=commanded.get(int(record.tap_id), math.nan) - began,
                fired_at=fired - began if fired else math.nan,
                at_rest_at=at_rest - began if at_rest else math.nan,
            )
        )
    return tuple(rows)


def _pose_at(seen: list[tuple[float, Any]], asked: float) -> Pose | None:
    """Return the last resting pose up to the time ``asked``. If there is none, return the first
    resting pose after it, or None."""
    before = [message for at, message in seen if at <= asked + SAME_TIME_S]
    message = before[-1] if before else (seen[0][1] if seen else None)
    return None if message is None else from_message(message.pose.pose)


def _start(seen: list[tuple[float, Any]], asked: float, taps: Sequence[TapRow]) -> Pose | None:
    """Return the resting pose at the beginning of a run. If the recorder connected to the camera's
    node only after the first tap, return the pose for which that tap was planned."""
    if taps and taps[0].number == 1 and all(at > asked + SAME_TIME_S for at, _ in seen):
        return taps[0].before
    return _pose_at(seen, asked)


def _truth_at(truths: Poses, at: float) -> Pose | None:
    """Return the ground truth pose nearest to a time; None if unknown."""
    if not truths:
        return None
    place = bisect.bisect_left(truths, at, key=lambda entry: entry[0])
    near = truths[max(0, place - 1) : place + 1]
    stamp, pose = min(near, key=lambda entry: abs(entry[0] - at))
    return pose if abs(stamp - at) <= TRUTH_WITHIN_S else None


def _outcome(last: Any, refused: bool, one: RunObject) -> str:
    """Determine the outcome from the planner's last state and the ground truth, if known."""
    if refused:
        return REFUSED
    phase = word(PHASES, int(last.state))
    if phase not in _FINAL_WORDS:
        return UNFINISHED
    if phase != "reached" or last.error_code:
        return CANCELED if phase == "canceled" else FAILED
    return REACHED if _truly_inside(one) else NOT_TRULY_REACHED


def _truly_inside(one: RunObject) -> bool:
    """Return whether the true pose, if it is known, is within the tolerance of the goal."""
    if one.end_true is None:
        return True
    return one.goal is not None and inside(one.goal, one.end_true, one.tolerance)


def _phases(plans: Sequence[Any], began: float) -> tuple[Phase, ...]:
    found: list[Phase] = []
    for plan in plans:
        name = word(PHASES, int(plan.state))
        if not found or found[-1].name != name:
            found.append(Phase(max(0.0, seconds_of(plan.header.stamp) - began), name))
        if name in _FINAL_WORDS:
            break
    return tuple(found)


def _errors(bag: Bag, began: float, ended: float) -> tuple[ErrorEvent, ...]:
    """Return the warnings and errors that occurred while the goal was active. A problem that
    persists is listed once."""
    found = []
    streams = {topic: (message for _, message in bag.of(topic)) for topic in _STATE_TOPICS}
    for topic, messages in {**streams, "object_states": bag.of_own_object()}.items():
        before = 0
        for message in messages:
            at, code = seconds_of(message.header.stamp), int(message.error_code)
            if code and code != before and began <= at <= ended:
                found.append(ErrorEvent(at - began, topic, code, str(message.error_msg)))
            before = code
    return tuple(sorted(found, key=lambda event: event.at))


def _finite(value: float) -> float:
    """Return a tolerance, or 0 if it is not finite. Only a rejected request can contain a tolerance
    that is not finite."""
    return float(value) if math.isfinite(value) else 0.0


def _is_pose(pose: Any) -> bool:
    values = (pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w)
    return all(math.isfinite(value) for value in values)
