"""Let the drivers make taps with emulated controllers and boards, over faulty serial lines.

Bytes are lost, delayed, doubled, changed, split or merged, ports disappear, and boards restart. The
drivers' reports are compared with what the devices truly did.

    python -m lab drivers --taps 10000 --seed 1
    python -m lab drivers --taps 500 --dialect marlin --json
    python -m lab drivers --every-byte    # a restart and an unplugged cable at every byte of a tap
    python -m lab drivers --controllers   # stops, alarms and wrong settings of every controller

The exit code is 0 only if nothing was fired twice or unsafely, nothing hung and every report was
true.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import as_completed
from functools import partial

from lab.drivers.controller_trials import FAULTS, run_faults
from lab.drivers.driver_trials import Dialect, Tally, bytes_of_a_tap, run_sweep, run_taps
from lab.worker_processes import worker_processes
from tapping_cell.cli import argument_types
from tapping_cell.cli.errors import print_error
from tapping_cell.simulation.fault_layer import FaultKind

CHUNK = 100
"""Number of taps of one cell; it makes the results independent of the number of processes."""
TRIALS = 10
"""Number of trials of each kind of controller fault."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--taps", type=int, default=1000, metavar="N", help="number of taps")
    parser.add_argument(
        "--dialect",
        choices=[dialect.value for dialect in Dialect],
        help="controller of the arm (default: all, one after the other)",
    )
    argument_types.add_seed(parser, 0, "random seed of the faults (default: 0)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="number of processes")
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--every-byte", action="store_true", help="one fault at every byte of a tap's messages"
    )
    instead.add_argument(
        "--controllers", action="store_true", help="faults of the controllers instead of taps"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run the trials and print the results."""
    if arguments.taps < 1 or arguments.jobs < 1:
        print_error("--taps and --jobs must be at least 1")
        return 2
    if arguments.controllers:
        return _controllers(arguments.seed)
    began, total = time.monotonic(), Tally()
    dialects = [Dialect(arguments.dialect)] if arguments.dialect else list(Dialect)
    chunks = list(_chunks(dialects, arguments))
    with worker_processes(min(arguments.jobs, len(chunks))) as pool:
        for future in as_completed([pool.submit(chunk) for chunk in chunks]):
            total.add(future.result())
    result: dict[str, object] = {
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
        "board_resets_asked": total.board_resets_asked,
        "faults": total.faults_struck,
        "by_fault": {kind: dict(counts) for kind, counts in sorted(total.by_fault.items())},
        "refused_because": dict(total.reasons.most_common()),
        "cell_hours": round(total.cell_seconds / 3600, 3),
        "wall_time": round(time.monotonic() - began, 3),
        "notes": total.notes,
    }
    if arguments.json:
        print(json.dumps(result, indent=2))
    else:
        print("\n".join(f"{name.replace('_', ' '):<18} {value}" for name, value in result.items()))
    return 0 if total.clean else 1


def _chunks(dialects: list[Dialect], arguments: argparse.Namespace) -> list[Callable[[], Tally]]:
    """Divide the run into parts, each with its own seed or its own bytes."""
    if arguments.every_byte:
        return [
            partial(run_sweep, dialect, kind, *place, range(first, min(first + CHUNK, count)))
            for dialect in dialects
            for place, count in bytes_of_a_tap(dialect).items()
            for kind in (FaultKind.RESET, FaultKind.HANG_UP)
            for first in range(0, count, CHUNK)
        ]
    return [
        partial(
            run_taps,
            dialects[number % len(dialects)],
            min(CHUNK, arguments.taps - first),
            arguments.seed * 1_000_000 + number,
        )
        for number, first in enumerate(range(0, arguments.taps, CHUNK))
    ]


def _controllers(seed: int) -> int:
    """Try every kind of controller fault on every controller that can have it."""
    wrong = 0
    for kind, fault in FAULTS.items():
        for name in fault.controllers:
            outcome = run_faults(name, kind, TRIALS, seed)
            wrong += len(outcome.wrong)
            print(f"{kind:<26} {name:<14} {outcome.tried - len(outcome.wrong)} of {outcome.tried}")
            print("".join(f"  {sentence}\n" for sentence in outcome.wrong), end="")
    return 1 if wrong else 0
