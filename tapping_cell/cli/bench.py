"""Benchmarks: how fast and how exact each room is, beside a peer measured in the same run.

python -m tapping_cell bench
python -m tapping_cell bench --section mechanics --json
"""

from __future__ import annotations

import argparse
import importlib
import json

# A section is a module with ``measure() -> dict`` (what --json prints) and
# ``lines(report) -> list[str]`` (the same for people).
SECTIONS = {
    "drivers": "tapping_cell.cli.benchmarks.drivers",
    "emergency_stop": "tapping_cell.cli.benchmarks.emergency_stop",
    "mechanics": "tapping_cell.cli.benchmarks.mechanics",
    "vision": "tapping_cell.cli.benchmarks.vision",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which sections, and how to print them."""
    parser.add_argument(
        "--section",
        action="append",
        choices=sorted(SECTIONS),
        help="a room to measure, may be repeated (all of them)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Measure the sections and print them; 0."""
    reports = {}
    for name in arguments.section or SECTIONS:
        section = importlib.import_module(SECTIONS[name])
        reports[name] = section.measure()
        if not arguments.json:
            print(f"{name}:")
            print("\n".join(f"  {line}" for line in section.lines(reports[name])), flush=True)
    if arguments.json:
        print(json.dumps(reports))
    return 0
