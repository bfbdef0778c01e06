"""Rebuild the files of run folders, and compare runs.

A run is a folder written by the recorder or the demo, or only the bag of a run. For each run
folder, summary.json, taps.csv, cell.png and report.html are rebuilt from its bag. If the bag is
missing, only cell.png and report.html are rebuilt, from summary.json and taps.csv. For several
runs, a page comparison.html and the tables runs.csv and runs_taps.csv are also written. If several
paths are given, those that are no runs are skipped.

    python -m tapping_cell report runs/2026-11-21_15-10-00_to_20_10_0
    python -m tapping_cell report runs/* --output comparison
    python -m tapping_cell report rescued/bag.mcap --output rescued --json

With --video, a video of one run is written instead: its poses beside the images of the camera, in
real time.

    python -m tapping_cell report runs/2026-11-21_15-10-00_to_20_10_0 --video run.mp4
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tapping_cell.cli.errors import print_error
from tapping_cell.cli.progress import progress
from tapping_cell.durable_file import replace_text
from tapping_cell.report.bag import other_format
from tapping_cell.report.recorded import BagError
from tapping_cell.report.run import Run
from tapping_cell.report.run_comparison import Row, comparison_page, groups_of, row_of
from tapping_cell.report.run_folder import (
    BAG,
    PAGE,
    SUMMARY,
    RunError,
    read_run,
    summary,
    write_folder,
    write_illustrated_run,
)
from tapping_cell.report.run_reader import IllustratedRun, read_illustrated_run
from tapping_cell.report.tables import write_runs

COMPARISON = "comparison.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="run folder, or bag of a run"
    )
    parser.add_argument(
        "--output",
        type=Path,
        help="folder for the report of one run (default: the run folder, or the folder of the "
        "bag) or for the comparison of several runs (default: the folder that contains the "
        "first run)",
    )
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    parser.add_argument(
        "--video",
        type=Path,
        metavar="FILE",
        help="write a video of the run to this file, .mp4 or .gif, instead of the report",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if all runs were reported, 1 if some are unreadable, 2 if all are."""
    console = Console(stderr=arguments.json, soft_wrap=True)
    if arguments.video is not None:
        return _video(arguments.runs, arguments.video, console)
    reports: list[tuple[Run, Path]] = []
    known: dict[str, Path] = {}
    skipped = 0
    several = len(arguments.runs) > 1
    with progress("runs", len(arguments.runs)) as advance:
        for path in arguments.runs:
            advance()
            if several and no_run(path):
                skipped += 1
                console.print(
                    f"{path} is not a run: skipped", highlight=False, markup=False, soft_wrap=True
                )
                continue
            if path.is_file() and no_run(path):
                print_error(
                    other_format(path) or f"{path} is not a bag (.mcap); give the folder of the run"
                )
                continue
            inner = _runs_in(path)
            if inner:
                print_error(f"{path} is no run folder, but contains {len(inner)}; give {path}/*")
                continue
            try:
                report = write_report(path, None if several else arguments.output)
            except (BagError, RunError, OSError) as error:
                print_error(str(error))
                continue
            first = known.setdefault(_content(report[0]), path)
            if first is not path:
                skipped += 1
                console.print(
                    f"{path} is the same run as {first}: counted once",
                    highlight=False,
                    markup=False,
                    soft_wrap=True,
                )
                continue
            reports.append(report)
    if not reports:
        if skipped == len(arguments.runs):
            print_error("none of these is a run folder; give folders such as those in runs")
        return 2
    notes = [f"{run.name}: {run.note}" for run, _ in reports if run.note]
    for note in notes:
        console.print(f"incomplete: {note}", highlight=False, markup=False, soft_wrap=True)
    rows = [row_of(run) for run, _ in reports]
    written = reports[0][1] / PAGE
    if len(reports) > 1:
        written = compare(reports, arguments.output or reports[0][1].parent)
    if arguments.json:
        figures = {
            "runs": [_plain(row) for row in rows],
            "groups": [_plain(group) for group in groups_of(rows)],
            "page": str(written),
        }
        print(json.dumps(figures, indent=2, allow_nan=False))
    else:
        console.print(table_of(rows))
        console.print(f"see {written}", highlight=False, soft_wrap=True)
    return 0 if len(reports) + skipped == len(arguments.runs) else 1


def _video(runs: list[Path], file: Path, console: Console) -> int:
    """Write the video of a run. Return 0, or 2 if it cannot be made."""
    from tapping_cell.report.video import VideoError, write_video

    if len(runs) > 1:
        print_error(f"--video shows one run, and {len(runs)} are given; name one of them")
        return 2
    began = time.monotonic()
    try:
        path = runs[0] / BAG if (runs[0] / BAG).is_dir() else runs[0]
        is_folder = path == runs[0] and _is_run_folder(path)
        illustrated = (
            IllustratedRun(read_run(path), ())
            if is_folder
            else read_illustrated_run(path, (path.parent if path.name == BAG else path).name)
        )
        length = write_video(file, illustrated)
    except (BagError, RunError, VideoError, OSError) as error:
        print_error(str(error))
        return 2
    size = file.stat().st_size / 1e6
    words = f"{file}: {length:.1f} s, {size:.2f} MB, made in {time.monotonic() - began:.1f} s"
    console.print(words, highlight=False, markup=False, soft_wrap=True)
    return 0


def no_run(path: Path) -> bool:
    """Return whether a path is a file that is no bag, such as an earlier comparison, or a folder
    that contains neither a bag nor a summary, such as the folder of nodes' logs."""
    if path.is_file():
        return path.suffix != ".mcap"
    return _is_run_folder(path) and not any((path / name).exists() for name in (BAG, SUMMARY))


def _content(run: Run) -> str:
    """Return a text that is the same for copies of a run."""
    return json.dumps(summary(dataclasses.replace(run, name="")))


def _runs_in(path: Path) -> list[Path]:
    """Return the runs in a folder that is not a run folder itself."""
    if not path.is_dir() or not no_run(path):
        return []
    return [one for one in path.iterdir() if one.is_dir() and not no_run(one)]


def write_report(path: Path, output: Path | None) -> tuple[Run, Path]:
    """Rewrite the files of one run. Return the run and the folder of the files.

    Raises:
        BagError, RunError, OSError: the run is unreadable, or the files cannot be written.
    """
    is_folder = _is_run_folder(path)
    has_bag = is_folder and (path / BAG).is_dir()
    illustrated = None if has_bag or not is_folder else IllustratedRun(read_run(path), ())
    folder = _report_folder(path, output)
    if illustrated is None:
        return write_folder(folder, source=path / BAG if has_bag else path), folder
    write_illustrated_run(folder, illustrated)
    return illustrated.run, folder


def _is_run_folder(path: Path) -> bool:
    """Return whether a path is a run folder, not a bag."""
    return path.is_dir() and not any(path.glob("*.mcap"))


def _report_folder(path: Path, output: Path | None) -> Path:
    """Create and return the folder for the report of a run."""
    folder = output or (path if _is_run_folder(path) else path.parent)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def compare(reports: list[tuple[Run, Path]], folder: Path) -> Path:
    """Write the page that compares runs and the tables of runs and taps, replacing earlier ones."""
    folder.mkdir(parents=True, exist_ok=True)
    links = [os.path.relpath(own / PAGE, folder) for _, own in reports]
    page = folder / COMPARISON
    replace_text(page, comparison_page([run for run, _ in reports], links))
    write_runs(folder, reports)
    return page


def table_of(rows: list[Row]) -> Table:
    """Return a table of the runs."""
    table = Table(box=None, pad_edge=False, collapse_padding=True)
    # In a narrow terminal, the planner's name is wrapped: the other columns tell the runs apart.
    table.add_column("run", no_wrap=True)
    table.add_column("outcome", no_wrap=True)
    table.add_column("planner", overflow="fold")
    for name in ("taps", "left mm", "left deg", "time s"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            row.name,
            row.outcome,
            row.planner,
            str(row.taps),
            *(f"{v:.3f}" if math.isfinite(v) else "-" for v in (row.distance, row.rotation)),
            f"{row.time:.1f}",
        )
    return table


def _plain(row: object) -> dict[str, object]:
    """Convert results to JSON values; NaN, which JSON does not support, becomes None."""
    values = dataclasses.asdict(row)  # type: ignore[call-overload]
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }
