"""Number of taps for the published task (10 mm and 10 degrees), and the share of the finished
trials whose true pose is within the tolerance, at tolerances of 1, 0.3, 0.1 and 0.05 (mm and
degrees).

The trials use the abstract model with the scatter from the paper (5 % in distance, 15 % in
rotation, 1 degree in direction) and camera noise of 0.01 mm and 0.01 degrees. The benchmark also
considers a goal whose distance is exactly the length of the smallest tap. The benchmark computes
the probability that this tap ends inside the stopping box, the region around the goal for which
plans are made. The benchmark also measures the processor time for computing the coarse plan, which
is used first, and the fine plan.
"""

from __future__ import annotations

import math
import time
from typing import Any

from tapping_cell.planning import CameraNoise, PlannerSettings
from tapping_cell.planning.evaluation import Evaluation, evaluate, summarise
from tapping_cell.planning.policy_cache import keep_policy
from tapping_cell.planning.precision_limit import smallest_tap_share
from tapping_cell.planning.value_iteration import solutions

DEFAULT_COUNT = 4000
TOLERANCES = (1.0, 0.3, 0.1, 0.05)
SMALLEST_TAPS_MM = (1.7, 1.0)


def measure(count: int = DEFAULT_COUNT) -> dict[str, Any]:
    """Return one row of results for each pair of smallest tap and tolerance, with the means over
    ``count`` trials."""
    rows = []
    for least in SMALLEST_TAPS_MM:
        for tolerance in TOLERANCES:
            settings = settings_of(least, tolerance)
            began = time.process_time()
            solved = [(time.process_time() - began, plan) for plan in solutions(settings)]
            keep_policy(settings, solved[-1][1])  # so that the trials need not compute it again
            found = summarise(evaluate(Evaluation("optimal", settings, trials=count), 1))
            rows.append(
                {
                    "smallest_tap_mm": least,
                    "tolerance": tolerance,
                    "taps": found["taps"],
                    "truly_inside": found["truly_inside_rate"],
                    "done": found["success_rate"],
                    "smallest_taps_inside": smallest_tap_share(settings),
                    "first_answer_s": solved[0][0],
                    "solved_s": solved[-1][0],
                }
            )
    return {"trials": count, "rows": rows}


def settings_of(least: float, tolerance: float, box: float | None = None) -> PlannerSettings:
    """Return settings for a length of the smallest tap in mm, a tolerance in mm and degrees, and
    a stopping box relative to the tolerance."""
    return PlannerSettings(
        smallest_distance=1e-3 * least,
        tolerance_position=1e-3 * tolerance,
        tolerance_angle=math.radians(tolerance),
        camera=CameraNoise(1e-5, math.radians(0.01)),
        box=box,
    )


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = [
        f"10 mm and 10 degrees, {report['trials']} trials; seconds of processor time",
        "smallest  tolerance  mean taps  90 %   done  truly inside  smallest taps inside  "
        "first plan  whole plan",
    ]
    for row in report["rows"]:
        text.append(
            f"{row['smallest_tap_mm']:5.1f} mm {row['tolerance']:10g} {row['taps']['mean']:10.2f} "
            f"{row['taps']['p90']:5d} {100 * row['done']:5.1f}% {100 * row['truly_inside']:12.2f}% "
            f"{100 * row['smallest_taps_inside']:20.1f}% {row['first_answer_s']:9.2f} s "
            f"{row['solved_s']:9.2f} s"
        )
    return text
