"""Run sections of the benchmarks from the root of the source tree.

python -m benchmarks
python -m benchmarks --section mechanics --json
python -m benchmarks --section vision-robustness --count 10000
python -m benchmarks --section vision --count 60 --write
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import re
import sys
from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path
from types import ModuleType

# A section is a module with ``measure() -> dict`` (printed by --json) and ``lines(report) ->
# list[str]`` (the report as text). If a module defines ``DEFAULT_COUNT``, its ``measure(count)``
# takes a number of goals, images, seconds or other items, depending on the module. If it defines
# ``FOLDER``, its ``measure(folder)`` takes a folder of photographs. A module may
# define ``partial_reports(count)`` in place of ``measure``. ``partial_reports`` yields a report
# after each part, so that --write stores the completed parts.
SECTIONS = ("calibrate", "drivers", "emergency_stop", "mechanics", "vision")

# Long sections, which run only if they are named.
LONG_SECTIONS = (
    "arrangements",
    "calibration",
    "cycle",
    "fixed-tappers",
    "idle",
    "learnt-intervals",
    "lost-nodes",
    "photographs",
    "precision",
    "simulated-time",
    "two-computers",
    "unknown-objects",
    "unknown-worlds",
    "vision-arm",
    "vision-calibrated",
    "vision-covariance",
    "vision-objects",
    "vision-robustness",
    "world",
)


RESULTS = Path(__file__).with_name("RESULTS.md")
_HEAD = """# Benchmark results

`python -m benchmarks --section NAME --write` measures a section and replaces its results on this
page. Other software that is listed for comparison was measured in the same run. Times depend on the
machine and its load; errors do not.
"""


def make_parser() -> argparse.ArgumentParser:
    """Create the parser of the command line."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False,
        prog="python -m benchmarks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--section",
        action="append",
        choices=sorted(SECTIONS + LONG_SECTIONS),
        help=f"section to run; may be given several times (default: {', '.join(SECTIONS)})",
    )
    parser.add_argument(
        "--count",
        "--experiments",
        type=int,
        metavar="N",
        help="size of a section: its number of goals, trials, scenes, frames, experiments or "
        "seconds (default: set by each section)",
    )
    parser.add_argument(
        "--folder", type=Path, help="photographs of boards (section photographs, which needs it)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--write", action="store_true", help=f"write the results to benchmarks/{RESULTS.name}"
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sections and print their reports; return exit code 0, or 2 for an invalid count."""
    chosen = make_parser().parse_args(arguments)
    if chosen.count is not None and chosen.count < 1:
        print(f"--count is {chosen.count}; it must be at least 1", file=sys.stderr)
        return 2
    if "photographs" in (chosen.section or ()) and chosen.folder is None:
        print("--section photographs needs --folder", file=sys.stderr)
        return 2
    reports = {}
    for name in chosen.section or SECTIONS:
        section = importlib.import_module(f"benchmarks.{name.replace('-', '_')}")
        text = ""
        for reports[name] in _reports(section, chosen.count, chosen.folder):
            text = "\n".join(f"    {line}" for line in section.lines(reports[name]))
            if chosen.write:
                command = f"python -m benchmarks --section {name}"
                command += f" --count {chosen.count}" if chosen.count else ""
                write_section(RESULTS, name, text, command)
        if not chosen.json:
            print(f"{name}:\n{text}", flush=True)
    if chosen.json:
        print(json.dumps(reports))
    return 0


def _reports(section: ModuleType, count: int | None, folder: Path | None) -> Iterator[object]:
    """Measure a section and yield one or more reports; the last report covers all parts."""
    if hasattr(section, "partial_reports"):
        yield from section.partial_reports(count or section.DEFAULT_COUNT)
    elif hasattr(section, "FOLDER"):
        yield section.measure(folder)
    elif hasattr(section, "DEFAULT_COUNT"):
        yield section.measure(count or section.DEFAULT_COUNT)
    else:
        yield section.measure()


def write_section(file: Path, name: str, text: str, command: str) -> None:
    """Replace one section in the page of results and keep the other sections. ``command``: command
    that has measured the section."""
    before = file.read_text(encoding="utf-8") if file.exists() else ""
    sections = dict(re.findall(r"^## (\S+)\n(.*?)(?=^## |\Z)", before, re.MULTILINE | re.DOTALL))
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    sections[name] = (
        f"\n`{command}`, {date.today()}, {machine}, load {os.getloadavg()[0]:.1f}:\n\n{text}\n\n"
    )
    body = "".join(f"\n## {each}\n{sections[each].rstrip()}\n" for each in sorted(sections))
    file.write_text(_HEAD + body, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
