"""Taps and true errors of demos whose tolerance is a tenth of that in the paper.

Each demo starts all nodes as processes and moves the disk by 10 mm and 10 degrees to within 0.1 mm
and 0.1 degrees, with rendered images and the scatter of the simulated world. The random seed
determines noise and scatter.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tapping_cell.configuration.files import shared_folder

DEFAULT_COUNT = 20
TOLERANCE = 0.1
"""Tolerance in mm and in degrees."""


def partial_reports(count: int) -> Iterator[dict[str, Any]]:
    """Yield the results of the demos so far, after each demo."""
    with tempfile.TemporaryDirectory() as name:
        cell = _fine_cell(Path(name))
        demos = []
        for seed in range(1, count + 1):
            demos.append(_demo(cell, seed, Path(name) / f"run{seed}"))
            yield {"demos": demos, "load": os.getloadavg()[0]}


def _fine_cell(folder: Path) -> Path:
    """Write a copy of the supplied configuration with the finer tolerance; return its cell file."""
    copy = folder / "config"
    shutil.copytree(shared_folder(), copy)
    path = copy / "cell.yaml"
    cell = yaml.safe_load(path.read_text(encoding="utf-8"))
    cell["goal"]["position_tolerance"] = 1e-3 * TOLERANCE
    cell["goal"]["angle_tolerance"] = math.radians(TOLERANCE)
    path.write_text(yaml.safe_dump(cell), encoding="utf-8")
    return path


def _demo(cell: Path, seed: int, out: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "tapping_cell", "demo", "--cell", str(cell), "--out", str(out)]
    ended = subprocess.run(
        [*command, "--seed", str(seed), "--json", "--quiet"], capture_output=True, text=True
    )
    try:
        record = json.loads(ended.stdout)
    except json.JSONDecodeError:
        raise RuntimeError(f"the demo with seed {seed} failed: {ended.stderr}") from None
    true = record["true_residual"]
    return {
        "seed": seed,
        "outcome": record["outcome"],
        "taps": record["taps"],
        "seconds": record["wall_time"],
        "distance_mm": true["distance_mm"],
        "rotation_deg": true["rotation_deg"],
        "inside": max(true["distance_mm"], true["rotation_deg"]) <= TOLERANCE,
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    demos = report["demos"]
    reached = [demo for demo in demos if demo["outcome"] == "reached"]
    rows = [
        f"{len(reached)} of {len(demos)} reached, {sum(demo['inside'] for demo in reached)} of them"
        f" truly inside {TOLERANCE:g} mm and {TOLERANCE:g} degrees"
    ]
    if reached:
        rows.append(
            f"taps: mean {np.mean([demo['taps'] for demo in reached]):.2f}, each "
            + " ".join(str(demo["taps"]) for demo in reached)
            + f"; mean {np.mean([demo['seconds'] for demo in reached]):.1f} s"
        )
        for name, unit in (("distance_mm", "mm"), ("rotation_deg", "degrees")):
            errors = [demo[name] for demo in reached]
            rows.append(
                f"true error: median {np.median(errors):.3f}, largest {max(errors):.3f} {unit}"
            )
    rows += [
        f"seed {demo['seed']}: {demo['outcome']} after {demo['taps']} taps"
        for demo in demos
        if demo["outcome"] != "reached"
    ]
    return [*rows, f"load {report['load']:.1f} on {os.cpu_count()} cores"]
