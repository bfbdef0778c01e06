"""The command line: one module a verb, imported only when its verb is called.

A verb's module has ``add_arguments(parser)`` and ``run(arguments) -> int`` (the exit status); its
docstring is the verb's help.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

VERBS = {
    "demo": "position a disk in the simulated world, from nothing to the goal",
    "up": "start the graph, simulated or on hardware, and stay",
    "goal": "send a goal pose to a running graph",
    "evaluate": "many positioning trials of a planning method",
    "single-tap": "measure an object: a designed experiment of single taps",
    "fit": "an object's friction and impact from records of single taps",
    "sensitivity": "how the tap's result answers errors of the striker's pose",
    "locate": "where the object is in image files",
    "calibrate": "camera, table, arm, tapper: from measurements to a file; printed sheets",
    "faults": "taps over bad serial lines: is anything unsafe, hanging or untrue?",
    "urdf": "the arm of a cell file, for RViz and Foxglove",
    "bench": "benchmarks, each beside a peer measured in the same run",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit status (2 for a wrong command line)."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(
        prog="tapping_cell",
        description="A robot cell that positions flat objects by tapping them.",
        epilog="\n".join(f"  {name:<12} {text}" for name, text in VERBS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("verb", choices=VERBS, metavar="VERB")
    if not words or words[0] not in VERBS:
        parser.parse_args(words[:1])
        return 2
    verb = words[0]
    module = importlib.import_module(f"tapping_cell.cli.{verb.replace('-', '_')}")
    verb_parser = argparse.ArgumentParser(
        prog=f"tapping_cell {verb}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(verb_parser)
    status: int = module.run(verb_parser.parse_args(words[1:]))
    return status
