"""Commission a cell, from an empty configuration to the first goal, and verify each step by a
measurement.

The steps are: ports, controller, camera, table, homing, directions and limits, object, first tap at
the lowest energy, arm, tapper, first goal. Until the first tap is made, the cell is in set-up mode:
it moves slowly, taps weakly, and moves only while the enabling device is held. The folder --out
contains the cell's files (config/), the measurements (commission.json) and a report page
(commissioning.html). If the command is called again with the same folder, it resumes at the first
unfinished step.

    python -m tapping_cell commission --yes --out my_cell
    python -m tapping_cell commission --hardware --camera /dev/video0 --out my_cell
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from tapping_cell.cli import argument_types
from tapping_cell.cli.commissioning.session import Session, StepFailed
from tapping_cell.cli.commissioning.steps import STEPS
from tapping_cell.cli.errors import ExitStatus, print_error
from tapping_cell.cli.graph import GraphError, own_domain
from tapping_cell.cli.session import NotReadyInTime
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.report.commissioning_page import write_page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("commissioning"),
        help="folder for the cell's files and measurements (default: commissioning)",
    )
    parser.add_argument(
        "--hardware",
        action="store_true",
        help="use the real camera, arm and tapper (default: simulated)",
    )
    parser.add_argument(
        "--camera",
        default="/dev/video0",
        help="camera device (only with --hardware; default: /dev/video0)",
    )
    parser.add_argument(
        "--yes",
        action="store_true",
        help="run every step without asking for confirmation (only in simulation)",
    )
    parser.add_argument(
        "--again",
        action="append",
        default=[],
        choices=[step.name for step in STEPS],
        help="finished step to repeat; may be given several times",
    )
    parser.add_argument(
        "--until",
        choices=[step.name for step in STEPS],
        help="last step to run (default: the last of all steps)",
    )
    argument_types.add_seed(parser, 1, "random seed of the noise (only in simulation; default: 1)")


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if every step succeeded, 1 if a step failed, 2 for invalid input, 130
    if interrupted."""
    if arguments.yes and arguments.hardware:
        print_error("--yes is for the simulated cell: on hardware a person must watch every step")
        return ExitStatus.REFUSED
    console = Console(highlight=False, soft_wrap=True)
    end_on_signals()
    try:
        domain = own_domain()
    except GraphError as error:
        print_error(str(error))
        return ExitStatus.REFUSED
    domain.use()
    folder = arguments.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    session = Session(
        folder, console, arguments.hardware, arguments.yes, arguments.camera, arguments.seed
    )
    session.load()
    titles = [(step.name, step.title) for step in STEPS]
    for number, step in enumerate(STEPS, start=1):
        if step.name not in session.proofs or step.name in arguments.again:
            console.print(f"[bold]{number} of {len(STEPS)}: {step.title}[/]")
            began = time.monotonic()
            if step.name in arguments.again:
                (folder / f"{step.name}.csv").unlink(missing_ok=True)
            try:
                proof = step.run(session)
            except (StepFailed, GraphError, NotReadyInTime, ConfigurationError) as error:
                write_page(folder, titles, session.proofs)
                print_error(f"step {step.name}: {error}")
                console.print(
                    f"finished steps are kept; continue with --out {folder}", markup=False
                )
                return ExitStatus.FAILED
            except KeyboardInterrupt:
                console.print("interrupted; the same command resumes at this step")
                return ExitStatus.INTERRUPTED
            session.prove(step.name, proof, time.monotonic() - began)
        console.print(f"  [green]proven[/]: {escape(session.proofs[step.name]['sentence'])}")
        if step.name == arguments.until:
            break
    page = write_page(folder, titles, session.proofs)
    console.print(f"cell files: {session.config}; measurements: {page}", markup=False)
    return ExitStatus.DONE
