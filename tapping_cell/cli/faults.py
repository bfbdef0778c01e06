"""Taps over bad serial lines: do the drivers ever act unsafely, hang or say what is not so?

Runs the real drivers of the arm and the tapper against the emulated devices in their own time, with
seeded faults on the lines (bytes lost, late, doubled, flipped, split, merged; stalls; ports that
vanish and return; boards that restart), and holds what the drivers say against what the devices
did.

    python -m tapping_cell faults --taps 10000 --seed 1
    python -m tapping_cell faults --taps 500 --dialect marlin --json
    python -m tapping_cell faults --every-byte

Exit status 0 only if nothing was fired twice or unsafely, nothing hung and every report was true.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial

from tapping_cell.cli.fault_trials import (
    Dialect,
    Tally,
    bytes_of_a_tap,
    run_sweep,
    run_taps,
)
from tapping_cell.simulation.fault_layer import FaultKind

CHUNK = 100
"""Taps of one cell from its start: the unit that a process works on; results do not depend on how
many processes there are."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument("--taps", type=int, default=1000, metavar="N", help="default: %(default)s")
    parser.add_argument(
        "--dialect",
        choices=[dialect.value for dialect in Dialect],
        help="the arm's controller; both by turns when left out",
    )
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, help="processes; default: the cores"
    )
    parser.add_argument(
        "--every-byte",
        action="store_true",
        help="instead of random faults, a restart and an unplug at every byte of one tap",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run the taps and report."""
    if arguments.taps < 1 or arguments.jobs < 1 or arguments.seed < 0:
        print("--taps and --jobs must be at least 1, --seed at least 0", file=sys.stderr)
        return 2
    dialects = [Dialect(arguments.dialect)] if arguments.dialect else list(Dialect)
    began = time.monotonic()
    total = Tally()
    if arguments.every_byte:
        chunks = _sweep(dialects)
    else:
        chunks = _random(dialects, arguments.taps, arguments.seed)
    with ProcessPoolExecutor(min(arguments.jobs, len(chunks))) as pool:
        for future in as_completed([pool.submit(chunk) for chunk in chunks]):
            total.add(future.result())
            if not arguments.json and sys.stderr.isatty():
                print(f"\r{total.taps} taps", end="", file=sys.stderr)
    result = {
        "taps": total.taps,
        "dialects": [dialect.value for dialect in dialects],
        "seed": arguments.seed,
        "fired": total.fired,
        "not_fired": total.not_fired,
        "unknown": total.unknown,
        "double_fires": total.double_fires,
        "unsafe_fires": total.unsafe_fires,
        "hangs": total.hangs,
        "false_reports": total.false_reports,
        "faults": total.faults_struck,
        "by_fault": {kind: dict(counts) for kind, counts in sorted(total.by_fault.items())},
        "refused_because": dict(total.reasons.most_common()),
        "cell_hours": round(total.cell_seconds / 3600, 3),
        "wall_time": round(time.monotonic() - began, 3),
        "notes": total.notes,
    }
    print(json.dumps(result, indent=2) if arguments.json else _in_words(result))
    return 0 if total.clean else 1


def _random(dialects: list[Dialect], taps: int, seed: int) -> list[Callable[[], Tally]]:
    """The run in pieces, each with a seed of its own."""
    return [
        partial(
            run_taps,
            dialects[number % len(dialects)],
            min(CHUNK, taps - first),
            seed * 1_000_000 + number,
        )
        for number, first in enumerate(range(0, taps, CHUNK))
    ]


def _sweep(dialects: list[Dialect]) -> list[Callable[[], Tally]]:
    """A restart and an unplug at every byte of one tap, both lines, both ways."""
    return [
        partial(run_sweep, dialect, kind, *place, range(first, min(first + CHUNK, count)))
        for dialect in dialects
        for place, count in bytes_of_a_tap(dialect).items()
        for kind in (FaultKind.RESET, FaultKind.HANG_UP)
        for first in range(0, count, CHUNK)
    ]


def _in_words(result: dict[str, object]) -> str:
    lines = [
        f"{name.replace('_', ' '):<16} {result[name]}" for name in result if name != "by_fault"
    ]
    lines.append("outcomes of taps in which a fault struck:")
    by_fault = result["by_fault"]
    assert isinstance(by_fault, dict)
    for kind, counts in by_fault.items():
        parts = ", ".join(f"{count} {outcome}" for outcome, count in sorted(counts.items()))
        lines.append(f"  {kind:<12} {parts}")
    return "\n".join(lines)
