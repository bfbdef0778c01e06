"""Compute the sensitivity of a tap's result to errors of the striker's pose (paper, section 5.1).

Prints the 3 x 3 Jacobian of a tap of the paper's disk in mm and degrees, the norm of the Jacobian,
and the product of the Jacobian and an error of the striker's pose. Also prints the fraction of the
reachable taps whose Jacobian has a norm below one. The columns of the Jacobian belong to errors of
the striker: displacements of its ball along i (the contact normal, away from the object) and j (the
tangent), and the rotation beta of its axis. The rows belong to the result: displacements of the
object along and across the direction of travel, and its rotation, clockwise as in the paper. The
paper assumes that the direction of travel rotates with the striker. For comparison, a second
Jacobian is printed, in which the direction of travel is computed by the impact model.

    python -m tapping_cell sensitivity --distance 10 --rotation 3
    python -m tapping_cell sensitivity --figures docs/images
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapping_cell.cli.errors import print_error
from tapping_cell.mechanics import MechanicsError, Tap
from tapping_cell.mechanics.sensitivity import (
    PAPER_STRIKER_ERROR,
    norm,
    paper_tap,
    sensitivity,
)

_SWEEP_DISTANCES = 60
_SWEEP_ROTATIONS = 41


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the tap, the striker's error and the sweep."""
    parser.add_argument(
        "--distance",
        type=float,
        default=10.0,
        help="distance by which the tap moves the object, in mm (default: 10)",
    )
    parser.add_argument(
        "--rotation",
        type=float,
        default=3.0,
        help="angle by which the tap rotates the object, in degrees (default: 3)",
    )
    parser.add_argument(
        "--error",
        type=float,
        nargs=3,
        default=PAPER_STRIKER_ERROR,
        metavar=("I", "J", "BETA"),
        help="error of the striker's pose along i and j in mm, and of its angle beta in degrees "
        "(default: 7.5 7.5 5, as in the paper)",
    )
    parser.add_argument(
        "--farthest",
        type=float,
        default=50.0,
        help="largest distance in the sweep in mm (default: 50)",
    )
    parser.add_argument(
        "--figures",
        type=Path,
        metavar="DIR",
        help="folder for figures of the reachable cone and of the velocities during a slide",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Print the Jacobian and the sweep. Return 2 for an infeasible tap."""
    tap = paper_tap()
    asked = paper_tap(mirrored=True) if arguments.rotation < 0 else tap
    displacement = [arguments.distance / 1e3, 0.0, math.radians(arguments.rotation)]
    try:
        both = sensitivity(asked, displacement)
        report = {
            "distance_mm": arguments.distance,
            "rotation_deg": arguments.rotation,
            "striker_error": list(arguments.error),
            **_figures(both.printed, arguments.error),
            "physical": _figures(both.physical, arguments.error),
            "sweep": sweep_norms(tap, arguments.farthest / 1e3),
        }
    except MechanicsError as problem:
        print_error(str(problem))
        return 2
    if arguments.figures:
        from tapping_cell.report.mechanics_figures import write_figures

        for file in write_figures(tap, arguments.figures):
            print(f"wrote {file}", file=sys.stderr)
    if arguments.json:
        print(json.dumps(report))
    else:
        _print(report)
    return 0


def _figures(jacobian: NDArray[np.float64], error: list[float]) -> dict[str, object]:
    return {
        "jacobian": jacobian.tolist(),
        "product": (jacobian @ np.asarray(error)).tolist(),
        "norm": float(norm(jacobian)),
    }


def sweep_norms(tap: Tap, farthest: float) -> dict[str, Any]:
    """Return statistics of the Jacobian's norm over the reachable taps of up to this distance, m.
    Their rotations range from zero to the edge of the friction cone."""
    nearest = tap.smallest_distance
    distances, shares = np.meshgrid(
        np.linspace(nearest, max(farthest, nearest), _SWEEP_DISTANCES),
        np.linspace(0.0, 0.99, _SWEEP_ROTATIONS),
        indexing="ij",
    )
    taps = np.stack(
        [distances, np.zeros_like(distances), shares * tap.cone_slope * distances], axis=-1
    )
    both = sensitivity(tap, taps)
    printed, physical = norm(both.printed), norm(both.physical)
    below = (printed < 1).all(axis=1)
    whole = distances[below.cumprod().astype(bool), 0]
    return {
        "distance_mm": [1e3 * nearest, 1e3 * max(farthest, nearest)],
        "cone_deg_per_mm": math.degrees(tap.cone_slope) / 1e3,
        "taps": int(printed.size),
        "share_below_one": float((printed < 1).mean()),
        "share_below_one_physical": float((physical < 1).mean()),
        "all_below_one_up_to_mm": float(1e3 * whole[-1]) if whole.size else 0.0,
    }


def _print(report: dict[str, Any]) -> None:
    print(
        f"Jacobian of a tap of {report['distance_mm']:g} mm and {report['rotation_deg']:g} degrees "
        "(rows x mm, y mm, theta degrees; columns i mm, j mm, beta degrees)"
    )
    for title, figures in (
        ("assuming that the direction of travel rotates with the striker, as in the paper", report),
        ("with the direction of travel from the impact model", report["physical"]),
    ):
        print(f"\n{title}:")
        for row in figures["jacobian"]:
            print("  " + "".join(f"{value:10.4f}" for value in row))
        error = " ".join(f"{e:g}" for e in report["striker_error"])
        product = " ".join(f"{p:.2f}" for p in figures["product"])
        print(f"  times [{error}]: [{product}]    norm of the Jacobian {figures['norm']:.3f}")
    sweep = report["sweep"]
    print(
        f"\nThe Jacobian's norm is below one for {100 * sweep['share_below_one']:.0f} % of "
        f"{sweep['taps']} taps of {sweep['distance_mm'][0]:g} to "
        f"{sweep['distance_mm'][1]:g} mm inside the cone of "
        f"{sweep['cone_deg_per_mm']:.3f} degrees/mm\n  "
        f"({100 * sweep['share_below_one_physical']:.0f} % if the impact model determines the "
        f"direction of travel), and for every tap of at most "
        f"{sweep['all_below_one_up_to_mm']:.0f} mm."
    )
