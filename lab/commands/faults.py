"""Simulate goals of the whole cell in virtual time, under random faults.

Processes, messages, clocks, serial lines, boards, the camera and people fail at random. After every
event, the oracle checks what moved, what was fired, what was promised and what was reported.

    python -m lab faults --goals 1000 --seed 1        # the cell with an arm
    python -m lab faults --goals 500 --only 'freeze, freeze at a shot'
    python -m lab faults --goals 1000 --fixed-tappers # the positioning cell
    python -m lab faults --goals 500 --set-up         # every cell in set-up mode
    python -m lab faults --replay 1000003             # repeat one run and print its trace

The exit code is 0 only if no invariant was violated.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from lab.campaign import GOALS_A_RUN, Summary, run_campaign, run_trial
from lab.faults.faults import ALL, ASK_MAKERS, KINDS, SET_UP_MAKERS, Mix
from lab.faults.fixed_faults import FIXED_MAKERS, FIXED_SET_UP_MAKERS
from lab.faults.table_faults import TABLE_MAKERS
from tapping_cell.cli import argument_types
from tapping_cell.cli.errors import print_error
from tapping_cell.report import error_codes

TRACE_LINES = 60
"""Number of printed lines of a violation's trace; ``--replay`` prints the whole trace."""
CELLS = {
    "fixed": ("--fixed-tappers", "the positioning cell with fixed tappers"),
    "several": ("--several-objects", "only cells with two or three objects"),
    "set_up": ("--set-up", "every cell in set-up mode"),
    "ask": ("--ask", "every cell with a person who confirms every tap"),
}
"""Options that choose the cells; otherwise, the seed chooses objects and modes."""
EXCLUDED = (("fixed", "several"), ("fixed", "ask"), ("several", "set_up"), ("several", "ask"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--goals", type=int, metavar="N", help="number of goals (default: 1000; with --replay: 10)"
    )
    argument_types.add_seed(parser, 0, "random seed of the campaign (default: 0)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="number of processes")
    parser.add_argument(
        "--only", metavar="KINDS", default="", help="kinds of faults, separated by commas"
    )
    parser.add_argument(
        "--mean-faults", type=float, metavar="N", default=ALL.mean, help="mean number per goal"
    )
    for name, (option, text) in CELLS.items():
        parser.add_argument(option, dest=name, action="store_true", help=f"simulate {text}")
    parser.add_argument("--replay", type=int, metavar="SEED", help="repeat the run of this seed")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run the campaign, or repeat one run."""
    if any(count is not None and count < 1 for count in (arguments.goals, arguments.jobs)):
        print_error("--goals and --jobs must be at least 1")
        return 2
    if not 1.0 <= arguments.mean_faults <= 50.0:
        print_error(f"--mean-faults {arguments.mean_faults:g} is not from 1 to 50")
        return 2
    for pair in EXCLUDED:
        if all(getattr(arguments, name) for name in pair):
            print_error(f"{' and '.join(CELLS[name][0] for name in pair)} exclude each other")
            return 2
    mix = Mix(
        tuple(kind.strip() for kind in arguments.only.split(",") if kind.strip()),
        arguments.mean_faults,
        **{name: getattr(arguments, name) for name in CELLS},
    )
    if arguments.replay is not None:
        return replay(arguments.replay, arguments.goals or GOALS_A_RUN, mix)
    return run_goals(arguments.goals or 1000, arguments.seed, arguments.jobs, arguments.json, mix)


def run_goals(goals: int, seed: int, jobs: int, as_json: bool, mix: Mix = ALL) -> int:
    """Run a campaign. Return exit code 0 only if no invariant was violated."""
    known = tuple(FIXED_MAKERS) if mix.fixed else tuple(TABLE_MAKERS) if mix.several else KINDS
    if mix.set_up:
        known += tuple(FIXED_SET_UP_MAKERS if mix.fixed else SET_UP_MAKERS)
    if mix.ask:
        known += tuple(ASK_MAKERS)
    unknown = sorted(set(mix.only) - set(known))
    if unknown:
        print_error(f"no such faults: {', '.join(unknown)}; choose from: {', '.join(known)}")
        return 2
    began, done, printed = time.monotonic(), 0, 0
    with Progress(
        TextColumn("goals"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[violations]} violations"),
        disable=as_json or not sys.stderr.isatty(),
    ) as progress:
        bar = progress.add_task("goals", total=goals, violations=0)

        def show(summary: Summary) -> None:
            nonlocal done, printed
            for run, violation in summary.violations[printed:]:
                # Print it at once: a long campaign goes on, and this run can be repeated meanwhile.
                print(f"violation in run {run}: {violation.sentence}", file=sys.stderr, flush=True)
            done, printed = summary.goals, len(summary.violations)
            progress.update(bar, completed=done, violations=printed)

        try:
            summary = run_campaign(goals, seed, jobs, show, mix=mix)
        except KeyboardInterrupt:
            progress.stop()
            print(f"{done} goals were completed, with {printed} violations", file=sys.stderr)
            raise
    wall = time.monotonic() - began
    if as_json:
        print(json.dumps(as_json_object(summary, seed, wall), indent=2))
    else:
        _print(summary, wall, mix)
    return 1 if summary.violations else 0


def replay(seed: int, goals: int, mix: Mix = ALL) -> int:
    """Repeat one run and print its whole trace."""
    report = run_trial(seed, goals, True, mix)
    print("\n".join(report.trace))
    for violation in report.violations:
        print(f"VIOLATION at {violation.time:.3f} s: {violation.name}: {violation.sentence}")
    return 1 if report.violations else 0


def as_json_object(summary: Summary, seed: int, wall: float) -> dict[str, object]:
    """Return the results of a campaign, which took ``wall`` s, for a JSON file."""
    return {
        "goals": summary.goals,
        "taps": summary.taps,
        "program_taps": summary.program_taps,
        "seed": seed,
        "cell_hours": round(summary.cell_seconds / 3600, 3),
        "wall_time": round(wall, 1),
        "by_fault": dict(summary.by_fault.most_common()),
        "by_node": dict(sorted(summary.by_node.items())),
        "releases": summary.releases,
        "by_outcome": {_name(code): count for code, count in summary.by_code.most_common()},
        "violations": [
            {
                "seed": seed,
                "time": violation.time,
                "name": violation.name,
                "what": violation.sentence,
            }
            for seed, violation in summary.violations
        ],
    }


def _print(summary: Summary, wall: float, mix: Mix) -> None:
    speed = summary.cell_seconds / max(wall, 1e-9)
    print(
        f"{summary.goals} goals with {summary.taps} taps, and {summary.program_taps} further taps"
        " that another program commanded instead of the planner;"
        f" {summary.cell_seconds / 3600:.1f} h of cell time simulated in {wall:.0f} s"
        f" ({speed:.0f} times real time)"
    )
    print("faults:")
    for kind, count in summary.by_fault.most_common():
        print(f"  {kind:<28} {count}")
    print("faults by node:")
    for node, count in sorted(summary.by_node.items()):
        print(f"  {node:<28} {count}")
    print(f"releases: {summary.releases}")
    print("outcomes:")
    for code, count in summary.by_code.most_common():
        print(f"  {_name(code):<28} {count}")
    print(f"{len(summary.violations)} violations")
    for seed, violation in summary.violations:
        print(f"  seed {seed}, {violation.time:.3f} s: {violation.name}: {violation.sentence}")
        trace = run_trial(seed, 10, True, mix).trace
        print("\n".join(f"    {line}" for line in trace[-TRACE_LINES:]))


def _name(code: int) -> str:
    return "planner lost" if code < 0 else error_codes.name(code)
