"""Benchmarks: how fast and how exact each room is, beside a peer measured in the same run.

python -m tapping_cell bench
python -m tapping_cell bench --section mechanics --json
python -m tapping_cell bench --section vision-robustness --count 10000
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys

# A section is a module with ``measure() -> dict`` (what --json prints) and
# ``lines(report) -> list[str]`` (the same for people).
SECTIONS = {
    "calibrate": "benchmarks.calibrate",
    "drivers": "benchmarks.drivers",
    "emergency_stop": "benchmarks.emergency_stop",
    "mechanics": "benchmarks.mechanics",
    "vision": "benchmarks.vision",
}

# Many experiments, scenes, frames or seconds: only when named. A module with a
# ``DEFAULT_COUNT`` takes how many as ``measure(count)``.
LONG_SECTIONS = {
    "calibration": "benchmarks.calibration",
    "demos": "benchmarks.demos",
    "disarm": "benchmarks.disarm",
    "node": "benchmarks.node",
    "outline": "benchmarks.outline",
    "vision-calibrated": "benchmarks.vision_calibrated",
    "vision-covariance": "benchmarks.vision_covariance",
    "vision-robustness": "benchmarks.vision_robustness",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which sections, and how to print them."""
    parser.add_argument(
        "--section",
        action="append",
        choices=sorted(SECTIONS | LONG_SECTIONS),
        help=f"what to measure, may be repeated (default: {', '.join(SECTIONS)})",
    )
    parser.add_argument(
        "--count",
        "--experiments",
        type=int,
        metavar="N",
        help="experiments of calibration, demos a truth, losses of disarm, scenes of outline, "
        "scenes or frames of vision*, seconds of node",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Measure the sections and print them; 0, or 2 for a count that cannot be."""
    if arguments.count is not None and arguments.count < 1:
        print(f"--count is {arguments.count}; it must be at least 1", file=sys.stderr)
        return 2
    reports = {}
    for name in arguments.section or SECTIONS:
        section = importlib.import_module((SECTIONS | LONG_SECTIONS)[name])
        if hasattr(section, "DEFAULT_COUNT"):
            reports[name] = section.measure(arguments.count or section.DEFAULT_COUNT)
        else:
            reports[name] = section.measure()
        if not arguments.json:
            print(f"{name}:")
            print("\n".join(f"  {line}" for line in section.lines(reports[name])), flush=True)
    if arguments.json:
        print(json.dumps(reports))
    return 0
