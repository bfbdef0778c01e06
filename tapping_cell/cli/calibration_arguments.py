"""Options of verbs that write a calibrated file, and that can record their own data with a running
cell."""

from __future__ import annotations

import argparse
from pathlib import Path

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.keep import Output, refuse_existing
from tapping_cell.cli import argument_types


def add_output_arguments(
    parser: argparse.ArgumentParser, default: str | None = None, required: bool = True
) -> None:
    """Declare --json, --output, --force and --accept-worse. If --output is left out, ``default`` is
    used. If there is no default and ``required`` is True, --output must be given."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--output",
        type=Path,
        required=required and default is None,
        default=default and Path(default),
        metavar="FILE",
        help="file to write" + (f" (default: {default})" if default else ""),
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument(
        "--accept-worse",
        action="store_true",
        help="replace the file even if the new result has a larger residual or uncertainty than "
        "the result in the file (only with --force)",
    )


def output_of(
    arguments: argparse.Namespace, record_at: tuple[str, ...] = ("calibration",)
) -> Output:
    """Return the output file and whether it may be overwritten. ``record_at`` is the key path of
    the calibration record in that file.

    Raises:
        KeptFile: the file exists and may not be overwritten, or its folder is missing.
    """
    path = arguments.output.expanduser()
    output = Output(path, arguments.force, arguments.accept_worse, record_at)
    refuse_existing(output)
    return output


def add_recording_arguments(
    parser: argparse.ArgumentParser, number: str, default: int, text: str
) -> None:
    """Declare --record, --resume and --namespace. Also declare the option ``number`` for the number
    of measurements, with the help text ``text``."""
    parser.add_argument(
        "--record",
        action="store_true",
        dest="record_first",
        help="first record the data with the running cell (started with the verb `up`)",
    )
    parser.add_argument(
        "--resume", action="store_true", help="continue an existing record (only with --record)"
    )
    argument_types.add_namespace(
        parser, "namespace of the running cell's nodes (only with --record; default: none)"
    )
    parser.add_argument(
        number,
        type=int,
        default=default,
        metavar="N",
        help=f"{text} (only with --record; default: {default})",
    )


def check_count(name: str, count: int, least: int) -> None:
    """Reject a number of measurements that is insufficient for a calibration.

    Raises:
        RecordError: the number is out of range. The message names the option, value and range.
    """
    if not least <= count <= 1000:
        raise RecordError(f"{name} is {count}; it must be {least} to 1000")
