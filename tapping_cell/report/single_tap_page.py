"""Output of the report on single-tap experiments as one self-contained HTML file."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from tapping_cell.report import single_tap_figures as figures
from tapping_cell.report.page_style import document, scrolling_table
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
    figures.RESIDUALS: "Residuals of each trial: differences between measured and calculated "
    "values, and the friction of each trial alone.",
    figures.ERRORS: "Prediction error of each run's mean. The last two predictions include the "
    "tapper's own scatter: the mean displacement of ten taps with 5 % scatter in speed scatters "
    "by 3 %.",
    figures.VALUES: "Fitted values with 95 % intervals, and the old values.",
}


def write_page(report: SingleTapReport, folder: Path) -> Path:
    """Write figures and ``report.html``, creating the folder if missing; return the page's path."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn = figures.write_figures(report, folder)
    body = [
        f'<header class="good"><h1>{escape(report.title)}</h1>'
        f"<p>{escape(_summary(report))}</p></header>",
        _section("Fitted values", _values(report.parameters)),
        _section("What the trials determine", _list(report.sentences)) if report.sentences else "",
        *(_figure(file) for file in drawn),
        _section("Prediction error of each run, percent", _errors(report.runs)),
        _section("Striker", _list(report.tapper)) if report.tapper else "",
        _section("Left out", _list(report.left_out)) if report.left_out else "",
        _section("Data", _facts(report)),
    ]
    page = folder / PAGE
    page.write_text(document(report.title, "".join(body)), encoding="utf-8")
    return page


def _summary(report: SingleTapReport) -> str:
    left_out = f", {len(report.left_out)} left out" if report.left_out else ""
    return f"{len(report.labels)} taps in {len(report.runs)} runs{left_out}; fitted {report.made}"


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>"


def _figure(file: Path) -> str:
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    caption = escape(_CAPTIONS[file.name])
    return (
        f'<section><figure><img alt="{caption}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure></section>"
    )


def _list(entries: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(entry)}</li>" for entry in entries) + "</ul>"


def _table(name: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    titles = "".join(
        f'<th class="{"" if i == 0 else "number"}">{escape(title)}</th>'
        for i, title in enumerate(head)
    )
    lines = "".join(
        "<tr>"
        + "".join(
            f'<td class="{"" if i == 0 else "number"}">{escape(cell)}</td>'
            for i, cell in enumerate(row)
        )
        + "</tr>"
        for row in rows
    )
    return scrolling_table(name, f"<tr>{titles}</tr>{lines}")


def _values(parameters: Sequence[Parameter]) -> str:
    rows = []
    for p in parameters:
        fitted = math.isfinite(p.low)
        interval = f"{p.low:.4g} to {p.high:.4g}" if fitted else "not fitted"
        change = 100 * (p.value / p.old - 1) if fitted and p.old else math.nan
        rows.append(
            (
                p.name,
                _number(p.old, ".4g"),
                f"{p.value:.4g}",
                interval,
                _number(change, "+.1f", " %"),
            )
        )
    return _table("Parameters", ("", "old", "fitted", "95 % interval", "change"), rows)


def _errors(runs: Sequence[RunError]) -> str:
    head = (
        "run",
        "trials",
        *(
            f"{what}: {part}"
            for what in (
                "displacement from velocity",
                "velocity from displacement",
                "velocity from striker",
                "displacement from striker",
            )
            for part in ("translation", "rotation")
        ),
    )
    rows = (
        (
            run.label,
            str(run.trials),
            *(
                _number(value, "+.1f")
                for pair in (run.sliding, run.inverse, run.impact, run.tap)
                for value in pair
            ),
        )
        for run in runs
    )
    return _table("Prediction errors", head, rows)


def _facts(report: SingleTapReport) -> str:
    rows = [(key, value) for key, value in report.facts.items()]
    rows += [("input", entry) for entry in report.inputs]
    return (
        "<table>"
        + "".join(f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in rows)
        + "</table>"
    )


def _number(value: float, form: str, unit: str = "") -> str:
    return f"{value:{form}}{unit}" if math.isfinite(value) else "-"
