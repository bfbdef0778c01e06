"""Goals in simulated time under random faults: ``faults --goals``, ``--replay``, ``--mutants``."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from tapping_cell.cli.errors import print_error
from tapping_cell.report import error_codes
from tapping_cell.verification.all_mutants import ALL_MUTANTS
from tapping_cell.verification.campaign import Summary, run_campaign, run_trial
from tapping_cell.verification.faults import ALL, ASK_MAKERS, KINDS, SET_UP_MAKERS, Mix
from tapping_cell.verification.fixed_faults import FIXED_MAKERS, FIXED_SET_UP_MAKERS
from tapping_cell.verification.mutants import Mutant
from tapping_cell.verification.table_faults import TABLE_MAKERS

TRACE_LINES = 60
"""Number of printed lines of a violation's trace; ``--replay`` prints the whole trace."""
GOALS_IN_A_STEP = 100
"""Number of goals between two checks of whether a mutant was detected."""


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


def run_mutants(goals: int, seed: int, jobs: int, names: Sequence[str], as_json: bool) -> int:
    """Test each mutant in separate processes. Return exit code 0 only if all mutants are
    detected."""
    unknown = sorted(set(names) - {mutant.name for mutant in ALL_MUTANTS})
    if unknown:
        print_error(f"no such mutants: {'; '.join(unknown)}")
        return 2
    chosen = [mutant for mutant in ALL_MUTANTS if not names or mutant.name in names]
    width = max(len(mutant.name) for mutant in chosen)
    if not as_json:
        print(f"{'defect':<{width}} {'finding':<8} {'goals':>6}  {'caught by':<24} faults")
    results: list[dict[str, object]] = []
    for mutant in chosen:
        caught = hunt(mutant, goals, seed, jobs)
        results.append(caught)
        if not as_json:
            found = caught["caught by"] or "SURVIVED"
            kinds = ", ".join(mutant.kinds) or "all"
            row = f"{mutant.finding or '-':<8} {caught['goals']:>6}  {found:<24} {kinds}"
            print(f"{mutant.name:<{width}} {row}", flush=True)
    survived = [result for result in results if not result["caught by"]]
    if as_json:
        print(json.dumps(results, indent=2))
    else:
        print(f"{len(results) - len(survived)} of {len(results)} caught")
    return 1 if survived else 0


def hunt(mutant: Mutant, goals: int, seed: int, jobs: int) -> dict[str, object]:
    """Simulate goals with an active mutant, in ``jobs`` processes at a time, until an invariant is
    violated. Return the mutant's name, the review finding whose correction the mutant removes, the
    number of goals, and the violated invariant (empty if the mutant was not detected).
    """
    done, caught_by = 0, ""
    while done < goals and not caught_by:
        step = min(GOALS_IN_A_STEP, -(-(goals - done) // jobs))
        command = [sys.executable, "-m", "tapping_cell.verification.hunt", mutant.name]
        command += ["--goals", str(step)]
        running = [
            subprocess.Popen(
                [*command, "--seed", str(seed + done + job), "--core", str(job)],
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,  # Ctrl-C is handled below
            )
            for job in range(jobs)
        ]
        answers = []
        try:
            for process in running:
                printed, _ = process.communicate()
                if process.returncode:
                    raise RuntimeError(f"mutant '{mutant.name}' could not be run: {printed}")
                answers.append(json.loads(printed))
        finally:
            for process in running:
                process.kill()  # has no effect on a process that has ended
        done += sum(answer["goals"] for answer in answers)
        caught_by = next((a["caught by"] for a in answers if a["caught by"]), "")
    return {
        "name": mutant.name,
        "finding": mutant.finding,
        "goals": done,
        "caught by": caught_by,
    }


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
