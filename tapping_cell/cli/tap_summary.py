"""Summary of a single-tap experiment, as text or JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from tapping_cell.calibration.design import Design
from tapping_cell.calibration.design import progress as progress_of
from tapping_cell.calibration.trials import Trial, completed, run_name
from tapping_cell.cli.tap_series import Done


def trial_text(done: Done) -> str:
    """Format the outcome of a trial."""
    trial = completed(done.trial)
    what = f"run {trial.run}, trial {trial.trial}: "
    if trial.outcome != "ok":
        return what + f"{trial.outcome} ({trial.note})"
    return what + (
        f"{1000 * trial.displacement:.1f} mm and {math.degrees(trial.rotation):+.1f} deg "
        f"({1000 * done.expected:.1f} mm expected)"
    )


def print_summary(
    folder: Path,
    design: Design,
    trials: list[Trial],
    end: tuple[int, str],
    console: Console,
    *,
    as_json: bool,
) -> None:
    """Print one row per run, and why the experiment ended. ``end`` is the error code and the
    message, or 0 and an empty text if the experiment is complete."""
    rows = [_row(design, trials, number) for number in range(len(design.runs))]
    code, sentence = end
    if as_json:
        content = {
            "folder": str(folder),
            "complete": all(row["used"] == design.trials for row in rows),
            "error_code": code,
            "error_msg": sentence,
            "runs": rows,
        }
        print(json.dumps(content, indent=2))
        return
    table = Table(title=f"single taps in {folder.name}")
    for title in ("run", "striker mm/s", "incidence deg", "used", "left out", "mm", "deg"):
        table.add_column(title, justify="right")
    for row in rows:
        table.add_row(
            str(row["run"]),
            f"{row['striker_speed_mm_s']:.0f}",
            f"{row['incidence_deg']:.1f}",
            f"{row['used']} of {design.trials}",
            ", ".join(f"{n} {word}" for word, n in row["left_out"].items()) or "none",
            _spread_text(row["displacement_mm"]),
            _spread_text(row["rotation_deg"]),
        )
    console.print(table)
    if not sentence:
        console.print(
            f"[green]complete[/green]; next: python -m tapping_cell object fit {folder}",
            highlight=False,
        )
        return
    console.print(
        f"[red]stopped[/red] (code {code}): {sentence}; finished trials are kept, continue "
        f"with --resume {folder}",
        highlight=False,
    )


def _row(design: Design, trials: list[Trial], index: int) -> dict[str, Any]:
    """Return the results of one run."""
    run = design.runs[index]
    own = [completed(trial) for trial in trials if trial.run == run.number]
    used = [trial for trial in own if trial.outcome == "ok"]
    bad = [trial.outcome for trial in own if trial.outcome != "ok"]
    return {
        "run": run.number,
        "striker_speed_mm_s": 1000 * run.striker_speed,
        "incidence_deg": math.degrees(run.incidence),
        "used": progress_of(design, trials)[run.number].used,
        "left_out": {word: bad.count(word) for word in sorted(set(bad))},
        "displacement_mm": _mean_and_deviation([1000 * t.displacement for t in used]),
        "rotation_deg": _mean_and_deviation([math.degrees(t.rotation) for t in used]),
        "file": run_name(run.number) if own else None,
    }


def _mean_and_deviation(values: list[float]) -> list[float] | None:
    """Return mean and standard deviation; None without values."""
    if not values:
        return None
    deviation = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return [round(float(np.mean(values)), 4), round(deviation, 4)]


def _spread_text(spread: object) -> str:
    return f"{spread[0]:.1f} +- {spread[1]:.1f}" if isinstance(spread, list) else ""
