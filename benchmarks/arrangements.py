"""Arrangement of several objects: success, contacts and taps, compared with the baselines.

The scenes contain disks and squares with radii of 20 to 40 mm and gaps of 40 mm, or nine disks with
a radius of 25 mm whose goals form a grid. The trials use the published scatter, systematic errors
of 5 % in distance and 15 % in rotation, and a camera with 0.1 mm and 0.1 degrees of noise. The
ground truth of every pose and every contact is recorded.
"""

from __future__ import annotations

import argparse
import functools
from typing import Any

from tapping_cell.cli import evaluate
from tapping_cell.planning.evaluation.arrangements import (
    METHODS,
    ArrangementTask,
    evaluate_arrangements,
    summarise_arrangements,
)

DEFAULT_COUNT = 200

GAIN_BIAS = (0.05, 0.15)
OPTIONS = ["--camera-noise", "0.1", "0.1"]

Group = tuple[str, ArrangementTask, list[str], float]
"""Name, task, additional options of the shapes, share of the count."""


def groups() -> list[Group]:
    """Groups of trials: first the built-in planner, then four random goals with the baselines."""
    made: list[Group] = [
        ("2 swapped", ArrangementTask(2, "swap", gain_bias=GAIN_BIAS), [], 1.0),
        ("4 random", ArrangementTask(4, gain_bias=GAIN_BIAS), [], 1.0),
        ("8 random", ArrangementTask(8, gain_bias=GAIN_BIAS), [], 0.25),
    ]
    made += [
        (f"4 random, {method}", ArrangementTask(4, gain_bias=GAIN_BIAS, method=method), [], 0.25)
        for method in METHODS
        if method != "sequence"
    ]
    made += [
        (
            f"9 disks, gap {gap} mm",
            ArrangementTask(9, "grid", grid_gap=1e-3 * gap, gap=0.02, gain_bias=GAIN_BIAS),
            ["--goals", "grid", "--radius", "25"],
            0.1,
        )
        for gap in (40, 60)
    ]
    return made


def measure(count: int = DEFAULT_COUNT) -> dict[str, Any]:
    """Return a row per group, each over its share of ``count`` scenes."""
    rows = []
    for name, task, options, share in groups():
        parser = argparse.ArgumentParser()
        evaluate.add_arguments(parser)
        kinds = functools.partial(
            evaluate.arrangement_kinds, parser.parse_args([*OPTIONS, *options])
        )
        trials = evaluate_arrangements(task, kinds, max(1, round(share * count)), 1, 1)
        rows.append({"name": name, **summarise_arrangements(trials)})
        print(_row(rows[-1]), flush=True)
    return {"rows": rows}


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    return [
        "contacts: scenes in which objects met, or the resting tool would have touched another;",
        "price: taps over those of each object alone; a decision: seconds of processor",
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
