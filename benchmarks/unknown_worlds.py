"""Goals in simulated worlds that differ from the planner's files, with learning from each tap.

The worlds are those of ``config/truth`` and random variations of ``everything.yaml``. A random
world has all effects of ``everything.yaml`` at once, each with a random size up to the value in
that file. The friction and the torque factor of a random world differ from the planner's values by
up to a given ratio. Each goal is up to 40 mm and 20 degrees away from the object, which starts
anywhere on the cell's table. At the start of a goal, the planner has only the object's file.
Observations of the object have noise of 0.05 mm and 0.05 degrees.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from tapping_cell.configuration.assembly import make_strike_space, make_tap
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import load
from tapping_cell.planning import CameraNoise, PlannerSettings, make_planner
from tapping_cell.planning.evaluation import Evaluation, Results, summarise
from tapping_cell.planning.evaluation.on_table import run_table_trials
from tapping_cell.planning.evaluation.parallel import join
from tapping_cell.planning.evaluation.task import End
from tapping_cell.simulation.tap_trials import SimulatedTaps
from tapping_cell.simulation.truth import PatchTruth, TruthFile

DEFAULT_COUNT = 2000
"""Number of goals in the random worlds that differ most. Each other group of random worlds has a
quarter of this number, and the shipped worlds have half of it together."""

GOALS_A_WORLD = 10
TASKS = (0.040, math.radians(20.0))
CAMERA = CameraNoise(0.00005, math.radians(0.05))
SPREADS = {"within 4 and 2.5": (4.0, 2.5), "within 2": (2.0, 2.0), "as the file": (1.0, 1.0)}
"""For each group of random worlds, the largest ratio of true to configured friction, and the
largest ratio of true to configured torque factor. Each ratio is drawn log-uniformly between the
inverse of its largest value and this value. In the last group both ratios are 1, so this group
shows how many additional taps are due to all effects other than friction and torque factor."""


def shipped_worlds() -> dict[str, TruthFile]:
    """Load the worlds of ``config/truth``."""
    folder = shared_folder() / "truth"
    return {path.stem: load(TruthFile, path) for path in sorted(folder.glob("*.yaml"))}


def drawn_world(spread: tuple[float, float], rng: np.random.Generator) -> TruthFile:
    """Return a random world with all effects of ``everything.yaml``, with random sizes and
    directions."""
    base = load(TruthFile, shared_folder() / "truth" / "everything.yaml")

    def part(value: float) -> float:
        return float(rng.uniform(0.0, 1.0)) * value

    def around(value: float) -> float:
        return 1.0 + float(rng.uniform(-1.0, 1.0)) * (value - 1.0)

    def turned(pair: tuple[float, float]) -> tuple[float, float]:
        size, angle = part(math.hypot(*pair)), float(rng.uniform(-math.pi, math.pi))
        return size * math.cos(angle), size * math.sin(angle)

    support, surface, impact = base.support, base.surface, base.impact
    return replace(
        base,
        support=replace(
            support,
            friction_factor=float(spread[0] ** rng.uniform(-1.0, 1.0)),
            torque_factor_ratio=float(spread[1] ** rng.uniform(-1.0, 1.0)),
            pressure=str(rng.choice(["even", "rim", "three_points", "pads"])),
            feet_turn=float(rng.uniform(-math.pi, math.pi)),
            pad_seed=int(rng.integers(1, 1000)),
            edge_weight=part(support.edge_weight),
            lean=turned(support.lean),
            mass_offset=turned(support.mass_offset),
            inertia_factor=around(support.inertia_factor),
            slope=turned(support.slope),
        ),
        surface=replace(
            surface,
            anisotropy=1.0 + part(surface.anisotropy - 1.0),
            grain=float(rng.uniform(-math.pi, math.pi)),
            slow_rise=part(surface.slow_rise),
            viscous=part(surface.viscous),
            patches=tuple(
                PatchTruth(
                    (float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-0.15, 0.15))),
                    patch.radius,
                    around(patch.factor),
                )
                for patch in surface.patches
            ),
        ),
        impact=replace(
            impact,
            restitution_factor=around(impact.restitution_factor),
            contact_friction_factor=around(impact.contact_friction_factor),
            striker_speed_factor=around(impact.striker_speed_factor),
            contact_time=0.0002 + part(0.0003),
            tangential_stiffness=part(impact.tangential_stiffness),
            oblique_loss=part(impact.oblique_loss),
        ),
    )


def run_world(
    truth: TruthFile, goals: int, seed: int, probe: bool = False, track: float = 0.0
) -> Results:
    """Run goals in one world. Before each goal, the planner forgets what it has learnt. ``track``:
    images per second of a camera that follows the slides; 0 for none."""
    cell = load_cell()
    tap = make_tap(cell)
    settings = PlannerSettings.for_tap(tap, CAMERA)
    evaluation = Evaluation(
        planner="optimal",
        settings=settings,
        trials=goals,
        random_tasks=TASKS,
        world=SimulatedTaps(
            replace(tap, smallest_distance=0.0), cell.object, truth, cell.file.tapper.standoff
        ),
        adapt=True,
        probe=probe,
        track=track,
        most_taps=30,
        space=_space,
    )
    planner = make_planner(evaluation.planner, settings)
    return run_table_trials(evaluation, planner, goals, np.random.default_rng(seed))


@functools.cache
def _space() -> Any:
    return make_strike_space(load_cell())


def drawn_results(spread: tuple[float, float], first: int, worlds: int) -> Results:
    """Run goals in the random worlds with the numbers ``first`` to ``first + worlds - 1``."""
    return join(
        [
            run_world(drawn_world(spread, np.random.default_rng(seed)), GOALS_A_WORLD, seed)
            for seed in range(first, first + worlds)
        ]
    )


def figures(results: Results) -> dict[str, Any]:
    """Summarise a group. Count the goals that were reached, and the goals that were reported as
    reached but were not."""
    done = results.end == End.DONE
    return {
        **summarise(results),
        "false_claims": int(np.sum(done & ~results.inside)),
        "reached": int(np.sum(done)),
    }


def partial_reports(count: int) -> Iterator[dict[str, Any]]:
    """Yield the results so far after every group."""
    report: dict[str, Any] = {}
    for number, (name, spread) in enumerate(SPREADS.items()):
        goals = count if number == 0 else count // 4
        report[name] = figures(drawn_results(spread, 0, max(1, goals // GOALS_A_WORLD)))
        yield report
    shipped = shipped_worlds()
    goals = max(1, count // 2 // len(shipped))
    for seed, (name, truth) in enumerate(shipped.items()):
        report[name] = figures(run_world(truth, goals, seed))
    yield report


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = []
    for name, row in report.items():
        taps = row["taps"]
        text.append(
            f"{name:<24} {row['trials']} goals: {row['reached']} reached, "
            f"{row['refused_before']} refused before the first tap, {row['refused_later']} later, "
            f"{row['endless']} endless; {row['false_claims']} false claims, "
            f"{row['over_edge']} over the edge; taps mean {taps['mean']:.2f}, "
            f"most {taps.get('max', 0)}"
        )
    return text
