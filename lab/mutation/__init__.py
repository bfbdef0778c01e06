"""Mutation tests: ``python -m lab mutate`` changes the code that decides on motion and firing, one
small change at a time, and counts the changes that the tests and a campaign notice."""

from __future__ import annotations

import argparse
import importlib
import os
import random
import sys
import time

import pytest

from lab.mutation.mutants import Mutant, Source
from lab.mutation.relevant import test_files
from lab.mutation.runs import A_GOAL_S, Result, Runner
from lab.mutation.table import lines, survivor, write

MODULES = tuple(
    f"{room}.{name}"
    for room, names in (
        ("logic", "permit stops tap_commands tapper_peers tapper tapper_jobs device arm planner"),
        (
            "logic",
            "tapper_cycle tapper_board tapper_commands arm_cycle standing_still arm_readings",
        ),
        ("logic", "planner_inputs goal_requests arm_trajectory"),
        ("logic", "tap_cycle tap_decision tap_steps tap_counts tap_sender confirmation resumption"),
        ("hardware", "tapper output_tapper"),
    )
    for name in names.split()
)
SEED = 1
"""Seed of the campaigns and of the samples."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("--module", choices=MODULES, action="append", help="default: all")
    parser.add_argument("--sample", type=int, metavar="N", help="try N mutants of each module")
    parser.add_argument(
        "--only", default="", metavar="ID", help="try the mutants whose id contains this text"
    )
    parser.add_argument(
        "--campaign",
        type=int,
        metavar="GOALS",
        help="run GOALS goals in virtual time for each mutant that no test has found",
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), metavar="N", help="processes")
    parser.add_argument("--list", action="store_true", help="print the mutants and run nothing")
    parser.add_argument(
        "--write", action="store_true", help="write the modules to benchmarks/RESULTS.md"
    )


def run(arguments: argparse.Namespace) -> int:
    """Try the mutants, print those that survive and a table; return the exit code."""
    sources = [
        Source(importlib.import_module(f"tapping_cell.{name}"))
        for name in arguments.module or MODULES
    ]
    mutants: list[tuple[Source, Mutant]] = []
    for source in sources:
        found = [mutant for mutant in source.mutants if arguments.only in mutant.name]
        if arguments.sample and arguments.sample < len(found):
            chosen = sorted(random.Random(SEED).sample(range(len(found)), arguments.sample))
            found = [found[number] for number in chosen]
        mutants += [(source, mutant) for mutant in found]
    if arguments.list:
        for _, mutant in mutants:
            print(f"{mutant.name}  {mutant.change()}")
        return 0
    results: list[Result] = []
    start = time.monotonic()

    def note(result: Result) -> None:
        results.append(result)
        if not (result.test or result.violation):
            print(survivor(result.mutant), flush=True)
        if len(results) % 50 == 0:
            seconds = sum(each.seconds for each in results)
            print(
                f"{len(results)} of {len(mutants)} mutants, {time.monotonic() - start:.0f} s,"
                f" {60 * len(results) / seconds:.0f} in a minute of one core",
                file=sys.stderr,
                flush=True,
            )

    runner = Runner(
        mutants,
        arguments.jobs,
        note,
        campaign=(lambda: campaign(arguments.campaign, SEED)) if arguments.campaign else None,
        campaign_s=A_GOAL_S * (arguments.campaign or 0),
    )
    options = ("-q", "-s", "-p", "no:cacheprovider", "-p", "no:warnings", "-o", "timeout=0")
    files = test_files({source.module.__name__ for source in sources})
    code = pytest.main([*options, *files], plugins=[runner])
    if code:
        return int(code)
    table = {
        source.name: lines(
            source,
            [each for each in results if each.mutant.name.startswith(f"{source.name}:")],
        )
        for source in sources
    }
    for name in table:
        print(table[name][0])
    if arguments.write:
        write(table, arguments.campaign)
    return 0


def campaign(goals: int, seed: int) -> str:
    """Run goals in virtual time until a violation; return its name, or ""."""
    from lab.campaign import run_campaign

    summary = run_campaign(goals, seed, jobs=1, stop_at_violation=True)
    return summary.violations[0][1].name if summary.violations else ""
