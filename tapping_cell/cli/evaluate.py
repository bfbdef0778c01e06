"""Evaluate a planning method in many positioning trials without ROS: number of taps and success
rate.

example:
  python -m tapping_cell evaluate --planner optimal --goal 10 0 10 --camera-noise 0.1 0.1

Lengths are in mm, angles in degrees, shares in percent. With the model "abstract", a tap has the
intended displacement plus scatter. The model "physics" simulates strike, impact and slide with true
parameters, which the planner does not receive. They are read from --truth, and from --truth-object
if the true object differs from the planner's. The model "world" integrates contact and slide
numerically, with the scatter given in --truth.

With --table, the trials run on the cell's table, with its edges and keep-out zones, within the
arm's reach. A goal out of reach must then be refused before the first tap: a later refusal counts
as a failure. A cell with fixed tappers is evaluated on its own working area, with one row of
results for each of --start-angles:

  python -m tapping_cell evaluate --cell config/positioning_cell/cell.yaml --camera-noise 0.05 0.05

A sweep evaluates every point of a parameter grid, on all cores, and resumes after an interruption:

  python -m tapping_cell evaluate --model physics --sweep friction=0.1:0.4:7 tolerance=1,0.3 \\
      --report sweep

With --cluster, the points run on the workers of a Dask cluster that have the same files.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from tapping_cell.cli import argument_types, sweep
from tapping_cell.cli.errors import print_refusal
from tapping_cell.cli.evaluate_common import (
    add_scatter_arguments,
    camera_of,
    inputs_of,
    refuse_faulty,
    scatter_of,
    share_text,
    si_pair,
)
from tapping_cell.cli.evaluate_fixed import add_fixed_arguments, run_fixed
from tapping_cell.cli.progress import progress
from tapping_cell.cli.start_checks import refuse_unused, require_folder
from tapping_cell.configuration.assembly import make_strike_space, make_tap
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import ObjectFile, area_of, load_object
from tapping_cell.configuration.schema import ConfigurationError, load
from tapping_cell.logic.arm_times import ArmTimes, arm_times
from tapping_cell.mechanics import MechanicsError, Tap
from tapping_cell.planning import FreeSpace, PlannerSettings, PlanningError, make_planner
from tapping_cell.planning.evaluation import (
    Evaluation,
    PhysicsWorld,
    Results,
    arrangements,
    evaluate,
    summarise,
)
from tapping_cell.planning.evaluation.summary import mean_of
from tapping_cell.planning.evaluation.task import TRUTH
from tapping_cell.planning.evaluation.worlds import World
from tapping_cell.planning.multi import MultiPlanner
from tapping_cell.planning.registry import load_planner
from tapping_cell.planning.settings import Scatter
from tapping_cell.planning.strike import StrikeSpace
from tapping_cell.simulation.tap_trials import SimulatedTaps
from tapping_cell.simulation.truth import TruthFile

LARGE_TASKS = (300.0, 180.0)
DEFAULT_TASKS = (40.0, 20.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "--planner",
        default="optimal",
        metavar="P",
        help="planning method: a name, or module:Class for a class of yours (default: optimal)",
    )
    parser.add_argument(
        "--all", action="store_true", help="compare all planning methods with that of --planner"
    )
    parser.add_argument(
        "--trials", type=int, default=2000, metavar="N", help="number of trials (default: 2000)"
    )
    parser.add_argument(
        "--goal",
        **argument_types.POSE,
        default=(10.0, 0.0, 10.0),
        help="goal relative to the start, in mm, mm and degrees (default: 10 0 10)",
    )
    parser.add_argument(
        "--random-tasks",
        type=float,
        nargs="*",
        metavar="MAX",
        help="draw a random goal for each trial, up to this distance in mm and rotation in "
        "degrees (without values: 40 20, or 300 180 with --table)",
    )
    parser.add_argument(
        "--tolerance",
        action=argument_types.Tolerance,
        **argument_types.MM_AND_DEGREES,
        default=(1.0, 1.0),
        help="position and angle tolerance of the goal, in mm and degrees (default: 1 1)",
    )
    add_scatter_arguments(parser)
    parser.add_argument(
        "--camera-noise",
        **argument_types.MM_AND_DEGREES,
        default=(0.0, 0.0),
        help="standard deviations of a measured pose, in mm and degrees (default: 0 0)",
    )
    parser.add_argument(
        "--gain-bias",
        type=float,
        nargs=2,
        default=(0.0, 0.0),
        metavar=("D", "R"),
        help="systematic errors of distance and rotation in percent. They are the same for all "
        "taps of a trial; their signs are drawn for each trial (default: 0 0)",
    )
    parser.add_argument(
        "--unknown",
        nargs="+",
        default=[],
        metavar="NAME=FACTOR",
        help="largest factors, in either direction, by which true values differ from the assumed "
        "ones; each trial draws its own. Names: friction, torque_factor and rotation (rotation "
        "per distance). Two numbers D R mean friction=D rotation=R (default: none)",
    )
    parser.add_argument(
        "--track",
        default="off",
        metavar="HZ",
        help="images per second of a camera that follows the slide, from which the planner learns "
        "friction and torque factor apart from the scatter of the impact. off: poses at rest only. "
        "truth: the true values are known after the first tap, which no camera exceeds (with "
        "--model abstract, or a rate with --model world --table; default: off)",
    )
    parser.add_argument(
        "--off-centre",
        type=float,
        default=0.0,
        metavar="DEG_PER_MM",
        help="simulate objects whose centre of mass or of friction is off centre, so that each "
        "tap adds a rotation in proportion to its distance. Each trial draws this rotation "
        "per distance; the option is its standard deviation, in degrees per mm (default: 0)",
    )
    parser.add_argument(
        "--probe",
        action="store_true",
        help="begin with the smallest taps, which measure the object's friction (only with "
        "--table)",
    )
    parser.add_argument(
        "--adapt",
        action="store_true",
        help="learn from every tap how distance and rotation differ from the prediction",
    )
    parser.add_argument(
        "--box",
        type=float,
        metavar="SHARE",
        help="stop when the measured error is within this fraction of the tolerance (default: the "
        "largest fraction that the camera noise allows)",
    )
    parser.add_argument(
        "--variant",
        choices=("overshoot", "retreat"),
        default="overshoot",
        help="first tap of a two-tap plan: past the goal (overshoot), or away from it (retreat); "
        "only for the methods exact and conservative (default: overshoot)",
    )
    parser.add_argument(
        "--error-line",
        type=float,
        metavar="PERCENT",
        help="assumed rotation error, +- percent of the tap's rotation, for the methods "
        "conservative (default: 30) and multi (default: 60)",
    )
    parser.add_argument(
        "--model",
        choices=("abstract", "physics", "world"),
        default="abstract",
        help="model of a tap. abstract: displacements with scatter. physics: closed-form impact "
        "and slide. world: numerically integrated contact and slide, with the scatter given in the "
        "--truth file (default: abstract)",
    )
    parser.add_argument(
        "--round-position",
        type=float,
        default=0.0,
        metavar="MM",
        help="step to which the arm rounds the striker's position, in mm (only with --model "
        "physics or world; default: 0, no rounding)",
    )
    parser.add_argument(
        "--round-angle",
        type=float,
        default=0.0,
        metavar="DEG",
        help="step to which the arm rounds the striker's angle, in degrees (only with --model "
        "physics or world; default: 0, no rounding)",
    )
    parser.add_argument(
        "--objective",
        choices=("taps", "time"),
        help="quantity to minimise: taps (number of taps) or time (total time, including the "
        "motion of the arm or the flight of the fixed strikers); time needs --table or a cell with "
        "fixed tappers (default: with --table or fixed tappers that of the cell file, otherwise "
        "taps)",
    )
    parser.add_argument(
        "--table",
        action="store_true",
        help="run the trials on the cell's table, within the arm's reach",
    )
    parser.add_argument(
        "--cell",
        type=argument_types.configuration_file,
        metavar="FILE",
        help="cell file (used with --model physics or world, with --table, and for a cell with "
        "fixed tappers; default: the package's cell.yaml)",
    )
    parser.add_argument(
        "--object",
        type=argument_types.configuration_file,
        metavar="FILE",
        help="object file (used wherever --cell is used; default: the cell's)",
    )
    parser.add_argument(
        "--truth",
        type=argument_types.configuration_file,
        metavar="FILE",
        help="file with the simulation parameters (used with --model physics or world, and with "
        "--table; default: the package's truth/default.yaml)",
    )
    parser.add_argument(
        "--truth-object",
        type=argument_types.configuration_file,
        metavar="FILE",
        help="object file with the true parameters, if it differs from the planner's (used with "
        "--model physics or world; default: the planner's)",
    )
    parser.add_argument(
        "--true-friction",
        type=float,
        metavar="MU",
        help="true coefficient of friction (only with --model physics; default: from the object "
        "file and --truth)",
    )
    parser.add_argument(
        "--sweep",
        nargs="+",
        metavar="NAME=VALUES",
        help="parameter grid to evaluate, as first:last:number or a list of values, for example "
        "friction=0.1:0.4:7 tolerance=1,0.3; an interrupted sweep is continued (requires "
        "--report)",
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="address of a Dask scheduler whose workers run the points, for example "
        "tcp://192.168.1.5:8786; requires the Python package 'distributed' (only with --sweep)",
    )
    add_fixed_arguments(parser)
    several = parser.add_argument_group(
        "several objects",
        "options for moving several objects to their own goals; --trials is the number of scenes",
    )
    several.add_argument(
        "--arrange",
        type=int,
        metavar="N",
        help="number of objects of mixed shape to arrange (1 to 20)",
    )
    several.add_argument(
        "--goals",
        choices=("random", "swap", "grid"),
        default="random",
        help="goals of the objects: random, exchanged in pairs (swap), or a compact grid of disks"
        " (only with --arrange; default: random)",
    )
    several.add_argument(
        "--gap",
        type=float,
        default=40.0,
        metavar="MM",
        help="minimum gap between objects at starts and goals, in mm (only with --arrange; "
        "default: 40)",
    )
    several.add_argument(
        "--method",
        choices=("sequence", "file order", "nearest first"),
        default="sequence",
        help="method that chooses the next object: the built-in planner (sequence) or a baseline "
        "(only with --arrange; default: sequence)",
    )
    several.add_argument(
        "--radius",
        type=float,
        nargs="+",
        default=(20.0, 30.0, 40.0),
        metavar="MM",
        help="radii of the disks and half diagonals of the squares, in mm; a grid has disks of "
        "the first radius only (only with --arrange; default: 20 30 40)",
    )
    parser.add_argument(
        "--most-taps",
        type=int,
        default=100,
        metavar="N",
        help="number of taps after which a trial is aborted and counted as endless (default: 100)",
    )
    argument_types.add_seed(parser, 0, "random seed (default: 0)")
    parser.add_argument(
        "--processes", type=int, metavar="N", help="number of processes (default: one per core)"
    )
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    parser.add_argument(
        "--force",
        action="store_true",
        help="also evaluate a cell file that check-config refuses",
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="DIR",
        help="folder for trials.csv, a table of all trials; with --all also for the comparison and "
        "its plots, with --sweep also for the table of the points and its plot, with --arrange "
        "instead for scenes.csv and figures of up to six scenes",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the evaluation. Return 0, or 2 for invalid options."""
    # The work is distributed over processes, and additional BLAS threads would slow them down.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        require_folder(arguments.report, "--report")
        if not arguments.table:
            refuse_unused(arguments, "only with --table", "probe")
        fixed = _fixed_cell(arguments)
        if arguments.sweep and (fixed is not None or arguments.arrange is not None):
            raise PlanningError(
                "--sweep evaluates one object and an arm; leave --arrange out, and give no cell "
                "file with fixed tappers"
            )
        if arguments.cluster and not arguments.sweep:
            raise PlanningError("--cluster runs the points of a sweep: give --sweep with it")
        if fixed is not None:
            return run_fixed(arguments, fixed)
        if arguments.arrange is not None:
            return _arrange(arguments)
        if arguments.sweep:
            return _sweep(arguments)
        if arguments.all:
            return _compare(arguments)
        figures, results = _measure(arguments, make_evaluation(arguments, arguments.planner))
    except (PlanningError, ConfigurationError, MechanicsError) as error:
        return print_refusal(error)
    if arguments.json:
        print(json.dumps(figures, indent=2))
    else:
        print(_text(arguments.planner, figures))
    if arguments.report is not None:
        from tapping_cell.report.tables import TRIALS, trial_columns, write_trials

        method = {"method": arguments.planner}
        write_trials(arguments.report / TRIALS, [(method, trial_columns(results))])
    return 0


def _fixed_cell(arguments: argparse.Namespace) -> Cell | None:
    """Return the selected cell if it has fixed tappers, otherwise None."""
    if arguments.cell is None:
        return None
    cell = load_cell(arguments.cell, arguments.object)
    refuse_faulty(arguments, cell)
    return cell if cell.file.fixed_tappers is not None else None


def make_evaluation(arguments: argparse.Namespace, planner: str) -> Evaluation:
    """Return the evaluation that the options describe, in SI units."""
    settings = _settings(arguments)
    world: World | None = None
    space = clock = None
    objective = arguments.objective
    cell = load_cell(arguments.cell, arguments.object)
    times = None if arguments.table else arm_times(cell)
    if arguments.model != "abstract" or arguments.table:
        settings = _fitted(settings, make_tap(cell))
        if arguments.model == "physics":
            world = _physics(arguments, cell, settings.scatter)
        elif arguments.model == "world":
            world = _simulated(arguments, cell)
        if arguments.table:
            objective = objective or cell.file.goal.objective
            clock = functools.partial(_arm_times, arguments.cell, arguments.object, arguments.truth)
            space = functools.partial(_cell_space, arguments.cell, arguments.object)
    if arguments.model == "abstract" and (arguments.round_position or arguments.round_angle):
        raise PlanningError("--round-position and --round-angle need --model physics or world")
    if arguments.model != "physics" and arguments.true_friction is not None:
        raise PlanningError("--true-friction needs --model physics")
    tasks = arguments.random_tasks
    if tasks is not None and len(tasks) not in (0, 2):
        raise PlanningError(
            f"--random-tasks takes no values or two values (mm, degrees), not {len(tasks)}"
        )
    if tasks == []:
        tasks = LARGE_TASKS if arguments.table else DEFAULT_TASKS
    x, y, theta = arguments.goal
    if (
        tasks is None
        and math.hypot(x, y) <= arguments.tolerance[0]
        and (abs(theta) <= arguments.tolerance[1])
    ):
        raise PlanningError(
            f"--goal {x:g} {y:g} {theta:g} (mm, mm, degrees) is within --tolerance of the start, "
            "so that no tap is needed; if it is in m and rad, write "
            f"{1e3 * x:g} {1e3 * y:g} {math.degrees(theta):.4g}"
        )
    unknown = _unknown(arguments.unknown)
    return Evaluation(
        planner=planner,
        settings=settings,
        trials=arguments.trials,
        goal=(1e-3 * x, 1e-3 * y, math.radians(theta)),
        random_tasks=None if tasks is None else si_pair(tasks),
        world=world,
        gain_bias=(arguments.gain_bias[0] / 100.0, arguments.gain_bias[1] / 100.0),
        unknown=(unknown["friction"], unknown["rotation"]),
        torque_factor=unknown["torque_factor"],
        track=_track(arguments),
        off_centre=1e3 * math.radians(arguments.off_centre),
        adapt=arguments.adapt,
        probe=arguments.probe,
        seed=arguments.seed,
        most_taps=arguments.most_taps,
        space=space,
        objective=objective or "taps",
        clock=clock,
        mean_tap=math.nan if times is None else times.mean_tap,
    )


def _unknown(words: list[str]) -> dict[str, float]:
    """Return the factors of --unknown by name. Raises PlanningError for anything else."""
    factors = {"friction": 1.0, "rotation": 1.0, "torque_factor": 1.0}
    if len(words) == 2 and not any("=" in word for word in words):
        words = [f"friction={words[0]}", f"rotation={words[1]}"]
    for word in words:
        name, _, factor = word.partition("=")
        try:
            value = float(factor)
        except ValueError:
            value = math.nan
        if name not in factors or not math.isfinite(value):
            raise PlanningError(
                f"--unknown {word}: give NAME=FACTOR with one of {', '.join(factors)}, such as "
                "friction=2"
            )
        factors[name] = value
    return factors


def _track(arguments: argparse.Namespace) -> float:
    """Return the rate of --track in Hz. Raises PlanningError for an invalid one."""
    words = {"off": 0.0, "truth": TRUTH}
    try:
        rate = words.get(arguments.track)
        rate = float(arguments.track) if rate is None else rate
    except ValueError:
        raise PlanningError(
            f"--track is {arguments.track}; give images per second, off or truth"
        ) from None
    shown = rate > 0.0 and arguments.model == "world" and arguments.table
    if rate and not shown and (arguments.model != "abstract" or arguments.table):
        raise PlanningError(
            "--track needs --model abstract without --table, or --model world with --table (a "
            "rate only): the other models have no motion in time"
        )
    return rate


def measure(arguments: argparse.Namespace, evaluation: Evaluation) -> dict[str, Any]:
    """Run one evaluation. Return the results, the inputs, and the number of trials per second."""
    return _measure(arguments, evaluation)[0]


def _measure(
    arguments: argparse.Namespace, evaluation: Evaluation
) -> tuple[dict[str, Any], Results]:
    began = time.perf_counter()
    planner = load_planner(evaluation.planner, evaluation.settings)
    solved = time.perf_counter() - began
    with progress(evaluation.planner, evaluation.trials) as note:
        began = time.perf_counter()
        results = evaluate(evaluation, arguments.processes, note)
        elapsed = time.perf_counter() - began
    planned = None
    if isinstance(planner, MultiPlanner) and evaluation.random_tasks is None:
        goal = evaluation.goal
        planned = int(planner.planned_taps(math.hypot(goal[0], goal[1]), goal[2]))
    figures = {"planner": evaluation.planner, **summarise(results, planned)}
    box = evaluation.settings.stopping
    figures["box"] = {
        "distance_mm": 1e3 * box.distance,
        "rotation_deg": math.degrees(box.rotation),
        "camera_suffices": box.camera_suffices,
    }
    figures["solving_s"] = solved
    figures["trials_per_second"] = evaluation.trials / elapsed
    figures["inputs"] = inputs_of(arguments, "sweep", "cluster")
    return figures, results


def _settings(arguments: argparse.Namespace) -> PlannerSettings:
    line = arguments.error_line
    position, angle = si_pair(arguments.tolerance)
    return PlannerSettings(
        scatter=scatter_of(arguments),
        camera=camera_of(arguments),
        tolerance_position=position,
        tolerance_angle=angle,
        box=arguments.box,
        variant=arguments.variant,
        error_line=None if line is None else line / 100.0,
    )


def _fitted(settings: PlannerSettings, tap: Tap) -> PlannerSettings:
    """Return the settings with the cone and the smallest tap of this tap's mechanics."""
    fitted = PlannerSettings.for_tap(tap, settings.camera)
    return replace(
        settings, cone_slope=fitted.cone_slope, smallest_distance=fitted.smallest_distance
    )


def _truth(path: Path | None) -> TruthFile:
    path = path or shared_folder() / "truth" / "default.yaml"
    return load(TruthFile, path.expanduser())


def _cell_space(cell: Path | None, content: Path | None) -> StrikeSpace:
    return make_strike_space(load_cell(cell, content))


def _arm_times(cell: Path | None, content: Path | None, truth: Path | None) -> ArmTimes:
    lens = _truth(truth).camera.position
    return ArmTimes(load_cell(cell, content), lens)


def _physics(arguments: argparse.Namespace, cell: Cell, scatter: Scatter) -> PhysicsWorld:
    truth = _truth(arguments.truth)
    known = cell.object
    if arguments.truth_object is not None:
        known = load_object(arguments.truth_object.expanduser())
        if known.shape != cell.object.shape or known.mass != cell.object.mass:
            raise ConfigurationError(
                f"{arguments.truth_object}: shape or mass differs from that of the planner's "
                "object; give files of the same object"
            )
    actual = replace(
        known,
        friction=known.friction * truth.support.friction_factor,
        torque_factor=known.torque_factor * truth.support.torque_factor_ratio,
        restitution=min(1.0, known.restitution * truth.impact.restitution_factor),
        contact_friction=known.contact_friction * truth.impact.contact_friction_factor,
    )
    if arguments.true_friction is not None:
        if not 0.0 < arguments.true_friction <= 2.0:
            raise PlanningError(
                f"the true friction is {arguments.true_friction:g}; it must be above 0 and at "
                "most 2"
            )
        actual = replace(actual, friction=arguments.true_friction)
    model, answers = make_tap(cell), actual.tap(cell.file.tapper.striker())
    return PhysicsWorld(
        model=replace(model, sliding=model.sliding.tabulated(), smallest_distance=0.0),
        truth=replace(answers, sliding=answers.sliding.tabulated()),
        scatter=scatter,
        standoff=cell.file.tapper.standoff,
        round_position=1e-3 * arguments.round_position,
        round_angle=math.radians(arguments.round_angle),
        speed_factor=truth.impact.striker_speed_factor,
    )


def _simulated(arguments: argparse.Namespace, cell: Cell) -> World:
    content = cell.object
    if arguments.truth_object is not None:
        content = load_object(arguments.truth_object.expanduser())
    return SimulatedTaps(
        model=replace(make_tap(cell), smallest_distance=0.0),
        content=content,
        truth=_truth(arguments.truth),
        standoff=cell.file.tapper.standoff,
        round_position=1e-3 * arguments.round_position,
        round_angle=math.radians(arguments.round_angle),
    )


def _text(planner: str, figures: dict[str, Any]) -> str:
    taps, box = figures["taps"], figures["box"]
    lines = [
        f"{planner}: {figures['trials']} trials, {figures['trials_per_second']:.0f} per second",
        f"  taps              mean {taps['mean']:.3f} "
        f"(95 % interval {taps['mean_interval'][0]:.3f} to {taps['mean_interval'][1]:.3f})",
        f"                    median {taps['p50']}, 90 % within {taps['p90']}, "
        f"99 % within {taps['p99']}, maximum {taps['max']}",
        *_seconds_text(figures),
        f"  done              {share_text(figures['done'], figures['trials'])} of all trials",
        f"  truly inside      {share_text(figures['truly_inside'], figures['done'])} of the trials "
        "done",
        f"  stopping box      {box['distance_mm']:.3f} mm, {box['rotation_deg']:.3f} degrees",
        "  assumed scatter   {:g} % of the distance, {:g} % of the rotation, {:g} degrees".format(
            *figures["inputs"]["scatter"]
        ),
    ]
    if not box["camera_suffices"]:
        lines.append(
            "  the camera noise is too large for this tolerance, so a reached goal is often not "
            "confirmed"
        )
    if "planned_taps" in figures:
        lines.append(
            f"  as planned        {100 * figures['within_planned_rate']:.2f} % of all trials were "
            f"done within the planned {figures['planned_taps']} taps"
        )
    for key, label in (
        ("refused_before", "refused early"),
        ("refused_later", "refused later"),
        ("over_edge", "over the edge"),
        ("endless", "endless"),
    ):
        if figures[key]:
            lines.append(f"  {label:<17} {figures[key]}")
    return "\n".join(lines)


def _seconds_text(figures: dict[str, Any]) -> list[str]:
    seconds = figures.get("seconds")
    if seconds is None:
        return []
    if not figures["inputs"].get("table"):
        per_tap = seconds["mean"] / figures["taps"]["mean"] if figures["taps"]["mean"] else 0.0
        return [
            f"  seconds           mean {seconds['mean']:.2f}: {per_tap:.2f} s for each tap, the "
            "mean of the cell"
        ]
    low, high = seconds["mean_interval"]
    return [
        f"  seconds           mean {seconds['mean']:.2f} (95 % interval {low:.2f} to {high:.2f}), "
        f"90 % within {seconds['p90']:.1f}"
    ]


def _sweep(arguments: argparse.Namespace) -> int:
    from tapping_cell.report.sweep import sweep_table, write_sweep
    from tapping_cell.report.tables import TRIALS

    if arguments.report is None or arguments.all:
        raise PlanningError("--sweep needs a folder for its report: give --report DIR; omit --all")
    points = list(sweep.grid(sweep.read_axes(arguments.sweep)))
    for point in points:
        # Check every point now, so that an error is reported before the first trial.
        chosen = sweep.arguments_at(arguments, point)
        make_evaluation(chosen, chosen.planner)
    # Points of version 1, which has no key, lack the trials.
    common = {**inputs_of(arguments, "sweep", "cluster"), "version": 2}
    kept = sweep.KeptPoints(arguments.report, common)
    with progress("sweep", len(points)) as advance:
        try:
            rows = sweep.sweep(
                points,
                kept,
                functools.partial(_measure_point, arguments),
                arguments.processes,
                advance,
                sweep.cluster_executor(arguments.cluster) if arguments.cluster else None,
            )
        except KeyboardInterrupt:
            done = sum(kept.get(point) is not None for point in points)
            print(
                f"interrupted: {done} of {len(points)} points are kept in {arguments.report}; "
                "the same command continues from there",
                file=sys.stderr,
            )
            raise
    write_sweep(arguments.report, rows, [figures.pop(TRIALS) for _, figures in rows])
    if arguments.json:
        print(json.dumps([{"point": point, "figures": figures} for point, figures in rows]))
    else:
        print(sweep_table(rows))
        print(f"report in {arguments.report}")
    return 0


def _measure_point(arguments: argparse.Namespace, point: sweep.Point) -> dict[str, Any]:
    """Evaluate one point of a sweep in a separate process."""
    from tapping_cell.report.tables import TRIALS, trial_columns

    chosen = sweep.arguments_at(arguments, point)
    # Use one process, because the points are evaluated in parallel. The option json suppresses the
    # progress bar of the point, because the sweep shows a progress bar of its own.
    chosen.processes, chosen.json = 1, True
    figures, results = _measure(chosen, make_evaluation(chosen, chosen.planner))
    return {**figures, TRIALS: trial_columns(results)}


def _compare(arguments: argparse.Namespace) -> int:
    from tapping_cell.report.planning_comparison import comparison_table, methods, write_comparison

    compared = methods(arguments.planner)
    rows: dict[str, dict[str, Any]] = {}
    trials = {}
    for method in compared:
        chosen = argparse.Namespace(**vars(arguments))
        chosen.planner = method.planner
        chosen.variant = method.variant
        chosen.error_line = method.error_line
        label = method.label
        rows[label], trials[label] = _measure(chosen, make_evaluation(chosen, method.planner))
    reference = next(
        method.label for method in reversed(compared) if method.planner == arguments.planner
    )
    for label, figures in rows.items():
        # Every method has the same tasks and the same true gains in the same order of trials.
        more = trials[label].taps - trials[reference].taps
        figures["more_taps"] = {"than": reference, **mean_of(more)}
    if arguments.report is not None:
        write_comparison(
            arguments.report, rows, trials, _settings(arguments), tuple(arguments.goal), compared
        )
    if arguments.json:
        print(json.dumps(rows, indent=2))
    else:
        print(comparison_table(rows))
        if arguments.report is not None:
            print(f"report in {arguments.report}")
    return 0


def _arrange(arguments: argparse.Namespace) -> int:
    """Evaluate scenes of several objects. With ``--all``, evaluate the built-in planner and the
    baselines."""
    names = list(arrangements.METHODS) if arguments.all else [arguments.method]
    if arguments.unknown or _track(arguments):
        raise PlanningError("--arrange does not simulate --unknown or --track; leave them out")
    figures, scenes = {}, {}
    for name in names:
        task = arrangements.ArrangementTask(
            arguments.arrange,
            arguments.goals,
            gap=1e-3 * arguments.gap,
            gain_bias=(arguments.gain_bias[0] / 100.0, arguments.gain_bias[1] / 100.0),
            method=name,
            adapt=arguments.adapt,
            most_taps=arguments.most_taps,
        )
        kinds = functools.partial(arrangement_kinds, arguments)
        trials = arrangements.evaluate_arrangements(
            task, kinds, arguments.trials, arguments.seed, arguments.processes
        )
        figures[name] = arrangements.summarise_arrangements(trials)
        scenes[name] = trials
    if arguments.report is not None:
        from tapping_cell.report.arrangement_figures import draw_scenes
        from tapping_cell.report.tables import SCENES, write_scenes

        draw_scenes(arguments.report, scenes[names[0]])
        write_scenes(arguments.report / SCENES, scenes)
    if arguments.json:
        print(
            json.dumps(
                {"methods": figures, "inputs": inputs_of(arguments, "sweep", "cluster")}, indent=2
            )
        )
    else:
        for name, found in figures.items():
            print(_arrangement_text(name, found))
    return 0


def arrangement_kinds(arguments: argparse.Namespace) -> list[arrangements.Kind]:
    """Return one ``Kind`` for each shape of object. It contains a free space and a planner. Table
    and arm are those of the cell, and the friction is that of the object file."""
    cell = load_cell(arguments.cell, arguments.object)
    wanted = _settings(arguments)
    kinds = []
    for content in _shapes(cell.object, arguments):
        made = replace(cell, object=content)
        planner = make_planner(arguments.planner, _fitted(wanted, make_tap(made)))
        kinds.append(arrangements.Kind(FreeSpace(make_strike_space(made)), planner))
    return kinds


def _shapes(content: ObjectFile, arguments: argparse.Namespace) -> list[ObjectFile]:
    """Return variants of the given object, of its density: disks and squares of the requested
    sizes."""
    radii = [1e-3 * radius for radius in arguments.radius]
    if arguments.goals == "grid":
        radii = radii[:1]
    shapes = []
    for radius in radii:
        shapes.append(replace(content.shape, kind="disk", radius=radius, vertices=None))
        if arguments.goals != "grid":
            corner = radius / math.sqrt(2.0)
            corners = ((corner, corner), (-corner, corner), (-corner, -corner), (corner, -corner))
            shapes.append(replace(content.shape, kind="polygon", radius=None, vertices=corners))
    share = content.mass / area_of(content.shape)
    return [replace(content, shape=shape, mass=share * area_of(shape)) for shape in shapes]


def _arrangement_text(method: str, figures: dict[str, Any]) -> str:
    scenes = figures["scenes"]
    lines = [
        f"{method}: {scenes} scenes",
        f"  all truly inside    {100 * figures['success_rate']:.1f} % of the scenes, "
        f"wrongly reported as reached in {figures['false_claims']} scenes",
        f"  contacts            between objects in {figures['scenes_with_contact']} scenes, "
        f"with the tool in {figures['scenes_with_tool_contact']}",
        f"  taps                mean {figures['taps_mean']:.2f} per scene done, "
        f"{figures['price_of_others']:.2f} times as many as for each object alone on the table",
        f"  moved out of way    mean {figures['made_way_mean']:.2f} moves per scene",
        f"  time of a decision  mean {figures['decision_mean_s']:.3f} s, slowest "
        f"{figures['decision_slowest_s']:.2f} s",
        f"  refused             early {figures['refused_before']}, "
        f"later {figures['refused_later']}",
    ]
    lines += [f"    {count} x {text}" for text, count in list(figures["reasons"].items())[:5]]
    return "\n".join(lines)
