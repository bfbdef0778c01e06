"""Measure sections of the benchmarks, from the root of the source tree.

python -m benchmarks
python -m benchmarks --section mechanics --json
python -m benchmarks --section vision-robustness --count 10000
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections.abc import Sequence

# A section is a module with ``measure() -> dict`` (what --json prints) and
# ``lines(report) -> list[str]`` (the same for people). A module with a ``DEFAULT_COUNT`` takes how
# many experiments, scenes, frames or seconds as ``measure(count)``.
SECTIONS = ("calibrate", "drivers", "emergency_stop", "mechanics", "vision")

# Long: only when named.
LONG_SECTIONS = (
    "calibration",
    "demos",
    "disarm",
    "idle",
    "node",
    "outline",
    "vision-calibrated",
    "vision-covariance",
    "vision-robustness",
)


def make_parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--section",
        action="append",
        choices=sorted(SECTIONS + LONG_SECTIONS),
        help=f"what to measure, may be repeated (default: {', '.join(SECTIONS)})",
    )
    parser.add_argument(
        "--count",
        "--experiments",
        type=int,
        metavar="N",
        help="experiments of calibration, demos a truth, losses of disarm, scenes of outline, "
        "scenes or frames of vision*, seconds of node and idle",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the sections and print them; 0, or 2 for an invalid count."""
    chosen = make_parser().parse_args(arguments)
    if chosen.count is not None and chosen.count < 1:
        print(f"--count is {chosen.count}; it must be at least 1", file=sys.stderr)
        return 2
    reports = {}
    for name in chosen.section or SECTIONS:
        section = importlib.import_module(f"benchmarks.{name.replace('-', '_')}")
        if hasattr(section, "DEFAULT_COUNT"):
            reports[name] = section.measure(chosen.count or section.DEFAULT_COUNT)
        else:
            reports[name] = section.measure()
        if not chosen.json:
            print(f"{name}:")
            print("\n".join(f"  {line}" for line in section.lines(reports[name])), flush=True)
    if chosen.json:
        print(json.dumps(reports))
    return 0


if __name__ == "__main__":
    sys.exit(main())
