"""Trials with several objects on one table: random scenes with ground truth.

Objects slide in straight lines, as tapped objects do (see ``docs/mechanics.md``, section Sliding).
If an object hits another object, the impact is inelastic: along the normal, both continue with the
velocity of their common centre of mass, and each slides a distance proportional to the square of
its speed. A trial counts every such impact, and every strike in which the tool would have touched
another object.
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any

import numpy as np

from tapping_cell.mechanics import Polygon
from tapping_cell.planning.arrangement import (
    AllDone,
    AmongOthers,
    ArrangementPlanner,
    ArrangementSession,
    Body,
    FileOrder,
    NearestFirst,
    Observation,
    ObserveLonger,
    SequencePlanner,
    TapOf,
    middle_of,
    preset_places,
)
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.evaluation.worlds import scattered
from tapping_cell.planning.free_space import FreeSpace
from tapping_cell.planning.interface import Array, Planner
from tapping_cell.planning.refusal import Refusal
from tapping_cell.planning.stopping import LONG_OBSERVATION
from tapping_cell.planning.workspace import CircleArea, KeepOut, PolygonArea
from tapping_cell.se2 import Pose, difference, displaced, transform_points

METHODS: dict[str, Callable[[AmongOthers], ArrangementPlanner]] = {
    "sequence": SequencePlanner,
    "file order": FileOrder,
    "nearest first": NearestFirst,
}
"""Arrangement planners by name: the built-in planner and the baselines."""

GOALS = ("random", "swap", "grid")

START_GAP = 0.040
DRAWS = 4000
SWEEP = 25
"""Number of points of a slide at which contacts are checked."""


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """A kind of object: map of its tappable places on the empty table, and the method that chooses
    its taps."""

    free: FreeSpace
    planner: Planner


@dataclass(frozen=True, slots=True)
class ArrangementTask:
    """Parameters of random scenes. Lengths in m, angles in rad.

    count: number of objects. goals: one of ``GOALS``. grid_gap: gap between neighbours in a grid of
    goals. gap: minimum gap between two starts and between two random goals.
    gain_bias: systematic errors of distance and rotation of each object, as shares with random
    signs. method: one of ``METHODS``. adapt: learn from taps.
    """

    count: int
    goals: str = "random"
    grid_gap: float = 0.040
    gap: float = START_GAP
    gain_bias: tuple[float, float] = (0.0, 0.0)
    method: str = "sequence"
    adapt: bool = True
    most_taps: int = 60

    def __post_init__(self) -> None:
        """Reject unknown or invalid parameters (PlanningError)."""
        if self.goals not in GOALS:
            raise PlanningError(f"goals are {self.goals!r}, allowed: {', '.join(GOALS)}")
        if self.method not in METHODS:
            raise PlanningError(f"method is {self.method!r}, allowed: {', '.join(METHODS)}")
        if not 1 <= self.count <= 20:
            raise PlanningError(f"the number of objects is {self.count}, allowed: 1 to 20")


@dataclass(slots=True)
class ArrangementTrial:
    """Result of one scene.

    end: "done", "refused before" (the first tap) or "refused later". inside: whether every true
    pose is within its tolerance. taps: total number of taps; lone_taps: total number of taps for
    the same objects if each is alone on the table. contacts: number of contacts between objects;
    tool_contacts: number of strikes in which the tool would have touched another object. made_way:
    number of moves out of the way. slowest, planning: processor time of the longest decision and of
    all decisions, s. history: true poses before the first tap and after every tap. For drawings:
    goals; outlines, (n, 2), in the objects' frames; table, length and width of the table.
    """

    end: str = "refused later"
    inside: bool = False
    taps: int = 0
    lone_taps: int = 0
    contacts: int = 0
    tool_contacts: int = 0
    made_way: int = 0
    slowest: float = 0.0
    planning: float = 0.0
    decisions: int = 0
    sentence: str = ""
    history: list[dict[str, Pose]] = field(default_factory=list)
    goals: dict[str, Pose] = field(default_factory=dict)
    outlines: dict[str, Array] = field(default_factory=dict)
    table: tuple[float, float] = (0.0, 0.0)


def run_arrangement(
    task: ArrangementTask, kinds: Sequence[Kind], rng: np.random.Generator
) -> tuple[ArrangementTrial, list[Body]]:
    """Draw one scene and run it; return the trial and its objects."""
    bodies, poses = draw_scene(task, kinds, rng)
    gains = _draw_gains(task, rng)
    trial = arrange(task, bodies, poses, gains, rng)
    for number, body in enumerate(bodies):
        alone = ArrangementTask(1, adapt=task.adapt, most_taps=task.most_taps)
        lone = arrange(alone, [body], poses, gains[number : number + 1], rng)
        trial.lone_taps += lone.taps
    return trial, bodies


def draw_scene(
    task: ArrangementTask, kinds: Sequence[Kind], rng: np.random.Generator
) -> tuple[list[Body], dict[str, Pose]]:
    """Draw objects of random kinds with their goals and start poses.

    At every pose the object could be tapped if it were alone; layouts that cannot be reached are
    not filtered out.
    """
    for _ in range(100):
        chosen = [kinds[int(index)] for index in rng.integers(len(kinds), size=task.count)]
        starts = draw_places(chosen, task.gap, rng)
        if starts is None:
            continue
        if task.goals == "random":
            goals = draw_places(chosen, task.gap, rng)
        elif task.goals == "swap":
            goals = swapped_goals(starts, rng)
            if not all(_tappable(k, g) for k, g in zip(chosen, goals, strict=True)):
                continue
        else:
            goals = _grid(chosen, task.grid_gap)
        if goals is None:
            continue
        names = [f"object {number + 1}" for number in range(task.count)]
        bodies = [
            Body(name, kind.free, kind.planner, goal)
            for name, kind, goal in zip(names, chosen, goals, strict=True)
        ]
        return bodies, dict(zip(names, starts, strict=True))
    raise PlanningError(
        f"{task.count} objects with gaps of {1e3 * task.gap:.0f} mm do not fit on the table; use "
        "fewer or smaller objects"
    )


def arrange(
    task: ArrangementTask,
    bodies: Sequence[Body],
    starts: Mapping[str, Pose],
    gains: Array,
    rng: np.random.Generator,
) -> ArrangementTrial:
    """Run a trial from these start poses; ``gains``: true gains of the objects (see
    ``_draw_gains``)."""
    maps = AmongOthers()
    limit = task.most_taps * len(bodies)
    session = ArrangementSession(
        bodies, METHODS[task.method](maps), adapt=task.adapt, most_taps=limit, maps=maps
    )
    true = {body.name: np.array(starts[body.name]) for body in bodies}
    table = bodies[0].free.space.workspace
    trial = ArrangementTrial(
        goals={body.name: body.goal for body in bodies if body.goal is not None},
        outlines={body.name: body.free.space.outline for body in bodies},
        table=(table.length, table.width),
    )
    trial.history.append({name: Pose(*pose.tolist()) for name, pose in true.items()})
    gain_of = {body.name: gains[number, None] for number, body in enumerate(bodies)}
    by_name = {body.name: body for body in bodies}
    seen = {name: _observe(by_name[name], true[name], rng) for name in true}
    observations = dict.fromkeys(true, 1)
    last_move = None
    while True:
        began = time.thread_time()
        decision = session.decide(seen, observe_again=max(observations.values()) < LONG_OBSERVATION)
        spent = time.thread_time() - began
        trial.decisions += 1
        trial.slowest, trial.planning = max(trial.slowest, spent), trial.planning + spent
        if isinstance(decision, ObserveLonger):
            name = decision.name
            observations[name] += 1
            seen[name] = _longer(by_name[name], seen[name], true[name], observations[name], rng)
            continue
        if not isinstance(decision, TapOf):
            break
        if decision.move is not last_move:
            last_move = decision.move
            trial.made_way += decision.move.purpose.name == "MAKE_WAY"
        body = by_name[decision.name]
        trial.tool_contacts += _tool_touches(decision, bodies, true)
        commanded = np.array([decision.strike.commanded])
        scatter = body.planner.settings.scatter
        moved = scattered(commanded, gain_of[body.name], true[body.name][None, :], scatter, rng)[0]
        trial.contacts += _slide(body, moved, bodies, true)
        trial.taps += 1
        before = seen[body.name]
        seen = {name: _observe(by_name[name], true[name], rng) for name in true}
        observations = dict.fromkeys(true, 1)
        session.observe(decision, before, seen[body.name])
        trial.history.append({name: Pose(*pose.tolist()) for name, pose in true.items()})
    if isinstance(decision, AllDone):
        trial.end = "done"
    else:
        assert isinstance(decision, Refusal)
        trial.end = "refused before" if trial.taps == 0 else "refused later"
        trial.sentence = decision.sentence
    trial.inside = all(body.is_at_goal(Pose(*true[body.name].tolist())) for body in bodies)
    return trial


def shape_at(body: Body, pose: Array) -> KeepOut:
    """Return the true shape of an object at a pose: a circle or the polygon of its corners."""
    solid = body.free.space.tap.body
    if not isinstance(solid, Polygon):
        return CircleArea(float(pose[0]), float(pose[1]), body.radius)
    corners = transform_points(pose, np.asarray(solid.points))
    return PolygonArea(tuple((float(x), float(y)) for x, y in corners))


def _slide(body: Body, moved: Array, bodies: Sequence[Body], true: dict[str, Array]) -> int:
    """Slide an object by ``moved``, push the objects that it hits, and return the number of
    contacts."""
    path = true[body.name] + np.linspace(0.0, 1.0, SWEEP)[:, None] * moved
    outlines = np.stack([transform_points(pose, body.free.space.outline) for pose in path])
    first, met = SWEEP, None
    for other in bodies:
        if other is body:
            continue
        distance = shape_at(other, true[other.name]).distance(outlines).min(axis=-1)
        hits = np.flatnonzero(distance < 0.0)
        if hits.size and hits[0] < first:
            first, met = int(hits[0]), other
    if met is None:
        true[body.name] = displaced(path[-1], np.zeros(3))
        return 0
    contact = path[max(first - 1, 0)]
    true[body.name] = displaced(contact, np.zeros(3))
    normal = true[met.name][:2] - contact[:2]
    normal = normal / max(float(np.hypot(*normal)), 1e-9)
    length = float(np.hypot(moved[0], moved[1]))
    left = length * (1.0 - (max(first - 1, 0)) / (SWEEP - 1))
    masses = [float(each.free.space.tap.body.mass) for each in (body, met)]
    share = masses[0] / sum(masses)
    along = float(moved[:2] @ normal) / max(length, 1e-9)
    push = left * (share * along) ** 2
    count = 1
    if push > 1e-5:
        count += _slide(met, np.array([*(push * normal), 0.0]), bodies, true)
        shift = np.array([*(min(push, left) * normal), 0.0])
        true[body.name] = displaced(true[body.name], 0.9 * shift)
    return count


def _tool_touches(tap: TapOf, bodies: Sequence[Body], true: Mapping[str, Array]) -> bool:
    """Return whether the tip or the tool's bar, at rest before the strike, overlaps another
    object."""
    by_name = {body.name: body for body in bodies}
    space = by_name[tap.name].free.space
    pose = np.array(tap.strike.plan.strike_pose)
    bar = space.tool_points(pose, count=24)
    for other in bodies:
        if other.name == tap.name:
            continue
        shape = shape_at(other, true[other.name])
        if float(shape.distance(bar).min()) < space.settings.tool_radius:
            return True
        if float(shape.distance(pose[:2])) < space.tip_radius:
            return True
    return False


def _observe(body: Body, true: Array, rng: np.random.Generator) -> Observation:
    camera = body.planner.settings.camera
    seen = true + camera.deviations * rng.standard_normal(3)
    return Observation(Pose(*seen.tolist()), camera.covariance)


def _longer(
    body: Body, seen: Observation, true: Array, observations: int, rng: np.random.Generator
) -> Observation:
    """Return the mean of all observations, including a new one."""
    step = difference(seen.pose, _observe(body, true, rng).pose)
    mean = np.array(seen.pose) + step / observations
    covariance = body.planner.settings.camera.covariance / observations
    return Observation(Pose(*mean.tolist()), covariance)


def _draw_gains(task: ArrangementTask, rng: np.random.Generator) -> Array:
    signs = rng.choice([-1.0, 1.0], size=(task.count, 2))
    gains = 1.0 + signs * np.asarray(task.gain_bias)
    return np.concatenate([gains, np.zeros((task.count, 2))], axis=1)


def draw_places(kinds: Sequence[Kind], least: float, rng: np.random.Generator) -> list[Pose] | None:
    """Draw a tappable pose for each object, with gaps of at least ``least`` m; None if none is
    found."""
    placed: list[tuple[Pose, float]] = []
    for kind in kinds:
        space = kind.free.space
        half = np.array([space.workspace.length, space.workspace.width]) / 2
        for _ in range(DRAWS // 10):
            x, y = rng.uniform(-half, half).tolist()
            pose = Pose(x, y, float(rng.uniform(-math.pi, math.pi)))
            near = any(
                pose.distance_to(other) < least + radius + space.object_radius
                for other, radius in placed
            )
            if not near and _tappable(kind, pose):
                placed.append((pose, space.object_radius))
                break
        else:
            return None
    return [pose for pose, _ in placed]


def swapped_goals(starts: Sequence[Pose], rng: np.random.Generator) -> list[Pose]:
    """Exchange the places of objects in pairs, with random angles; an unpaired last object stays at
    its place."""
    return [
        Pose(*starts[index ^ 1][:2], rng.uniform(-math.pi, math.pi))
        if index ^ 1 < len(starts)
        else start
        for index, start in enumerate(starts)
    ]


def _grid(kinds: Sequence[Kind], between: float) -> list[Pose]:
    """Return goals in a square grid about the middle of the tappable places, with gaps of
    ``between`` m."""
    radius = max(kind.free.space.object_radius for kind in kinds)
    pitch, middle = 2.0 * radius + between, middle_of(kinds[0].free)
    places = preset_places("grid", len(kinds), pitch, middle)
    return [Pose(float(x), float(y), 0.0) for x, y in places]


def _tappable(kind: Kind, pose: Pose) -> bool:
    return bool(kind.free.contains(np.array([pose.x, pose.y])))


def evaluate_arrangements(
    task: ArrangementTask,
    kinds: Callable[[], Sequence[Kind]],
    trials: int,
    seed: int,
    processes: int | None = None,
) -> list[ArrangementTrial]:
    """Run trials in parallel. The scene of trial i depends only on the seed and i, so that all
    methods get the same scenes."""
    seeds = np.random.SeedSequence(seed).spawn(trials)
    workers = min(processes or os.cpu_count() or 1, trials)
    if workers <= 1:
        return _run_share(task, kinds, seeds)
    shares = [seeds[start::workers] for start in range(workers)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        parts = list(pool.map(_run_share, [task] * workers, [kinds] * workers, shares))
    return [parts[index % workers][index // workers] for index in range(trials)]


def _run_share(
    task: ArrangementTask,
    kinds: Callable[[], Sequence[Kind]],
    seeds: Sequence[np.random.SeedSequence],
) -> list[ArrangementTrial]:
    made = kinds()
    return [run_arrangement(task, made, np.random.default_rng(seed))[0] for seed in seeds]


def summarise_arrangements(trials: Sequence[ArrangementTrial]) -> dict[str, Any]:
    """Summarise the trials; rates are shares of all scenes."""
    count = len(trials)
    done = [trial for trial in trials if trial.end == "done"]
    lone = sum(trial.lone_taps for trial in done)
    decisions = sum(trial.decisions for trial in trials)
    return {
        "scenes": count,
        "success_rate": sum(trial.inside for trial in done) / count,
        "false_claims": sum(not trial.inside for trial in done),
        "refused_before": sum(trial.end == "refused before" for trial in trials),
        "refused_later": sum(trial.end == "refused later" for trial in trials),
        "scenes_with_contact": sum(trial.contacts > 0 for trial in trials),
        "scenes_with_tool_contact": sum(trial.tool_contacts > 0 for trial in trials),
        "taps_mean": float(np.mean([trial.taps for trial in done])) if done else math.nan,
        "price_of_others": sum(trial.taps for trial in done) / lone if lone else math.nan,
        "made_way_mean": float(np.mean([trial.made_way for trial in trials])),
        "decision_mean_s": sum(trial.planning for trial in trials) / max(1, decisions),
        "decision_slowest_s": max(trial.slowest for trial in trials),
        "reasons": dict(Counter(trial.sentence for trial in trials if trial.end != "done")),
    }
