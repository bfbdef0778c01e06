"""Options of the calibrations that can record their own data with a running cell."""

from __future__ import annotations

import argparse

from tapping_cell.calibration.csv_table import RecordError


def add_recording_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --record, --resume and --namespace."""
    parser.add_argument(
        "--record",
        action="store_true",
        dest="record_first",
        help="first record the data with the running cell (started with the verb `up`)",
    )
    parser.add_argument(
        "--resume", action="store_true", help="continue an existing record (only with --record)"
    )
    parser.add_argument(
        "--namespace",
        default="",
        help="namespace of the running cell's nodes (only with --record; default: none)",
    )


def check_count(name: str, count: int, least: int) -> None:
    """Reject a number of measurements that is insufficient for a calibration.

    Raises:
        RecordError: the number is out of range. The message names the option, value and range.
    """
    if not least <= count <= 1000:
        raise RecordError(f"{name} is {count}; it must be {least} to 1000")
