"""Arrangement of several objects: success, contacts and taps, compared with the baselines.

The scenes contain disks and squares with radii of 20 to 40 mm and gaps of 40 mm, or nine disks with
a radius of 25 mm whose goals form a grid. The trials use the scatter from the paper, systematic
errors of 5 % in distance and 15 % in rotation, and a camera with 0.1 mm and 0.1 degrees of noise.
The ground truth of every pose and every contact is recorded.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from tapping_cell.cli import evaluate
from tapping_cell.planning.evaluation.arrangements import (
    METHODS,
    ArrangementTask,
    ArrangementTrial,
    run_arrangement,
    summarise_arrangements,
)

DEFAULT_COUNT = 200
SEED = 1

GAIN_BIAS = (0.05, 0.15)
OPTIONS = ["--camera-noise", "0.1", "0.1"]
GRID_GAPS_MM = (40, 30, 20)

Group = tuple[str, ArrangementTask, list[str], float]
"""A group of trials: its name, its task, additional options for the shapes, and its share. The
number of scenes of the group is the share times the count of the benchmark."""


def groups() -> list[Group]:
    """Return the groups of trials: the built-in planner on all kinds of scenes, then the
    baselines."""
    made: list[Group] = [
        ("2 swapped", ArrangementTask(2, "swap", gain_bias=GAIN_BIAS), [], 1.0),
        ("4 random", ArrangementTask(4, gain_bias=GAIN_BIAS), [], 1.0),
        ("8 random", ArrangementTask(8, gain_bias=GAIN_BIAS), [], 1.0),
    ]
    made += [
        (
            f"9 disks, gap {gap} mm",
            ArrangementTask(9, "grid", grid_gap=1e-3 * gap, gap=0.02, gain_bias=GAIN_BIAS),
            ["--goals", "grid", "--radius", "25"],
            0.25,
        )
        for gap in GRID_GAPS_MM
    ]
    made += [
        (
            f"{count} random, {method}",
            ArrangementTask(count, gain_bias=GAIN_BIAS, method=method),
            [],
            share,
        )
        for count, share in ((4, 1.0), (8, 0.25))
        for method in METHODS
        if method != "sequence"
    ]
    return made


def partial_reports(count: int = DEFAULT_COUNT) -> Iterator[dict[str, Any]]:
    """Yield the report after each group. The number of scenes of a group is its share times
    ``count``."""
    rows: list[dict[str, Any]] = []
    for name, task, options, share in groups():
        parser = argparse.ArgumentParser(allow_abbrev=False)
        evaluate.add_arguments(parser)
        kinds = evaluate.arrangement_kinds(parser.parse_args([*OPTIONS, *options]))
        number = max(1, round(share * count))
        trials: list[ArrangementTrial] = []
        for scene, seed in enumerate(np.random.SeedSequence(SEED).spawn(number)):
            trials.append(run_arrangement(task, kinds, np.random.default_rng(seed))[0])
            done = sum(trial.end == "done" for trial in trials)
            print(f"{name}: {scene + 1} of {number} scenes, {done} done", file=sys.stderr)
        rows.append({"name": name, **summarise_arrangements(trials)})
        yield {"rows": list(rows)}


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    return [
        "contacts: scenes with contacts of objects + of the resting tool with another object;",
        "price: ratio of the taps to those of each object alone; decision: processor time",
        "                          scenes  inside  false  refused  contacts  taps  price  "
        "decision: mean, longest",
        *(_row(row) for row in report["rows"]),
    ]


def _row(row: dict[str, Any]) -> str:
    return (
        f"{row['name']:24s} {row['scenes']:7d} {100 * row['success_rate']:6.1f}% "
        f"{row['false_claims']:6d} {row['refused_before']:4d}+{row['refused_later']:<3d} "
        f"{row['scenes_with_contact']:4d}+{row['scenes_with_tool_contact']:<4d} "
        f"{row['taps_mean']:5.1f} {row['price_of_others']:6.2f} "
        f"{row['decision_mean_s']:10.3f} s {row['decision_slowest_s']:8.2f} s"
    )
