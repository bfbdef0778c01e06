"""Check whether a node fulfils its duties in the cell, such as a pose estimator, an arm node or a
planner of your own. This program plays all other nodes. docs/contracts.md lists the
duties.

Start only this node, and sim_world if its devices are simulated. The arm moves over the table and
the striker fires: clear the table, and keep away.

    python -m tapping_cell conformance scara_arm
    python -m tapping_cell conformance camera_pose --only C3 C5
"""

from __future__ import annotations

import argparse
import time
from types import ModuleType

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tapping_cell.cli import argument_types
from tapping_cell.cli.errors import ExitStatus, print_error, wrong_choice
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.conformance import arm, camera, planner, tapper
from tapping_cell.nodes.clients.conformance_client import ConformanceClient, NotAlone

PARTS: dict[str, ModuleType] = {part.NODE: part for part in (arm, tapper, camera, planner)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("node", choices=PARTS, help="node of the cell whose duties are checked")
    argument_types.add_cell(parser)
    parser.add_argument(
        "--only", nargs="+", metavar="DUTY", help="numbers of the duties to check, such as A3"
    )
    argument_types.add_namespace(parser, "namespace of the node (default: none)")


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if the node fulfils all duties, 1 if not, 2 if it cannot be tested."""
    part = PARTS[arguments.node]
    duties = part.DUTIES
    if arguments.only:
        numbers = [duty.number for duty in duties]
        unknown = [number for number in arguments.only if number not in numbers]
        if unknown:
            print_error(wrong_choice("--only", unknown[0], numbers))
            return ExitStatus.REFUSED
        duties = tuple(duty for duty in duties if duty.number in arguments.only)
    try:
        cell = load_cell(arguments.cell)
    except ConfigurationError as error:
        print_error(str(error))
        return ExitStatus.REFUSED
    console, failed = Console(highlight=False), 0
    with ConformanceClient(
        arguments.node, cell, part.PLAYS, part.LISTENS, arguments.namespace
    ) as client:
        try:
            client.check_alone()
        except NotAlone as error:
            print_error(str(error))
            return ExitStatus.FAILED
        for duty in duties:
            begun = time.monotonic()
            found = client.check(part.begin, duty)
            failed += bool(found)
            row = Table.grid(padding=(0, 1))
            for width in (3, 9, 6):
                row.add_column(min_width=width)
            verdict = "[red]violated" if found else "fulfilled"
            row.add_row(
                duty.number,
                verdict,
                f"{time.monotonic() - begun:4.1f} s",
                escape(duty.text + (f"\nFound: {found}" if found else "")),
            )
            console.print(row)
    console.print(
        f"{len(duties) - failed} of {len(duties)} duties of {arguments.node} are fulfilled"
    )
    return ExitStatus.FAILED if failed else ExitStatus.DONE
