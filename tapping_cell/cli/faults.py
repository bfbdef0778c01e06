"""Test the cell under injected faults for unsafe actions, hangs and false reports.

With --goals, the state machines of the nodes, their drivers and the emulated devices bring an
object to random goals in simulated time, while processes, messages, clocks, serial lines, boards,
the camera and people fail at random. Invariants are checked after every event. With --taps (the
default), only the drivers and the emulated devices make taps, over faulty serial lines: bytes are
lost, delayed, doubled, changed, split or merged, transmission stalls, ports disappear and return,
and boards restart. The drivers' reports are compared with the true actions of the devices.

    python -m tapping_cell faults --goals 1000 --seed 1   # the whole cell in simulated time
    python -m tapping_cell faults --goals 500 --only 'freeze, freeze at a shot'
    python -m tapping_cell faults --goals 1000 --fixed-tappers   # the positioning cell
    python -m tapping_cell faults --goals 500 --set-up    # every cell in set-up mode
    python -m tapping_cell faults --replay 1000003        # repeat one run and print its trace
    python -m tapping_cell faults --mutants               # check that each missing guard is found
    python -m tapping_cell faults --taps 10000 --seed 1   # drivers and boards only
    python -m tapping_cell faults --taps 500 --dialect marlin --json
    python -m tapping_cell faults --every-byte
    python -m tapping_cell faults --pty --taps 20         # real terminals, in real time
    python -m tapping_cell faults --soak 2                # hours of taps, to detect memory growth
    python -m tapping_cell faults --crashes               # kill the nodes at every phase of a tap

The exit code is 0 only if nothing was fired twice or unsafely, nothing hung and every report was
true.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import as_completed
from dataclasses import asdict
from functools import partial
from pathlib import Path

from tapping_cell.cli import argument_types, goal_faults
from tapping_cell.cli.driver_soak import soak
from tapping_cell.cli.errors import print_error
from tapping_cell.cli.fault_terminals import terminal_cell
from tapping_cell.cli.fault_trials import (
    Dialect,
    Tally,
    bytes_of_a_tap,
    run_sweep,
    run_taps,
)
from tapping_cell.cli.graph import SIMULATED, own_domain
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.simulation.fault_layer import FaultKind
from tapping_cell.verification.campaign import GOALS_A_RUN
from tapping_cell.verification.faults import ALL, Mix
from tapping_cell.verification.worker_processes import worker_processes

CHUNK = 100
"""Number of taps that a process runs before it creates a new cell. The fixed number makes the
results independent of the number of processes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument(
        "--taps",
        type=int,
        metavar="N",
        help="number of taps (default: 1000; with --pty: 20, about 5 s each)",
    )
    parser.add_argument(
        "--dialect",
        choices=[dialect.value for dialect in Dialect],
        help="controller of the arm (default: all, one after the other)",
    )
    argument_types.add_seed(parser, 0, "random seed of the faults (default: 0)")
    parser.add_argument(
        "--jobs",
        type=int,
        default=os.cpu_count() or 1,
        help="number of processes (default: the number of cores)",
    )
    parser.add_argument(
        "--pty",
        action="store_true",
        help="use pseudo-terminals in real time, with one process per dialect",
    )
    parser.add_argument(
        "--goals",
        type=int,
        metavar="N",
        help="number of goals to simulate with random faults in the whole cell (logic, drivers, "
        "boards, camera and people); with --mutants, the maximum number of goals for each mutant "
        "(default: 1000 with --mutants, 10 with --replay)",
    )
    parser.add_argument(
        "--only",
        metavar="KINDS",
        default="",
        help="kinds of faults to use, separated by commas, such as 'freeze, kill' (only with "
        "--goals or --replay; default: all)",
    )
    parser.add_argument(
        "--mean-faults",
        type=float,
        metavar="N",
        default=ALL.mean,
        help="mean number of faults per goal, from 1 to 50 (only with --goals or --replay; "
        f"default: {ALL.mean:g})",
    )
    parser.add_argument(
        "--fixed-tappers",
        action="store_true",
        help="simulate the positioning cell with fixed tappers, on one board or two, instead of "
        "the cell with an arm (only with --goals or --replay; --mutants covers all cells)",
    )
    parser.add_argument(
        "--several-objects",
        action="store_true",
        help="simulate only cells with two or three objects, instead of in one of ten runs (only "
        "with --goals or --replay)",
    )
    parser.add_argument(
        "--set-up",
        action="store_true",
        help="run every cell in set-up mode, with a person who holds the enabling device; otherwise"
        " the seed chooses one run in ten (only with --goals or --replay)",
    )
    parser.add_argument(
        "--ask",
        action="store_true",
        help="let a person confirm every tap; otherwise the seed chooses one run in ten (only with "
        "--goals or --replay)",
    )
    parser.add_argument(
        "--mutant",
        action="append",
        help="defect to test; may be given several times (only with --mutants; default: all)",
    )
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--replay",
        type=int,
        metavar="SEED",
        help="seed of a --goals run to repeat; its trace is printed",
    )
    instead.add_argument(
        "--mutants",
        action="store_true",
        help="insert single defects into the logic, one at a time; each must be detected",
    )
    instead.add_argument(
        "--every-byte",
        action="store_true",
        help="restart or disconnect a board at every byte of a tap's messages, instead of random "
        "faults",
    )
    instead.add_argument(
        "--soak",
        type=float,
        metavar="HOURS",
        help="run taps for this many hours of device time, and report memory, threads and file "
        "descriptors",
    )
    instead.add_argument(
        "--crashes",
        action="store_true",
        help="kill every node of a running simulated cell in every phase of a tap",
    )
    parser.add_argument(
        "--node",
        action="append",
        help="node to kill; may be given several times (only with --crashes; default: all)",
    )
    parser.add_argument(
        "--phase",
        action="append",
        help="phase in which to kill; may be given several times (only with --crashes; default: "
        "all)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run the trials and print the results."""
    if refusal := _refusal(arguments):
        print_error(refusal)
        return 2
    end_on_signals()
    if arguments.replay is not None:
        return goal_faults.replay(arguments.replay, arguments.goals or GOALS_A_RUN, _mix(arguments))
    if arguments.mutants:
        return goal_faults.run_mutants(
            arguments.goals or 1000,
            arguments.seed,
            arguments.jobs,
            arguments.mutant or (),
            arguments.json,
        )
    if arguments.goals is not None:
        return goal_faults.run_goals(
            arguments.goals,
            arguments.seed,
            arguments.jobs,
            arguments.json,
            _mix(arguments),
        )
    if arguments.crashes:
        return _crashes(arguments)
    dialects = [Dialect(arguments.dialect)] if arguments.dialect else list(Dialect)
    if arguments.soak is not None:
        return _soak(dialects, arguments)
    return _taps(dialects, arguments)


def _refusal(arguments: argparse.Namespace) -> str:
    """Return why the options are refused; empty if they are valid."""
    counts = (arguments.taps, arguments.goals, arguments.jobs)
    if any(count is not None and count < 1 for count in counts) or arguments.seed < 0:
        return "--taps, --goals and --jobs must be at least 1, --seed at least 0"
    if not 1.0 <= arguments.mean_faults <= 50.0:
        return "--mean-faults must be from 1 to 50"
    excluded = (
        ("--fixed-tappers", "--several-objects"),
        ("--fixed-tappers", "--ask"),
        ("--several-objects", "--set-up"),
        ("--several-objects", "--ask"),
    )
    chosen = {
        "--fixed-tappers": arguments.fixed_tappers,
        "--several-objects": arguments.several_objects,
        "--set-up": arguments.set_up,
        "--ask": arguments.ask,
    }
    for pair in excluded:
        if all(chosen[name] for name in pair):
            return f"{' and '.join(pair)} exclude each other; give one of them"
    ways = {
        "--taps": arguments.taps is not None,
        "--goals": arguments.goals is not None,
        "--crashes": arguments.crashes,
        "--soak": arguments.soak is not None,
    }
    given = [name for name, is_given in ways.items() if is_given]
    if len(given) > 1:
        return f"{' and '.join(given)} exclude each other; give one of them"
    if arguments.soak is not None and not 0 < arguments.soak <= 1000:
        return "--soak must be above 0 and at most 1000 hours"
    return ""


def _taps(dialects: list[Dialect], arguments: argparse.Namespace) -> int:
    """Run taps over faulty lines in several processes."""
    began = time.monotonic()
    total = Tally()
    chunks = _chunks(dialects, arguments)
    with worker_processes(min(arguments.jobs, len(chunks))) as pool:
        for future in as_completed([pool.submit(chunk) for chunk in chunks]):
            total.add(future.result())
            if not arguments.json and sys.stderr.isatty():
                print(f"\r{total.taps} taps", end="", file=sys.stderr)
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
    print(json.dumps(result, indent=2) if arguments.json else _in_words(result))
    return 0 if total.clean else 1


def _chunks(dialects: list[Dialect], arguments: argparse.Namespace) -> list[Callable[[], Tally]]:
    """Divide the run into parts, each with its own seed or its own bytes."""
    if arguments.every_byte:
        # A restart and a disconnection at every byte of one tap, on both lines, in both directions.
        return [
            partial(run_sweep, dialect, kind, *place, range(first, min(first + CHUNK, count)))
            for dialect in dialects
            for place, count in bytes_of_a_tap(dialect).items()
            for kind in (FaultKind.RESET, FaultKind.HANG_UP)
            for first in range(0, count, CHUNK)
        ]
    taps, seed = arguments.taps or (20 if arguments.pty else 1000), arguments.seed
    if arguments.pty:
        each = -(-taps // len(dialects))
        return [partial(run_taps, d, each, seed, None, terminal_cell) for d in dialects]
    return [
        partial(
            run_taps,
            dialects[number % len(dialects)],
            min(CHUNK, taps - first),
            seed * 1_000_000 + number,
        )
        for number, first in enumerate(range(0, taps, CHUNK))
    ]


def _mix(arguments: argparse.Namespace) -> Mix:
    """Return the requested kinds and mean number of faults."""
    kinds = tuple(kind.strip() for kind in arguments.only.split(",") if kind.strip())
    return Mix(
        kinds,
        arguments.mean_faults,
        arguments.fixed_tappers,
        arguments.several_objects,
        arguments.set_up,
        arguments.ask,
    )


def _soak(dialects: list[Dialect], arguments: argparse.Namespace) -> int:
    """Run the dialects in parallel, limited by the number of processes."""
    with worker_processes(min(arguments.jobs, len(dialects))) as pool:
        jobs = [pool.submit(soak, d, arguments.soak, arguments.seed) for d in dialects]
        runs = [job.result() for job in jobs]
    if arguments.json:
        print(json.dumps([{**asdict(run), "steady": run.steady} for run in runs], indent=2))
    else:
        for run in runs:
            blocks = ", ".join(f"{count}" for count in run.blocks)
            memory = ", ".join(f"{count / 2**20:.1f}" for count in run.resident)
            print(
                f"{run.dialect}: {run.hours:.2f} h, {run.taps} taps; allocated Python blocks"
                f" {blocks}; resident memory {memory} MiB; threads {run.threads[0]} at the start,"
                f" {run.threads[1]} at the end; file descriptors {run.descriptors[0]} at the start,"
                f" {run.descriptors[1]} at the end; "
                f"{'resources steady' if run.steady else 'RESOURCES NOT STEADY'},"
                f" {'no' if run.clean else 'AT LEAST ONE'} unsafe or double shot, hang or false"
                " report"
            )
    return 0 if all(run.steady and run.clean for run in runs) else 1


def _crashes(arguments: argparse.Namespace) -> int:
    """Run the crash trials. Unlike the other runs, they need ROS."""
    from tapping_cell.cli import crash_trials

    nodes, phases = arguments.node or SIMULATED, arguments.phase or crash_trials.PHASES
    strange = (set(nodes) - set(SIMULATED)) | (set(phases) - set(crash_trials.PHASES))
    if strange:
        print_error(
            f"unknown: {', '.join(sorted(strange))}; the nodes are {', '.join(SIMULATED)}, and the "
            f"phases are {', '.join(crash_trials.PHASES)}"
        )
        return 2

    def report(crash: crash_trials.Crash) -> None:
        if not arguments.json:
            text = "; ".join((crash.sentence, *crash.unsafe)).strip("; ")
            verdict = "" if crash.clean else "NOT CLEAN "
            print(
                f"{crash.node:<15} {crash.phase:<12} {verdict}{crash.ended} after"
                f" {crash.seconds:.1f} s {text}",
                flush=True,
            )

    domain = own_domain()  # the domain stays reserved until this function returns
    domain.use()
    with tempfile.TemporaryDirectory() as folder:
        crashes = crash_trials.run_crashes(Path(folder), nodes, phases, report)
    clean = sum(crash.clean for crash in crashes)
    if arguments.json:
        print(json.dumps([{**asdict(crash), "clean": crash.clean} for crash in crashes], indent=2))
    else:
        print(f"{clean} of {len(crashes)} clean, load {os.getloadavg()[0]:.1f}")
    return 0 if clean == len(crashes) else 1


def _in_words(result: dict[str, object]) -> str:
    lines = [
        f"{name.replace('_', ' '):<16} {result[name]}" for name in result if name != "by_fault"
    ]
    lines.append("outcomes of taps with a fault:")
    by_fault = result["by_fault"]
    assert isinstance(by_fault, dict)
    for kind, counts in by_fault.items():
        parts = ", ".join(f"{count} {outcome}" for outcome, count in sorted(counts.items()))
        lines.append(f"  {kind:<12} {parts}")
    return "\n".join(lines)
