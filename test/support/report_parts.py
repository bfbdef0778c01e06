"""Runs and taps as the reports read them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from tapping_cell.report.run import REACHED, Run, RunObject, TapRow
from tapping_cell.se2 import Pose


def tap_row(number: int = 1, **changed: Any) -> TapRow:
    """Return a tap of 40 mm along x with a rotation of 0.2 rad; ``changed`` replaces fields."""
    plain: dict[str, Any] = {
        "tap_id": number,
        "method": "optimal",
        "before": Pose(0.0, 0.0, 0.0),
        "commanded": Pose(0.04, 0.0, 0.2),
        "predicted": Pose(0.04, 0.0, 0.2),
        "measured": Pose(0.041, 0.0, 0.21),
        "true_pose": None,
        "strike": Pose(-0.08, 0.0, 0.0),
        "striker_speed": 0.7,
        "contact_angle": math.pi,
        "outcome": "fired",
    }
    return TapRow(number=number, **{**plain, **changed})


def made_run(taps: Sequence[TapRow] = (), **changed: Any) -> Run:
    """Return a run of one object with these taps that has reached its goal; ``changed`` replaces
    fields of the run or of its object, whose name is ``object_name``."""
    end = taps[-1].measured if taps else None
    of_object: dict[str, Any] = {
        "name": changed.pop("object_name", ""),
        "goal": end,
        "start": taps[0].before if taps else Pose(0.0, 0.0, 0.0),
        "end": end,
        "tolerance": (0.001, 0.02),
    }
    for name in ("goal", "start", "end", "outline", "tolerance"):
        if name in changed:
            of_object[name] = changed.pop(name)
    plain: dict[str, Any] = {
        "name": "made",
        "outcome": REACHED,
        "wall_time": 10.0,
        "seed": None,
        "versions": {},
        "error_code": 0,
        "error_msg": "",
        "table_size": (0.6, 0.44),
    }
    return Run(objects=(RunObject(**of_object),), taps=tuple(taps), **{**plain, **changed})
