"""Measure an object by single taps at every combination of striker speed and incidence.

Starts the simulated cell (or the hardware with --hardware, or joins a running graph with --attach)
and taps the object near the middle of the table. The record of each tap contains the object's pose
in every image, the object's start and end poses, and the striker's speed. A tap that might move the
object off the table or out of the camera's view is refused. Ctrl-C stops the experiment at any
time; completed trials are kept, and --resume continues the experiment. The verb `object fit`
evaluates the recorded folder.

    python -m tapping_cell single-tap
    python -m tapping_cell single-tap --speeds 600 900 1200 --incidences 15 -40 --trials 5
    python -m tapping_cell single-tap --resume runs/single-tap_2026-01-31_12-00-00
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from tapping_cell_msgs.msg import ErrorCode

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.design import (
    INCIDENCES,
    SPEEDS,
    TRIALS,
    Design,
    read_design,
    write_design,
)
from tapping_cell.calibration.design import progress as progress_of
from tapping_cell.calibration.experiment import (
    HEADER_FILE,
    ExperimentFile,
    StrikerSection,
    write_header,
)
from tapping_cell.calibration.trials import Trial, read_trials
from tapping_cell.cli import argument_types, session
from tapping_cell.cli.errors import print_error
from tapping_cell.cli.graph import HARDWARE, SIMULATED, GraphError
from tapping_cell.cli.measuring_graph import add_graph_arguments, measuring_graph
from tapping_cell.cli.progress import progress
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.cli.start_checks import check_simulation_files
from tapping_cell.cli.tap_feasibility import TapFeasibility
from tapping_cell.cli.tap_maker import READY_TIMEOUT_S, SeriesStopped
from tapping_cell.cli.tap_series import TapSeries
from tapping_cell.cli.tap_summary import print_summary, trial_text
from tapping_cell.cli.up import node_parameters
from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import (
    Cell,
    load_cell,
    refuse_own_drivers,
    refuse_simulated_ports,
)
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import ConfigurationError, load
from tapping_cell.nodes.clients.single_tap_client import NoAnswer, SingleTapClient
from tapping_cell.planning import PlanningError
from tapping_cell.report.bag import BagWriter
from tapping_cell.report.recorded import BagError
from tapping_cell.simulation.truth import TruthFile

RATE_WINDOW_S = 1.0
SLOW_MOTION = 3.0
RANGES = (
    ("trials", 1, 1000),
    ("seed", 0, 1_000_000),
    ("camera-rate", 1.0, 120.0),
    ("slow-motion", 1.0, 100.0),
    ("exposure", 0.0, 100.0),
)
"""Name, minimum and maximum of each option with a range, in the unit of the option."""
STEP_OF_SEED = 1000
"""Difference between the seeds of two sessions of one experiment. With the same seed, the simulated
world would repeat its scatter."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "--speeds",
        nargs="+",
        type=float,
        metavar="MM_S",
        help=f"striker speeds in mm/s (default: {_listed(1000 * v for v in SPEEDS)})",
    )
    parser.add_argument(
        "--incidences",
        nargs="+",
        type=float,
        metavar="DEG",
        help="angles from the contact normal to the striker's axis in degrees (default: "
        f"{_listed(math.degrees(v) for v in INCIDENCES)})",
    )
    parser.add_argument("--trials", type=int, help=f"number of trials per run (default: {TRIALS})")
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--runs-folder",
        type=Path,
        default=Path("runs"),
        help="folder in which the new records folder is created (default: runs)",
    )
    place.add_argument(
        "--resume", type=Path, metavar="FOLDER", help="records folder of an experiment to continue"
    )
    add_graph_arguments(parser)
    parser.add_argument("--object", type=Path, help="object file (default: the cell's)")
    argument_types.add_seed(
        parser, None, "random seed of noise and scatter (only in simulation; default: 1)"
    )
    parser.add_argument(
        "--camera-rate",
        type=float,
        default=30.0,
        help="frame rate of the camera in frames per second (only in simulation; default: 30)",
    )
    parser.add_argument(
        "--slow-motion",
        type=float,
        default=SLOW_MOTION,
        metavar="TIMES",
        help="factor by which simulated slides are slowed down, so that a busy machine drops no "
        "frames; the time stamps are those of slides at normal speed (only in simulation; "
        f"default: {SLOW_MOTION:g})",
    )
    parser.add_argument(
        "--exposure",
        type=float,
        metavar="MS",
        help="exposure time of the camera in ms, if known (default: in simulation, that of the "
        "simulated camera)",
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if the experiment is complete, 1 after a failure, 2 for invalid input,
    130 if interrupted."""
    console = Console(stderr=arguments.json)
    end_on_signals()
    try:
        _check_ranges(arguments)
        check_simulation_files(arguments)
        if arguments.namespace and not arguments.attach:
            raise ConfigurationError("--namespace is used only with --attach; leave it out")
        cell = load_cell(arguments.cell, object_path=arguments.object)
        if arguments.hardware:
            refuse_simulated_ports(cell)
        else:
            refuse_own_drivers(cell)
        folder, design = _open(arguments)
        trials = _recorded(folder)
        refusal = _refused(cell, design)
        if refusal:
            print_error(refusal)
            return 2
        if not arguments.resume:
            write_design(folder, design)
    except (ConfigurationError, RecordError, PlanningError, OSError, ValueError) as error:
        print_error(str(error))
        return 2
    code, sentence, status = ErrorCode.NONE, "", 0
    try:
        if any(far.used < design.trials for far in progress_of(design, trials).values()):
            _measure(arguments, cell, folder, design, trials, console)
    except SeriesStopped as error:
        code, sentence, status = error.code, str(error), 1
    except (GraphError, NoAnswer, session.NotReadyInTime) as error:
        code = ErrorCode.INTERNAL if isinstance(error, GraphError) else ErrorCode.NOT_READY
        sentence, status = str(error), 1
    except (RecordError, BagError, ConfigurationError, OSError) as error:
        code, sentence, status = ErrorCode.CONFIGURATION_CONFLICT, str(error), 1
    except KeyboardInterrupt:
        sentence, status = "interrupted", 130
    print_summary(folder, design, trials, (code, sentence), console, as_json=arguments.json)
    return status


def _check_ranges(arguments: argparse.Namespace) -> None:
    """Reject option values that are out of range.

    Raises:
        ValueError: a value is out of range. The message names the option, value and range.
    """
    for name, low, high in RANGES:
        value = getattr(arguments, name.replace("-", "_"))
        if value is not None and not low <= value <= high:
            raise ValueError(f"--{name} is {value:g}; it must be {low:g} to {high:g}")


def _open(arguments: argparse.Namespace) -> tuple[Path, Design]:
    """Return folder and design of a new or resumed experiment."""
    asked: dict[str, Any] = {}
    if arguments.speeds:
        asked["speeds"] = tuple(speed / 1000 for speed in arguments.speeds)
    if arguments.incidences:
        asked["incidences"] = tuple(math.radians(angle) for angle in arguments.incidences)
    if arguments.trials is not None:
        asked["trials"] = arguments.trials
    if arguments.seed is not None:
        asked["seed"] = arguments.seed
    if not arguments.resume:
        name = f"single-tap_{datetime.now():%Y-%m-%d_%H-%M-%S}"
        return (arguments.runs_folder / name).resolve(), Design(**asked)
    folder = arguments.resume.resolve()
    design = read_design(folder)
    for name, value in asked.items():
        kept = getattr(design, name)
        if not np.allclose(kept, value) if np.shape(kept) == np.shape(value) else True:
            raise RecordError(
                f"--{name} differs from the value with which {folder} was started; leave the "
                "option out, or start a new experiment"
            )
    return folder, design


def _recorded(folder: Path) -> list[Trial]:
    """Return the trials that are already recorded.

    Raises:
        RecordError: a row is unreadable.
    """
    if not any(folder.glob("run_*.csv")):
        return []
    found = read_trials(folder)
    if found.left_out:
        raise RecordError(f"{found.left_out[0]}; correct or remove the row, then resume")
    return list(found.trials)


def _refused(cell: Cell, design: Design) -> str:
    """Return why a tap of the design is infeasible even with the object in the middle of the table;
    empty if all taps are feasible."""
    feasibility = TapFeasibility(cell)
    for run in design.runs:
        problem = feasibility.problem(run.striker_speed, run.incidence)
        if problem:
            return (
                f"run {run.number} ({1000 * run.striker_speed:.0f} mm/s, "
                f"{math.degrees(run.incidence):.1f} deg): {problem}"
            )
    return ""


def _measure(
    arguments: argparse.Namespace,
    cell: Cell,
    folder: Path,
    design: Design,
    trials: list[Trial],
    console: Console,
) -> None:
    """Make the trials of the design that have not been recorded yet. Each trial is written to disk
    before the next one starts."""
    sessions = sum(1 for entry in folder.glob("session_*") if entry.is_dir())
    name = f"session_{sessions + 1:02d}"
    seed = design.seed + STEP_OF_SEED * sessions
    with (
        _graph(arguments, cell, folder / "logs", seed, console) as check,
        SingleTapClient("single_tap_client", arguments.namespace) as client,
    ):
        session.wait_until_ready(client, READY_TIMEOUT_S, check, console)
        session.require_object(client, cell)
        header = _header(arguments, cell, client, check)
        _keep_header(folder, header)
        with BagWriter(folder / name, notes={"experiment": folder.name, "session": name}) as bag:
            client.begin_bag(bag)
            series = TapSeries(
                client, folder, design, header, assembly.make_tap(cell), bag, trials, check
            )
            try:
                _follow(series, design, trials, console)
            finally:
                client.write_bag(bag)


def _graph(
    arguments: argparse.Namespace, cell: Cell, logs: Path, seed: int, console: Console
) -> AbstractContextManager[Callable[[], None]]:
    """Start the graph or attach to a running one. The context's value is a function that raises an
    exception if a node died."""
    parameters = node_parameters(argparse.Namespace(**{**vars(arguments), "seed": seed}), cell)
    parameters["sim_world"] |= {
        "frame_rate": arguments.camera_rate,
        "slow_motion": arguments.slow_motion,
    }
    nodes = HARDWARE if arguments.hardware else SIMULATED
    return measuring_graph(arguments, nodes, parameters, logs, console.print)


def _header(
    arguments: argparse.Namespace, cell: Cell, client: SingleTapClient, check: Callable[[], None]
) -> ExperimentFile:
    """Return the values that apply to every trial of this session."""
    tapper = cell.file.tapper
    own_world = not (arguments.attach or arguments.hardware)
    exposure = 0.0 if arguments.exposure is None else arguments.exposure / 1000
    if arguments.exposure is None and own_world:
        truth = arguments.truth or shared_folder() / "truth" / "default.yaml"
        exposure = load(TruthFile, truth).camera.exposure
    rate = arguments.camera_rate if own_world else client.camera_rate(RATE_WINDOW_S, check)
    return ExperimentFile(
        format=1,
        made=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        source="simulated" if client.simulated else "hardware",
        description=f"single taps of the {cell.object.name}",
        striker=StrikerSection(tapper.mass, tapper.tip_radius, tapper.constraint),
        object=cell.object,
        camera_rate_hz=round(rate, 2) if math.isfinite(rate) else None,
        exposure=exposure,
        rest_position_std=cell.file.camera.position_noise,
        rest_rotation_std=cell.file.camera.angle_noise,
    )


def _keep_header(folder: Path, header: ExperimentFile) -> None:
    """Write the header, or check that an existing header describes the same experiment.

    Raises:
        RecordError: the existing header describes another object, striker or source.
    """
    if not (folder / HEADER_FILE).exists():
        write_header(folder, header)
        return
    kept = load(ExperimentFile, folder / HEADER_FILE)
    for name in ("source", "object", "striker"):
        if getattr(kept, name) != getattr(header, name):
            raise RecordError(
                f"{folder / HEADER_FILE}: '{name}' differs from that of this cell; resume with "
                "the options and files with which the experiment was started, or start a new one"
            )


def _follow(series: TapSeries, design: Design, trials: list[Trial], console: Console) -> None:
    """Make the trials and show the progress."""
    wanted = len(design.runs) * design.trials
    used = sum(trial.outcome == "ok" for trial in trials)
    with progress("trials", wanted, completed=used, console=console) as advance:
        for done in series.run():
            advance(int(done.trial.outcome == "ok"), trial_text(done))


def _listed(values: Iterable[float]) -> str:
    return " ".join(f"{value:.0f}" for value in values)
