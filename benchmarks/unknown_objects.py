"""Objects without a file: values learnt from nine goals, and number of taps of further goals.

Ten simulated objects are chosen at random: disks, rings and polygons, with friction 0.05 to 0.6,
torque factor 0.8 to 4, and random restitution, contact friction and density. Each object starts
with the file that the verb `object new` makes from its true shape and height. Nine goals are run,
during which the planner learns from each tap, and `object learn` makes a new file from these taps.
Then further goals are run with the learnt file and with the true file, using the same random
numbers. The planner's observations have noise of 0.05 mm and 0.05 degrees; `object learn` receives
the exact displacements.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tapping_cell.calibration.learnt_object import LearntObject, learn_object
from tapping_cell.calibration.new_object import new_object
from tapping_cell.configuration.assembly import make_planner_settings
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.objects import MarkerSection, ObjectFile, ShapeSection
from tapping_cell.mechanics.planar import turn
from tapping_cell.planning import CameraNoise
from tapping_cell.planning.evaluation import Evaluation, evaluate, summarise
from tapping_cell.se2 import Array
from tapping_cell.simulation.tap_trials import SimulatedTaps
from tapping_cell.simulation.truth import ScatterTruth, TruthFile

DEFAULT_COUNT = 100
"""Number of goals per object with each of the two files."""

OBJECTS = 10
GOALS = 9
TASKS = (0.040, math.radians(20.0))
CAMERA = CameraNoise(0.00005, math.radians(0.05))
TOLERANCE = (0.001, math.radians(1.0))
TRUTH = TruthFile((0.0, 0.0, 0.0), scatter=ScatterTruth(0.025, 0.15, math.radians(1.0)))
MARKER = MarkerSection("APRILTAG_36h11", 7, 0.012)


@dataclass(slots=True)
class Recorded:
    """A world that records commanded and measured taps, in the object's frame before the tap."""

    world: SimulatedTaps
    commanded: list[Array] = field(default_factory=list)
    measured: list[Array] = field(default_factory=list)

    @property
    def model(self) -> Any:
        """The mechanics with which the planner computes taps."""
        return self.world.model

    def answer(
        self, poses: Array, seen: Array, commanded: Array, gains: Array, rng: np.random.Generator
    ) -> Array:
        """Return the displacements (n, 3) of the object in the world, and record the taps."""
        moved = self.world.answer(poses, seen, commanded, gains, rng)
        self.commanded.append(turn(commanded, -seen[:, 2]))
        self.measured.append(turn(moved, -seen[:, 2]))
        return moved


def drawn_object(seed: int) -> tuple[ObjectFile, ObjectFile]:
    """Choose a random object; return its true file and its initial file."""
    random = np.random.default_rng(seed)

    def between(low: float, high: float) -> float:
        return float(np.exp(random.uniform(math.log(low), math.log(high))))

    kind = ("disk", "ring", "polygon")[seed % 3]
    size = float(random.uniform(0.03, 0.06))
    if kind == "polygon":
        corners = int(random.integers(3, 7))
        angles = np.arange(corners) * 2 * math.pi / corners
        angles += random.uniform(-0.8, 0.8, corners) / corners
        points = size * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        shape = ShapeSection(kind, vertices=tuple((float(x), float(y)) for x, y in points))
    else:
        shape = ShapeSection(kind, radius=size)
    begun = new_object(f"object {seed}", shape, 0.012, MARKER, None)
    true = replace(
        begun,
        mass=begun.mass * between(0.5, 2.0),
        friction=between(0.05, 0.6),
        torque_factor=between(0.8, 4.0),
        restitution=float(random.uniform(0.4, 0.9)),
        contact_friction=float(random.uniform(0.1, 0.35)),
    )
    return true, begun


def learnt_from_goals(true: ObjectFile, begun: ObjectFile, seed: int) -> LearntObject:
    """Return what was learnt from nine goals, starting with the initial file ``begun``."""
    evaluation, world = _evaluation(true, begun, GOALS)
    evaluate(evaluation, seed)
    return learn_object(begun, np.concatenate(world.commanded), np.concatenate(world.measured))


def _evaluation(true: ObjectFile, assumed: ObjectFile, goals: int) -> tuple[Evaluation, Recorded]:
    cell = replace(load_cell(), object=assumed)
    tap = assumed.tap(cell.file.tapper.striker())
    model = replace(tap, smallest_distance=0.0)
    world = Recorded(SimulatedTaps(model, true, TRUTH, cell.file.tapper.standoff))
    settings = make_planner_settings(cell, TOLERANCE, camera=CAMERA)
    made = Evaluation(
        planner="optimal",
        settings=settings,
        trials=goals,
        random_tasks=TASKS,
        world=world,
        adapt=True,
        most_taps=30,
    )
    return made, world


def measure(count: int) -> dict[str, Any]:
    """Return the learnt values and the taps of further goals with both files for each object."""
    report: dict[str, Any] = {}
    for seed in range(OBJECTS):
        true, begun = drawn_object(seed)
        learnt = learnt_from_goals(true, begun, 100 + seed)
        taps = {}
        for name, assumed in (("begun", begun), ("learnt", learnt.content), ("true", true)):
            summary = summarise(evaluate(_evaluation(true, assumed, count)[0], 200 + seed))
            taps[name] = summary["taps"]["mean"]
        report[f"object {seed} ({true.shape.kind})"] = {
            **{
                entry.name: {
                    "true": getattr(true, entry.name),
                    "learnt": entry.value,
                    "low": entry.low,
                    "high": entry.high,
                }
                for entry in learnt.estimates
                if entry.name in ("friction", "torque_factor")
            },
            "taps": taps,
        }
    rows = [row["taps"] for row in report.values()]
    report["mean"] = {
        name: float(np.mean([row[name] for row in rows])) for name in ("begun", "learnt", "true")
    }
    return report


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = []
    for name, row in report.items():
        taps = row if name == "mean" else row["taps"]
        sentence = (
            f"taps {taps['learnt']:.2f} with the learnt file, {taps['true']:.2f} with the true "
            f"one ({100 * (taps['learnt'] / taps['true'] - 1):+.0f} %), {taps['begun']:.2f} with "
            "that of object new"
        )
        if name != "mean":
            sentence += "".join(
                f"; {word} {row[key]['learnt']:.3g}, 95 % {row[key]['low']:.3g} to "
                f"{row[key]['high']:.3g} ({row[key]['true']:.3g} true)"
                for key, word in (("friction", "friction"), ("torque_factor", "torque factor"))
            )
        text.append(f"{name}: {sentence}")
    return text
