"""Output of the report on single-tap experiments as one self-contained HTML file."""

from __future__ import annotations

import math
from pathlib import Path

from tapping_cell.durable_file import replace_text
from tapping_cell.report import single_tap_figures as figures
from tapping_cell.report.photograph import data_url
from tapping_cell.report.rendering import render
from tapping_cell.report.single_tap import Parameter, RunError, SingleTapReport

PAGE = "report.html"

_CAPTIONS = {
    figures.RUNS: "Displacements and initial velocities of all trials (as figure 3 of the paper). "
    "Crosses are calculated: displacements from the measured initial velocities, velocities from "
    "the measured displacements. Open marks: mean prediction from the striker's speed and "
    "incidence.",
    figures.PROFILES: "Velocity profiles of single trials (as figure 4 of the paper), "
    "predicted from the displacement with the fitted torque factor. The fit itself compares the "
    "poses (right), not the velocities.",
    figures.RESIDUALS: "Residuals of each trial: deviations of the measured from the calculated "
    "velocities, and of the friction fitted to the trial alone from that fitted to all trials.",
    figures.ERRORS: "Prediction error of each run's mean. The last two predictions include the "
    "tapper's own scatter: the mean displacement of ten taps with 5 % scatter in speed scatters "
    "by 3 %.",
    figures.VALUES: "Fitted values with 95 % intervals, and the old values.",
}


def write_page(report: SingleTapReport, folder: Path) -> Path:
    """Write figures and ``report.html``, creating the folder if missing; return the page's path."""
    folder.mkdir(parents=True, exist_ok=True)
    text = render(
        "single_tap.html",
        report=report,
        parameters=[_parameter(parameter) for parameter in report.parameters],
        figures=[
            (data_url("image/png", file.read_bytes()), _CAPTIONS[file.name])
            for file in figures.write_figures(report, folder)
        ],
        errors=[_errors(run) for run in report.runs],
    )
    page = folder / PAGE
    replace_text(page, text)
    return page


def _parameter(p: Parameter) -> tuple[str, ...]:
    fitted = math.isfinite(p.low)
    interval = f"{p.low:.4g} to {p.high:.4g}" if fitted else "not fitted"
    change = 100 * (p.value / p.old - 1) if fitted and p.old else math.nan
    return p.name, _number(p.old, ".4g"), f"{p.value:.4g}", interval, _number(change, "+.1f", " %")


def _errors(run: RunError) -> tuple[str, ...]:
    pairs = (run.sliding, run.inverse, run.impact, run.tap)
    numbers = (_number(value, "+.1f") for pair in pairs for value in pair)
    return run.label, str(run.trials), *numbers


def _number(value: float, form: str, unit: str = "") -> str:
    return f"{value:{form}}{unit}" if math.isfinite(value) else "-"
