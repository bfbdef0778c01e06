"""Options of the verb evaluate for the scatter of a tap."""

from __future__ import annotations

import argparse
import math

from tapping_cell.planning.settings import Scatter


def add_scatter_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
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
        type=float,
        nargs=2,
        default=(0.0, 0.0),
        metavar=("MM", "DEG"),
        help="parts of the standard deviations that do not depend on the size of the tap: position "
        "in mm, rotation in degrees (default: 0 0)",
    )


def scatter_of(arguments: argparse.Namespace) -> Scatter:
    """Return the scatter of a tap given by the options.

    Raises:
        PlanningError: a value is out of range.
    """
    share, turn, direction = arguments.scatter
    place, angle = arguments.scatter_floor
    return Scatter(
        share / 100.0, turn / 100.0, math.radians(direction), 1e-3 * place, math.radians(angle)
    )
