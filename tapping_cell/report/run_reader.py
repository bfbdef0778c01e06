"""Extraction of a run from its bag, for all files of a run folder."""

from __future__ import annotations

import bisect
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from tapping_cell import __version__
from tapping_cell.report import error_codes
from tapping_cell.report.activities import activities
from tapping_cell.report.bag import Bag, BagError, read_bag
from tapping_cell.report.message_values import pose_of as _pose
from tapping_cell.report.message_values import seconds_of as _seconds
from tapping_cell.report.run import (
    CANCELED,
    FAILED,
    NOT_TRULY_REACHED,
    REACHED,
    REFUSED,
    UNFINISHED,
    Covariance,
    ErrorEvent,
    Learnt,
    Phase,
    Picture,
    Run,
    TapRow,
)
from tapping_cell.report.versions import version_key
from tapping_cell.report.words import OUTCOMES, PHASES, word
from tapping_cell.se2 import Pose

NOTES = "run_notes"
"""Topic (``std_msgs/String``, JSON) with information on a run that no other topic contains."""
PICTURES = "camera/image_annotated/compressed"
_STATE_TOPICS = ("plan_state", "arm_state", "tapper_state", "object_state")
TRUTH_WITHIN_S = 0.2
"""Maximum time difference between a measured pose and its ground truth, in s. A pose counts as a
final pose up to this time after the end of the run."""
SAME_TIME_S = 1e-6
_FINAL_WORDS = ("reached", "failed", "canceled")


@dataclass(frozen=True, slots=True)
class IllustratedRun:
    """A run and its camera images, in order of time."""

    run: Run
    pictures: tuple[Picture, ...]


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
        tapping_cell.report.bag.BagError: there is no bag, or it has no goal.
    """
    return illustrated_run(read_bag(path), name or path.stem)


def illustrated_run(bag: Bag, name: str) -> IllustratedRun:
    """Extract the run from a bag; a truncated bag gives the recorded part of the run.

    Raises:
        tapping_cell.report.bag.BagError: the bag has no goal.
    """
    reports = [message for _, message in bag.of("goal_report")]
    plans = [message for _, message in bag.of("plan_state")]
    notes = notes_of(bag)
    report = _own_report(reports, notes)
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
        and _seconds(plan.header.stamp) >= since - SAME_TIME_S
    ]
    began = float(notes.get("began", _seconds((mine or [last])[0].header.stamp)))
    ended = _seconds(last.header.stamp)
    states = [(_seconds(m.header.stamp), m) for _, m in bag.of("object_state")]
    truths = [(_seconds(m.header.stamp), _pose(m.pose)) for _, m in bag.of("ground_truth")]
    records = report.records if report is not None else records_of(mine)
    seen = [(at, m) for at, m in states if m.visible and m.at_rest and not m.error_code]
    after = [(at, m) for at, m in seen if at <= ended + TRUTH_WITHIN_S]
    final = after[-1] if after else None
    taps = _taps(records, bag, truths, began)
    # A client sets the stamp of a goal to the stamp of the observation to which the goal refers, to
    # the time of sending, or to zero.
    start = _start(seen, _seconds(last.goal.header.stamp) or began, taps)
    goal = _pose(last.goal.pose) if _is_pose(last.goal.pose) else None
    tolerance = (_finite(last.position_tolerance), _finite(last.angle_tolerance))
    final_measured = _pose(final[1].pose.pose) if final else None
    final_true = _truth_at(truths, final[0]) if final else None
    outcome = _outcome(last, refused, goal, final_true, tolerance)
    code, sentence = int(last.error_code), str(last.error_msg)
    if outcome == UNFINISHED and not code:
        code = error_codes.number("SHUTTING_DOWN")
        sentence = "the recording ended before the goal did"
    run = Run(
        name=name,
        goal=goal,
        start=start,
        tolerance=tolerance,
        taps=taps,
        final_measured=final_measured,
        final_true=final_true,
        outcome=outcome,
        wall_time=max(0.0, ended - began),
        seed=notes.get("seed"),
        versions=notes.get("versions", {}),
        error_code=code,
        error_msg=sentence,
        outline=tuple((float(x), float(y)) for x, y in notes.get("outline", ())),
        table_size=tuple(notes.get("table_size", (0.0, 0.0))),
        planner=str(last.planner),
        object_name=str(notes.get("object", "")),
        began=began,
        phases=_phases(mine, began),
        activities=activities(bag, began, ended),
        errors=_errors(bag, began, ended),
        files=notes.get("files", {}),
        note=note_of(bag, notes),
    )
    return IllustratedRun(run, pictures_of(bag, began))


def pictures_of(bag: Bag, began: float) -> tuple[Picture, ...]:
    """Return the camera images in order of time; ``began`` is the start of the run, in s."""
    return tuple(
        Picture(_seconds(m.header.stamp) - began, bytes(m.data)) for _, m in bag.of(PICTURES)
    )


def note_of(bag: Bag, notes: dict[str, Any]) -> str:
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


def _own_report(reports: list[Any], notes: dict[str, Any]) -> Any:
    """Select the report of this run's goal. A bag may also contain an earlier report, because the
    topic is latched."""
    began = float(notes.get("began", -math.inf)) - SAME_TIME_S
    since = [report for report in reports if _seconds(report.header.stamp) >= began]
    if notes.get("refused") is not None:
        since = [report for report in since if bool(report.refused) == notes["refused"]]
    return since[0] if since else None


def _same_goal(one: Any, other: Any) -> bool:
    return bool(one.header == other.header and one.pose == other.pose)


def records_of(plans: list[Any]) -> list[Any]:
    """Collect the finished taps from the planner's state messages, each of which contains the last
    tap."""
    by_id = {plan.last_tap.tap_id: plan.last_tap for plan in plans if plan.last_tap.tap_id}
    return sorted(by_id.values(), key=lambda record: int(record.number))


def _taps(
    records: Sequence[Any], bag: Bag, truths: list[tuple[float, Pose]], began: float
) -> tuple[TapRow, ...]:
    commanded = {
        int(m.tap_id): _seconds(m.header.stamp) for _, m in bag.of("tap_command") if m.request == 0
    }
    rows = []
    for record in records:
        at_rest = _seconds(record.at_rest_at)
        fired = _seconds(record.fired_at)
        rows.append(
            TapRow(
                number=int(record.number),
                tap_id=int(record.tap_id),
                method=str(record.planner),
                before=_pose(record.object_pose),
                commanded=Pose(float(record.dx), float(record.dy), float(record.dtheta)),
                predicted=_pose(record.predicted_pose),
                measured=_pose(record.measured_pose.pose),
                true_pose=_truth_at(truths, at_rest),
                strike=_pose(record.strike_pose),
                striker_speed=float(record.striker_speed),
                contact_angle=float(record.contact_angle),
                outcome=word(OUTCOMES, int(record.outcome)),
                measured_speed=float(record.measured_speed),
                commanded_at=commanded.get(int(record.tap_id), math.nan) - began,
                fired_at=fired - began if fired else math.nan,
                at_rest_at=at_rest - began if at_rest else math.nan,
                learnt=_learnt(record),
                reason=str(getattr(record, "reason", "")),
                predicted_covariance=_covariance(record),
                tapper=str(getattr(record, "tapper", "")),
                expected_taps=float(getattr(record, "expected_taps", math.nan)),
                expected_seconds=float(getattr(record, "expected_seconds", math.nan)),
            )
        )
    return tuple(rows)


def _covariance(record: Any) -> Covariance | None:
    """Return the covariance of the predicted pose; None for records of earlier versions."""
    values = [float(value) for value in getattr(record, "predicted_covariance", ())]
    if len(values) != 9 or not any(values) or not all(map(math.isfinite, values)):
        return None
    return (tuple(values[:3]), tuple(values[3:6]), tuple(values[6:]))  # type: ignore[return-value]


def _learnt(record: Any) -> Learnt:
    """Return the estimates after a tap; all NaN for records of earlier versions."""
    gains = getattr(record, "learnt", None)
    if gains is None:
        return Learnt()
    return Learnt(**{field.name: float(getattr(gains, field.name)) for field in fields(Learnt)})


def _pose_at(seen: list[tuple[float, Any]], asked: float) -> Pose | None:
    """Return the last resting pose up to the time ``asked``. If there is none, return the first
    resting pose after it, or None."""
    before = [message for at, message in seen if at <= asked + SAME_TIME_S]
    message = before[-1] if before else (seen[0][1] if seen else None)
    return None if message is None else _pose(message.pose.pose)


def _start(seen: list[tuple[float, Any]], asked: float, taps: Sequence[TapRow]) -> Pose | None:
    """Return the resting pose at the beginning of a run. If the recorder connected to the camera's
    node only after the first tap, return the pose for which that tap was planned."""
    if taps and taps[0].number == 1 and all(at > asked + SAME_TIME_S for at, _ in seen):
        return taps[0].before
    return _pose_at(seen, asked)


def _truth_at(truths: list[tuple[float, Pose]], at: float) -> Pose | None:
    """Return the ground truth pose nearest to a time; None if unknown."""
    if not truths:
        return None
    place = bisect.bisect_left(truths, at, key=lambda entry: entry[0])
    near = truths[max(0, place - 1) : place + 1]
    stamp, pose = min(near, key=lambda entry: abs(entry[0] - at))
    return pose if abs(stamp - at) <= TRUTH_WITHIN_S else None


def _outcome(
    last: Any,
    refused: bool,
    goal: Pose | None,
    final_true: Pose | None,
    tolerance: tuple[float, float],
) -> str:
    """Determine the outcome from the planner's last state and the ground truth, if known."""
    if refused:
        return REFUSED
    phase = word(PHASES, int(last.state))
    if phase not in _FINAL_WORDS:
        return UNFINISHED
    if phase != "reached" or last.error_code:
        return CANCELED if phase == "canceled" else FAILED
    truly = final_true is None or (goal is not None and inside(goal, final_true, tolerance))
    return REACHED if truly else NOT_TRULY_REACHED


def _phases(plans: list[Any], began: float) -> tuple[Phase, ...]:
    found: list[Phase] = []
    for plan in plans:
        name = word(PHASES, int(plan.state))
        if not found or found[-1].name != name:
            found.append(Phase(max(0.0, _seconds(plan.header.stamp) - began), name))
        if name in _FINAL_WORDS:
            break
    return tuple(found)


def _errors(bag: Bag, began: float, ended: float) -> tuple[ErrorEvent, ...]:
    """Return the warnings and errors that occurred while the goal was active. A problem that
    persists is listed once."""
    found = []
    for topic in _STATE_TOPICS:
        before = 0
        for _, message in bag.of(topic):
            at, code = _seconds(message.header.stamp), int(message.error_code)
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
