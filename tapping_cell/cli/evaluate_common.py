"""Options and inputs that the evaluations of an arm and of fixed tappers share."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

from tapping_cell.cli.argument_types import MM_AND_DEGREES
from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.conflicts import conflicts
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.planning import CameraNoise
from tapping_cell.planning.settings import Scatter


def add_scatter_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options for the scatter of a tap."""
    parser.add_argument(
        "--scatter",
        type=float,
        nargs=3,
        default=(5.0, 15.0, 1.0),
        metavar=("D", "R", "A"),
        help="standard deviations of the result of a tap: distance in percent, rotation in "
        "percent, direction in degrees (default: 5 15 1)",
    )
    parser.add_argument(
        "--scatter-floor",
        **MM_AND_DEGREES,
        default=(0.0, 0.0),
        help="parts of the standard deviations that do not depend on the size of the tap: position "
        "in mm, rotation in degrees (default: 0 0)",
    )


def scatter_of(arguments: argparse.Namespace) -> Scatter:
    """Return the scatter of a tap given by the options.

    Raises:
        PlanningError: a value is out of range.
    """
    share, turn, direction = arguments.scatter
    return Scatter(
        share / 100.0, turn / 100.0, math.radians(direction), *si_pair(arguments.scatter_floor)
    )


def camera_of(arguments: argparse.Namespace) -> CameraNoise:
    """Return the noise of a measured pose given by the options."""
    return CameraNoise(*si_pair(arguments.camera_noise))


def share_text(part: int, whole: int) -> str:
    """Format a share with the numbers that it is a share of, such as ``4 of 20 (20.00 %)``."""
    percent = f" ({100 * part / whole:.2f} %)" if whole else ""
    return f"{part} of {whole}{percent}"


def refuse_faulty(arguments: argparse.Namespace, cell: Cell) -> None:
    """Raise ConfigurationError if the options name a cell file with contradictions, as
    ``check-config`` reports them. With ``--force``, print them as a warning."""
    if arguments.cell is None:
        return
    errors, _ = conflicts(cell)
    if errors and not arguments.force:
        raise ConfigurationError(
            f"{'; '.join(errors)}. Correct this, or evaluate the cell nevertheless with --force"
        )
    for error in errors:
        print(f"warning: check-config refuses this cell: {error}", file=sys.stderr)


def si_pair(pair: tuple[float, float]) -> tuple[float, float]:
    """Convert a length in mm and an angle in degrees to m and rad."""
    return 1e-3 * pair[0], math.radians(pair[1])


def inputs_of(arguments: argparse.Namespace, *left_out: str) -> dict[str, Any]:
    """Return the options that determine the results, for JSON output. ``left_out``: further options
    to leave out."""
    return {
        name: str(value) if isinstance(value, Path) else value
        for name, value in sorted(vars(arguments).items())
        if name not in {"json", "force", "report", "processes", *left_out}
    }
