"""Data of one arrangement of several objects for its report, and the file that stores these
data."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tapping_cell.report.run_folder import run_errors
from tapping_cell.se2 import Pose

SUMMARY = "arrangement.json"
"""Name of the file in a run folder."""


@dataclass(frozen=True, slots=True)
class ArrangedObject:
    """One object of an arrangement. Poses in ``table``, m and rad; None if unknown.

    ``outline``: corners in the object's frame, in m. ``goal`` is None for an object that may be
    moved only out of the way of other objects. ``end`` is the last measured pose, and ``end_true``
    the true pose at the end. ``outcome``: state of the object at the end, in words. ``tolerance``
    is that of the goal in m and rad, or None without a goal.
    """

    name: str
    outline: tuple[tuple[float, float], ...]
    start: Pose | None
    goal: Pose | None
    end: Pose | None
    end_true: Pose | None
    outcome: str
    taps: int
    tolerance: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class ArrangedTap:
    """One tap: poses of its object in ``table`` (m, rad), speed in m/s.

    ``measured`` is None if the object was not seen afterwards. ``purpose``: why this object was
    tapped now. ``reason``: why the tap was not the planner's first choice. Both may be empty.
    ``at_rest_at``: time at which the object was at rest again, in s since the start of the
    arrangement; None if unknown.
    """

    number: int
    name: str
    before: Pose
    predicted: Pose
    measured: Pose | None
    strike: Pose
    striker_speed: float
    outcome: str
    purpose: str
    reason: str
    at_rest_at: float | None = None


@dataclass(frozen=True, slots=True)
class ArrangementRun:
    """One arrangement from its request to its end.

    ``began``: s since 1970. ``seconds``: duration. ``table_size`` in m. ``contacts``: for each
    contact in the ground truth, the names of the two objects that touched; None without ground
    truth.
    """

    name: str
    began: float
    seconds: float
    table_size: tuple[float, float]
    objects: tuple[ArrangedObject, ...]
    taps: tuple[ArrangedTap, ...]
    contacts: tuple[tuple[str, str], ...] | None
    error_code: int
    error_msg: str
    note: str = ""
    """Why the report shows less than the arrangement had; empty if it shows all of it."""


@dataclass(frozen=True, slots=True)
class ArrangedMove:
    """Consecutive taps of one object with one purpose.

    ``before``, ``after``: measured poses of all objects, by name.
    """

    name: str
    purpose: str
    taps: tuple[ArrangedTap, ...]
    before: dict[str, Pose]
    after: dict[str, Pose]


def moves_of(run: ArrangementRun) -> list[ArrangedMove]:
    """Group the taps of an arrangement into moves."""
    poses = {one.name: one.start for one in run.objects if one.start is not None}
    groups: list[list[ArrangedTap]] = []
    for tap in run.taps:
        if groups and (groups[-1][0].name, groups[-1][0].purpose) == (tap.name, tap.purpose):
            groups[-1].append(tap)
        else:
            groups.append([tap])
    moves = []
    for taps in groups:
        first = taps[0]
        poses = {**poses, first.name: first.before}
        seen = [tap.measured for tap in taps if tap.measured is not None]
        after = {**poses, first.name: seen[-1]} if seen else poses
        moves.append(ArrangedMove(first.name, first.purpose, tuple(taps), poses, after))
        poses = after
    return moves


def to_content(run: ArrangementRun) -> dict[str, Any]:
    """Convert an arrangement to JSON values."""
    content: dict[str, Any] = _finite(asdict(run))
    return content


def read_arrangement(folder: Path) -> ArrangementRun:
    """Read an arrangement from its folder.

    Raises:
        RunError: the file is missing or damaged.
    """
    path = folder / SUMMARY
    with run_errors(path, "the folder of an arrangement"):
        content = json.loads(path.read_text(encoding="utf-8"))["run"]
        return ArrangementRun(
            **{
                **content,
                "table_size": tuple(content["table_size"]),
                "objects": tuple(_object(each) for each in content["objects"]),
                "taps": tuple(_tap(each) for each in content["taps"]),
                "contacts": None
                if content["contacts"] is None
                else tuple((str(one), str(other)) for one, other in content["contacts"]),
            }
        )


def _object(content: dict[str, Any]) -> ArrangedObject:
    poses = {key: _pose(content[key]) for key in ("start", "goal", "end", "end_true")}
    outline = tuple((float(x), float(y)) for x, y in content["outline"])
    tolerance = None if content["tolerance"] is None else tuple(content["tolerance"])
    return ArrangedObject(**{**content, **poses, "outline": outline, "tolerance": tolerance})


def _tap(content: dict[str, Any]) -> ArrangedTap:
    poses = {key: _pose(content[key]) for key in ("before", "predicted", "measured", "strike")}
    if None in (poses["before"], poses["predicted"], poses["strike"]):
        raise ValueError(f"tap {content['number']} has no pose")
    return ArrangedTap(**{**content, **poses})


def _pose(content: Sequence[float] | None) -> Pose | None:
    return None if content is None else Pose(*(float(value) for value in content))


def _finite(value: Any) -> Any:
    """Replace poses that are not finite by None, because JSON has no such numbers."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        numbers = [each for each in value if isinstance(each, float)]
        return None if not all(map(math.isfinite, numbers)) else [_finite(each) for each in value]
    return value
