"""Fit an object's friction, torque factor and impact to records of single taps.

RECORDS are folders with experiment.yaml, run_01.csv ... and tracks, as written by single-tap, or
CSV files from another source (docs/objects.md describes the columns). Unusable rows are
reported with file and row, and ignored.

Shape and mass are taken from --object, or from the object in the records' header. With --output,
the fitted values are written to an object file that the planner reads; without --output, no object
file is written. An existing file is replaced only with --force. If the existing file has smaller
residuals or a smaller uncertainty than the new result, --accept-worse is required as well.

  python -m tapping_cell object fit records/ --output config/objects/my_disk.yaml --report report
  python -m tapping_cell object fit mine.csv --object config/objects/aluminium_disk.yaml --json
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tapping_cell.cli import argument_types
from tapping_cell.cli.errors import print_error
from tapping_cell.cli.objects.fit_labels import shown, speed_lines

if TYPE_CHECKING:
    from tapping_cell.calibration.estimates import Estimate
    from tapping_cell.calibration.experiment import Experiment
    from tapping_cell.calibration.object_fit import ObjectFit
    from tapping_cell.configuration.objects import ObjectFile


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    from tapping_cell.cli.calibration_arguments import add_output_arguments

    parser.add_argument(
        "records", nargs="+", type=Path, metavar="RECORDS", help="folder of records, or CSV file"
    )
    parser.add_argument(
        "--object",
        type=Path,
        metavar="FILE",
        help="object file with the shape, the mass and the previous values (default: the object "
        "in the records)",
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="DIR",
        help="folder for figures, report.html and single_taps.csv, a table of all trials",
    )
    argument_types.add_seed(parser, 0, "random seed of the bootstrap (default: 0)")
    add_output_arguments(parser, required=False)


def run(arguments: argparse.Namespace) -> int:
    """Run the fit. Return 0 on success, 2 for unusable records or files."""
    from tapping_cell.calibration.csv_table import RecordError
    from tapping_cell.calibration.experiment import read_experiment
    from tapping_cell.calibration.keep import KeptFile, write_kept
    from tapping_cell.calibration.object_file import fit_record, fitted_object, object_yaml
    from tapping_cell.calibration.object_fit import fit_object
    from tapping_cell.cli.calibration_arguments import output_of
    from tapping_cell.configuration.objects import load_object
    from tapping_cell.configuration.schema import ConfigurationError

    try:
        output = None if arguments.output is None else output_of(arguments)
        experiments = [read_experiment(place.expanduser()) for place in arguments.records]
        content = _content(experiments, arguments.object)
        fit = fit_object(experiments, content, arguments.seed)
        record = fit_record(fit, sorted({Path(entry.trial.file) for entry in fit.used}))
        if output is not None:
            text = object_yaml(fitted_object(fit, record), record)
            write_kept(output, text, record, load_object)
        if arguments.report is not None:
            from tapping_cell.cli.objects.fit_report import write_report, write_trials

            write_report(arguments.report.expanduser(), fit, record)
            write_trials(arguments.report.expanduser(), fit, experiments)
    except (RecordError, KeptFile, ConfigurationError, OSError) as error:
        print_error(str(error))
        return 2
    if arguments.json:
        print(json.dumps(figures(fit), indent=1))
    else:
        print("\n".join(lines(fit)))
        if arguments.report is not None:
            print(f"report in {arguments.report / 'report.html'}")
        print(
            "no object file written; give --output FILE to keep the values"
            if output is None
            else f"written to {output.path}"
        )
    return 0


def _content(experiments: Sequence[Experiment], path: Path | None) -> ObjectFile:
    """Return the tapped object, from the given file or from the header of the records."""
    from tapping_cell.calibration.csv_table import RecordError
    from tapping_cell.configuration.objects import load_object

    headers = [entry.header.object for entry in experiments]
    first = headers[0]
    if path is not None:
        given = load_object(path.expanduser())
        if first is not None and first.shape.kind != given.shape.kind:
            raise RecordError(
                f"{path} describes a {given.shape.kind}, but the records are of '{first.name}', a "
                f"{first.shape.kind}; give the file of the object that was tapped"
            )
        return given
    if first is None:
        raise RecordError(
            f"{experiments[0].folder}: the header names no object; give --object FILE"
        )
    if any(other is None or other.shape != first.shape for other in headers):
        raise RecordError(
            "the records do not all name an object of the same shape; fit each object separately"
        )
    return first


def figures(fit: ObjectFit) -> dict[str, Any]:
    """Return all results, in SI units."""
    return {
        "object": fit.content.name,
        "trials": len(fit.used),
        "runs": len(fit.runs),
        "estimates": {
            entry.name: {
                "value": entry.value,
                "low": _number(entry.low),
                "high": _number(entry.high),
                "std": _number(entry.std),
                "old": _number(entry.old),
                "fitted": entry.fitted,
            }
            for entry in fit.estimates
        },
        "paper_criterion": fit.paper._asdict(),
        "runs_errors": [
            {name: _number(getattr(run, name)) for name in run.__slots__} for run in fit.runs
        ],
        "left_out": [entry._asdict() for entry in fit.left_out],
        "identifiability": list(fit.sentences),
        "striker_speeds": [
            {name: _number(value) for name, value in point._asdict().items()}
            for point in fit.tapper
        ],
        "friction_scatter": fit.slide.friction_scatter,
        "track_position_rms": _number(fit.slide.position_rms),
        "track_rotation_rms": _number(fit.slide.rotation_rms),
    }


def _number(value: Any) -> Any:
    """Replace NaN, which JSON does not support, by None."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def lines(fit: ObjectFit) -> list[str]:
    """Format the result in mm, degrees and percent."""
    text = [
        f"{fit.content.name}: {len(fit.used)} trials in {len(fit.runs)} runs, "
        f"{len(fit.left_out)} left out",
        *(f"  left out: {entry}" for entry in fit.left_out),
        "",
        f"  {'':<32}{'old':>9}{'fitted':>9}   95 % interval",
    ]
    text.extend(_row(entry) for entry in fit.estimates)
    text.append(
        f"  with the fit criterion of Huang and Mason: friction {fit.paper.friction:.4f}, "
        f"torque factor {fit.paper.torque_factor:.3f}"
    )
    text += ["", "  prediction error in percent, for the mean of each run's trials:"]
    text.extend(_run_rows(fit))
    if fit.tapper:
        text += ["", "  striker speed:", *(f"    {line}" for line in speed_lines(fit))]
    text += ["", *(f"  {sentence}" for sentence in fit.sentences)]
    return text


def _row(entry: Estimate) -> str:
    label, factor = shown(entry)
    old = "-" if math.isnan(entry.old) else f"{factor * entry.old:.4g}"
    row = f"  {label:<32}{old:>9}{factor * entry.value:>9.4g}"
    if not entry.fitted:
        return row + "   not fitted"
    return row + f"   {factor * entry.low:.4g} to {factor * entry.high:.4g}"


_ERRORS = (
    ("sliding", ("distance", "rotation"), "displacement from measured velocity"),
    ("inverse", ("speed", "spin"), "velocity from measured displacement"),
    ("impact", ("speed", "spin"), "velocity from the striker"),
    ("tap", ("distance", "rotation"), "displacement from the striker"),
)
"""Predictions that are compared with the measurements: name, quantities and title."""


def _run_rows(fit: ObjectFit) -> Iterator[str]:
    yield "    run  trials" + "".join(f"  {title:>36}" for *_, title in _ERRORS)
    for run in fit.runs:
        cells = []
        for name, quantities, _ in _ERRORS:
            errors = {each: getattr(run, f"{name}_{each}") for each in quantities}
            known = not math.isnan(errors[quantities[0]])
            texts = (f"{each} {100 * error:+.1f}" for each, error in errors.items())
            cells.append(", ".join(texts) if known else "-")
        yield f"    {run.label:<5}{run.trials:>5} " + "".join(f"  {cell:>36}" for cell in cells)
