"""Commission a cell, from an empty configuration to the first goal, and verify each step by a
measurement.

The steps are: ports, controller, camera, table, homing, directions and limits, object, first tap at
the lowest energy, arm, tapper, first goal. Until the first tap is made, the cell is in set-up mode:
it moves slowly, taps weakly, and moves only while the enabling device is held. The folder --out
contains the cell's files (config/), the measurements (commission.json) and a report page
(commissioning.html). If the command is called again with the same folder, it resumes at the first
unfinished step. A simulated session and a session on hardware need two folders.

    python -m tapping_cell commission --yes --out simulated_cell
    python -m tapping_cell commission --hardware --camera /dev/video0 --out my_cell
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from tapping_cell.cli import argument_types
from tapping_cell.cli.commissioning.session import Session, StepFailed
from tapping_cell.cli.commissioning.steps import STEPS, Step
from tapping_cell.cli.errors import ExitStatus, print_error
from tapping_cell.cli.graph import GraphError, own_domain
from tapping_cell.cli.session import NotReadyInTime
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.cli.start_checks import require_folder
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.durable_file import replace_text
from tapping_cell.nodes.clients.single_tap_client import NoAnswer
from tapping_cell.report.rendering import render

RESUME_ADVICE = re.compile(r"(;|, then) continue with --resume")
"""Advice in the messages of other verbs. `commission` has no such option: it always resumes."""


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
        session = _begin(arguments, console)
    except (ConfigurationError, GraphError, OSError) as error:
        print_error(str(error))
        return ExitStatus.REFUSED
    for number, step in enumerate(STEPS, start=1):
        if step.name not in session.proofs:
            console.print(f"[bold]{number} of {len(STEPS)}: {step.title}[/]")
            began = time.monotonic()
            try:
                session.prove(step.name, step.run(session), time.monotonic() - began)
            except BrokenPipeError:
                raise  # the reader of the output has gone
            except (
                StepFailed,
                GraphError,
                NoAnswer,
                NotReadyInTime,
                ConfigurationError,
                OSError,
            ) as error:
                print_error(f"step {step.name}: {RESUME_ADVICE.sub('', str(error))}")
                _write_page(session)
                how = _how_to_continue(session, step, arguments.again)
                console.print(f"finished steps are kept in {session.folder}; {how}", markup=False)
                return ExitStatus.FAILED
            except KeyboardInterrupt:
                how = _how_to_continue(session, step, arguments.again)
                console.print(f"interrupted; {how}", markup=False)
                return ExitStatus.INTERRUPTED
        console.print(f"  [green]proven[/]: {escape(session.proofs[step.name]['sentence'])}")
        if step.name == arguments.until:
            break
    page = _write_page(session)
    if page is None:
        return ExitStatus.FAILED
    console.print(f"cell files: {session.config}; measurements: {page}", markup=False)
    return ExitStatus.DONE


def _begin(arguments: argparse.Namespace, console: Console) -> Session:
    """Open the session in its folder, without the steps to repeat, and reserve a ROS domain.

    Raises:
        ConfigurationError, OSError: the folder cannot be used. The message states why.
        GraphError: no ROS domain is free.
    """
    require_folder(arguments.out, "--out")
    session = Session(
        arguments.out.resolve(),
        console,
        arguments.hardware,
        arguments.yes,
        arguments.camera,
        arguments.seed,
    )
    session.load()
    own_domain().use()
    session.folder.mkdir(parents=True, exist_ok=True)
    session.save()
    for name in arguments.again:
        session.forget(name)
    return session


def _write_page(session: Session) -> Path | None:
    """Write the page of the measurements. If this fails, print an error and return None."""
    titles = [(step.name, step.title) for step in STEPS]
    try:
        return write_page(session.folder, titles, session.proofs, hardware=session.hardware)
    except OSError as error:
        print_error(f"the page of the measurements cannot be written: {error}")
        return None


def _how_to_continue(session: Session, step: Step, again: list[str]) -> str:
    """Return a message on how to continue at a step that did not succeed."""
    command = "the same command without --again" if again else "the same command"
    recording = session.recording(step.name)
    if not recording.exists():
        return f"{command} resumes at this step"
    return (
        f"{command} resumes at this step with the measurements in {recording.name}; "
        f"--again {step.name} discards them"
    )


PAGE = "commissioning.html"


def write_page(
    folder: Path,
    titles: Sequence[tuple[str, str]],
    proofs: Mapping[str, Any],
    *,
    hardware: bool,
) -> Path:
    """Write ``commissioning.html``; ``titles`` are name and title of every step, in order.
    ``hardware``: whether the steps ran on hardware."""
    text = render(
        "commissioning.html",
        steps=titles,
        proofs=proofs,
        cell="cell" if hardware else "simulated cell",
        done=sum(name in proofs for name, _ in titles),
        seconds=sum(float(proof["seconds"]) for proof in proofs.values()),
    )
    page = folder / PAGE
    replace_text(page, text)
    return page
