"""Success, true errors and taps of the positioning cell over many goals, without ROS.

The observations have noise of 0.05 mm and 0.05 degrees. Three groups of trials are run:

- goals anywhere in the working disc with any rotation of the object, ``count`` trials;
- goals at the centre of the disc with rotations of up to 30 degrees, a tenth of ``count`` trials;
- the same goals, also a tenth of ``count`` trials, with mounts that differ from the cell file by
  0.5 mm and 0.5 degrees (standard deviations); these differences are learnt while tapping.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from tapping_cell.configuration.assembly import make_fixed_space, make_planner_settings
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.planning import CameraNoise
from tapping_cell.planning.evaluation.fixed_cell import FixedEvaluation, evaluate_fixed
from tapping_cell.planning.evaluation.task import End

DEFAULT_COUNT = 10_000
PART = 250
"""Number of trials in a part. All trials of a part have the same goal."""
CELL = shared_folder() / "positioning_cell" / "cell.yaml"
CAMERA = CameraNoise(5e-5, math.radians(0.05))
MOUNT_ERROR = (5e-4, math.radians(0.5))
SEED = 7


class Part(NamedTuple):
    """Some trials of one group. ``number`` is the index of the part and its random seed."""

    group: str
    number: int
    trials: int


GROUPS = ("anywhere", "centre", "centre, wrong mounts")


def partial_reports(count: int = DEFAULT_COUNT) -> Iterator[dict[str, Any]]:
    """Yield the results of all groups after every part."""
    shares = (count, max(1, count // 10), max(1, count // 10))
    parts = [
        Part(group, number, min(PART, share - PART * number))
        for group, share in zip(GROUPS, shares, strict=True)
        for number in range(math.ceil(share / PART))
    ]
    found: dict[str, dict[str, list[Any]]] = {group: {} for group in GROUPS}
    with ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for part, result in zip(parts, pool.map(_results, parts), strict=True):
            for name, values in result.items():
                found[part.group].setdefault(name, []).extend(values)
            yield {"groups": {group: _figures(rows) for group, rows in found.items() if rows}}


def _evaluation(part: Part) -> FixedEvaluation:
    cell = load_cell(CELL)
    settings = replace(make_planner_settings(cell, cell.tolerance), camera=CAMERA)
    x, y, radius = cell.fixed_tappers.working_area
    goal, angle = (x, y, 0.0), math.radians(30.0)
    if part.group == "anywhere":
        random = np.random.default_rng((SEED, part.number))
        distance, bearing = radius * math.sqrt(random.random()), random.uniform(-math.pi, math.pi)
        goal = (x + distance * math.cos(bearing), y + distance * math.sin(bearing), 0.0)
        angle = math.pi
    return FixedEvaluation(
        space=make_fixed_space(cell),
        settings=settings,
        trials=part.trials,
        goal=goal,
        start_angle=angle,
        mount_error=MOUNT_ERROR if part.group == "centre, wrong mounts" else (0.0, 0.0),
        seed=1000 * SEED + part.number,
    )


def _results(part: Part) -> dict[str, list[Any]]:
    results = evaluate_fixed(_evaluation(part))
    return {
        "taps": results.taps.tolist(),
        "done": (results.end == End.DONE).tolist(),
        "inside": results.inside.tolist(),
        "left": results.over_edge.tolist(),
    }


def _figures(rows: dict[str, list[Any]]) -> dict[str, Any]:
    taps, done = np.array(rows["taps"]), np.array(rows["done"])
    inside = np.array(rows["inside"])
    return {
        "trials": int(taps.size),
        "done": int(done.sum()),
        "inside": int((done & inside).sum()),
        "taps": float(taps[done].mean()) if np.any(done) else math.nan,
        "p99": int(np.percentile(taps[done], 99)) if np.any(done) else -1,
        "most": int(taps.max()),
        "left": int(np.sum(rows["left"])),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    rows = [
        f"{'goals':22s}{'trials':>8s}{'reached':>9s}{'truly inside':>14s}{'mean taps':>11s}"
        f"{'99 %':>6s}{'most':>6s}{'outside the area':>18s}"
    ]
    rows += [
        f"{group:22s}{part['trials']:8d}{part['done']:9d}{part['inside']:14d}{part['taps']:11.2f}"
        f"{part['p99']:6d}{part['most']:6d}{part['left']:18d}"
        for group, part in report["groups"].items()
    ]
    return rows
