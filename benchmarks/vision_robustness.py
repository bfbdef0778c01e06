"""Wrong poses among ten thousand frames with disturbances over the table.

A frame is wrong if the error of its pose is more than five standard deviations and, in addition,
the position error is more than 0.3 mm or the angle error is more than 0.3 degrees. Each disturbance
must also be recognised: while it lasts, one of the expected problems or the expected warning must
be reported.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from benchmarks.vision_scenes import Cell, error_of, random_place, random_scene
from tapping_cell.configuration.cell import load_cell
from tapping_cell.se2 import Pose, transform_points
from tapping_cell.simulation.arm_picture import arm_solids
from tapping_cell.simulation.rendered_camera import Occluder, SceneRenderer
from tapping_cell.vision import Observation, PoseTracker, Problem, ReferenceMarker

DEFAULT_COUNT = 10_000
PERIOD = 1.0 / 30.0
SETTLE = 12
"""Number of undisturbed stationary frames before and after each disturbance."""
_ASIDE = np.array([0.12, 0.10, 0.0])
WRONG_MM, WRONG_DEG, WRONG_SIGMAS = 0.3, 0.3, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """An image, the true pose (3,) in the middle of its exposure, and the error of its stamp in s
    (None: no error)."""

    image: np.ndarray
    true: np.ndarray
    stamp: float | None = None


@dataclass(slots=True)
class Stage:
    """A scene, the same scene seen by the displaced camera, and the object's pose."""

    random: np.random.Generator
    scene: SceneRenderer
    bumped: SceneRenderer
    cell: Cell
    place: np.ndarray

    def still(self, frames: int, scene: SceneRenderer | None = None) -> Iterator[Shot]:
        """Generate frames of an undisturbed stationary object."""
        for _ in range(frames):
            yield Shot((scene or self.scene).render(self.place), self.place)

    def lit(self, levels: Iterable[float]) -> Iterator[Shot]:
        """Generate frames of an undisturbed stationary object with these levels of light."""
        for level in levels:
            yield Shot(self.scene.render(self.place, light=level), self.place)

    def reference(self) -> ReferenceMarker:
        """Return a random reference marker."""
        markers = self.cell.table.markers
        return markers[int(self.random.integers(len(markers)))]

    def covered(
        self, middle: np.ndarray, half: tuple[float, float], height: float, frames: int
    ) -> Iterator[Shot]:
        """Generate frames in which an obstacle ``height`` m above the table covers a rectangle
        around ``middle`` (3,)."""
        corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * half
        place = transform_points(middle, corners)
        cover = Occluder(np.column_stack([place, np.full(4, height)]), self.random.uniform(20, 160))
        for _ in range(frames):
            yield Shot(self.scene.render(self.place, occluders=[cover]), self.place)


def _hand(stage: Stage) -> Iterator[Shot]:
    """A hand covers the object for 3 s and moves it."""
    far = stage.place + _ASIDE
    elsewhere = random_place(stage.random)
    for k in range(100):
        share = min(k / 8.0, 1.0, (100 - k) / 8.0)
        if k == 50:
            stage.place, far = elsewhere, elsewhere + _ASIDE
        middle = far + share * (stage.place - far)
        yield from stage.covered(middle, (0.07, 0.09), 0.04, 1)


def _finger(stage: Stage) -> Iterator[Shot]:
    """A finger covers a random part of the object's marker."""
    for _ in range(6):
        angle = stage.random.uniform(0.0, 2.0 * math.pi)
        off = stage.random.uniform(0.018, 0.034)
        middle = stage.place + np.array([off * math.cos(angle), off * math.sin(angle), angle])
        yield from stage.covered(middle, (0.008, 0.03), 0.03, 5)


def _reference(stage: Stage) -> Iterator[Shot]:
    """One reference marker is covered."""
    marker = stage.reference()
    yield from stage.covered(np.array([marker.x, marker.y, 0.3]), (0.03, 0.03), 0.01, 20)


def _half_reference(stage: Stage) -> Iterator[Shot]:
    """An object covers a reference marker partly."""
    marker = stage.reference()
    shift = stage.random.uniform(0.02, 0.04)
    yield from stage.covered(np.array([marker.x + shift, marker.y, 0.2]), (0.02, 0.04), 0.005, 20)


def _bump(stage: Stage) -> Iterator[Shot]:
    """The camera is turned by 0.3 degrees and back."""
    yield from stage.still(25, stage.bumped)
    yield from stage.still(25)


def _light(stage: Stage) -> Iterator[Shot]:
    """The light goes off and on again."""
    yield from stage.lit((0.5, 0.2, *[0.01] * 15, 0.3, 1.0))


def _dusk(stage: Stage) -> Iterator[Shot]:
    """The light decreases slowly to one half and increases again."""
    yield from stage.lit(0.75 + 0.25 * math.cos(2.0 * math.pi * k / 60) for k in range(60))


def _frozen(stage: Stage) -> Iterator[Shot]:
    """The camera repeats a frame while the object is moved away."""
    image = stage.scene.render(stage.place)
    yield Shot(image, stage.place)
    stage.place = random_place(stage.random)
    for _ in range(10):
        yield Shot(image, stage.place)


def _late(stage: Stage) -> Iterator[Shot]:
    """Old frames arrive late, out of order or without a valid stamp."""
    old = stage.scene.render(stage.place)
    stage.place = random_place(stage.random)
    for stamp in (-5.0, -0.2, math.nan, -0.05, -1e9, math.inf):
        yield Shot(old, stage.place, stamp)
        yield from stage.still(1)


def _wrong_kind(stage: Stage) -> Iterator[Shot]:
    """The images have wrong sizes, encodings or depths."""
    image = stage.scene.render(stage.place)
    for wrong in (
        image[:512, :640],
        cv2.resize(image, None, fx=0.5, fy=0.5),
        np.dstack([image] * 3),
        image.astype(np.uint16) * 256,
        np.zeros((0, 0), np.uint8),
    ):
        yield Shot(wrong, stage.place)
        yield from stage.still(1)


def _slide(stage: Stage) -> Iterator[Shot]:
    """The object is tapped and slides to a stop, blurred while it moves."""
    target = 0.6 * random_place(stage.random)
    way = target - stage.place
    frames, blur = int(stage.random.integers(6, 20)), 0.2
    start = stage.place.copy()

    def at(k: float) -> np.ndarray:
        share = min(max(k, 0.0) / frames, 1.0)
        return np.asarray(start + way * (2.0 * share - share * share))

    for k in range(frames + 1):
        yield Shot(stage.scene.render(at(k), [at(k + blur)]), at(k + 0.5 * blur))
    stage.place = target


def _creep(stage: Stage) -> Iterator[Shot]:
    """The object is dragged at 1 mm/s."""
    angle = stage.random.uniform(0.0, 2.0 * math.pi)
    for _ in range(40):
        stage.place = stage.place + 3e-5 * np.array([math.cos(angle), math.sin(angle), 0.0])
        yield Shot(stage.scene.render(stage.place), stage.place)


def _grain(stage: Stage) -> Iterator[Shot]:
    """A high sensor gain causes noise of 12 grey levels."""
    for shot in stage.still(15):
        noise = stage.random.normal(0.0, 12.0, shot.image.shape)
        yield Shot(np.clip(shot.image + noise, 0, 255).astype(np.uint8), shot.true)


def _arm(stage: Stage) -> Iterator[Shot]:
    """The arm reaches over the object for a tap, from any side, and withdraws."""
    yield from _reach(stage, Pose(*stage.place))


def _arm_over_reference(stage: Stage) -> Iterator[Shot]:
    """The arm reaches over a reference marker, from any side, and withdraws."""
    marker = stage.reference()
    yield from _reach(stage, Pose(marker.x, marker.y, 0.0))


def _reach(stage: Stage, place: Pose) -> Iterator[Shot]:
    """Move the striker's tip to a point 70 mm from a place, and back."""
    cell = load_cell()
    arm, geometry = cell.arm, cell.arm.geometry()
    directions = stage.random.permutation(np.linspace(-math.pi, math.pi, 24, endpoint=False))
    tips = (
        cell.arm_base.inverse() @ (place @ Pose(0, 0, each) @ Pose(-0.07, 0, 0))
        for each in directions
    )
    reached = (
        geometry.inverse((tip.x, tip.y, arm.strike_height, tip.theta)).joints for tip in tips
    )
    over = next((np.array(joints) for joints in reached if joints is not None), None)
    if over is None:
        return
    away = np.array(arm.park)
    for k in range(60):
        share = min(k / 20.0, 1.0, (60 - k) / 20.0)
        joints = away + share * (over - away)
        solids = arm_solids(arm, cell.file.tapper, cell.arm_base, joints)
        yield Shot(stage.scene.render(stage.place, occluders=solids), stage.place)


def _away(stage: Stage) -> Iterator[Shot]:
    """The object is taken off the table and put down somewhere else."""
    away = np.array([5.0, 5.0, 0.0])
    for _ in range(15):
        yield Shot(stage.scene.render(away), away)
    stage.place = random_place(stage.random)


@dataclass(frozen=True, slots=True)
class Case:
    """A disturbance and what the tracker must report: one of ``problems``, or a message that
    contains ``warning``. If ``problems`` and ``warning`` are both empty, no report is required."""

    play: Callable[[Stage], Iterator[Shot]]
    problems: tuple[Problem, ...] = ()
    warning: str = ""


CASES = {
    "hand over the object for 3 s": Case(_hand, (Problem.OBJECT_HIDDEN,)),
    "finger on the object's marker": Case(_finger, (Problem.OBJECT_HIDDEN,)),
    "reference marker covered": Case(_reference),
    "reference marker half covered": Case(_half_reference),
    "camera bumped by 0.3 degrees": Case(_bump, (Problem.CAMERA_MOVED,), "moved"),
    "light off and on": Case(_light, (Problem.DARK,)),
    "light to a half and back": Case(_dusk),
    "frozen frames": Case(_frozen, (Problem.FROZEN_FRAME,)),
    "late and unordered stamps": Case(_late, (Problem.LATE_FRAME,)),
    "wrong size or encoding": Case(_wrong_kind, (Problem.WRONG_IMAGE,)),
    "sliding": Case(_slide),
    "creeping at 1 mm/s": Case(_creep),
    "arm over the object": Case(_arm),
    "12 grey levels of noise": Case(_grain),
    "object taken away": Case(_away, (Problem.OBJECT_HIDDEN, Problem.WRONG_MARKER)),
}


ARM_CASES = {
    "arm over the object": Case(_arm),
    "arm over a reference marker": Case(_arm_over_reference),
}


@dataclass
class Tally:
    """Results of a case."""

    runs: int = 0
    unrecognised: int = 0
    frames: int = 0
    good: int = 0
    wrong: int = 0
    worst_mm: float = 0.0
    problems: Counter[str] = field(default_factory=Counter)


def measure(count: int) -> dict[str, Any]:
    """Run all cases with changing cameras for at least ``count`` frames."""
    refused = _other_resolution(Cell.load())
    *_, report = reports_of_cases(CASES, count)
    return {**report, "other_resolution_refused": refused}


def reports_of_cases(cases: dict[str, Case], count: int) -> Iterator[dict[str, Any]]:
    """Run these cases in random order for at least ``count`` frames. Each pass through the cases
    uses another camera. After each pass, yield the report on all frames so far."""
    cv2.setNumThreads(1)
    cell = Cell.load()
    tallies = {name: Tally() for name in cases}
    total, number = 0, 0
    while total < count:
        random = np.random.default_rng([number, 21])
        turn = math.radians(0.3) * random.choice([-1.0, 1.0])
        seed = random.integers(1 << 30)
        scene, bumped = (
            random_scene(np.random.default_rng(seed), cell, number, step) for step in (0.0, turn)
        )
        stage = Stage(random, scene, bumped, cell, random_place(random))
        tracker, time = PoseTracker(cell.camera, cell.table, cell.marker), 0.0
        for name in random.permutation(list(cases)):
            if total >= count:
                break
            case, tally = cases[str(name)], tallies[str(name)]
            recognised = not (case.problems or case.warning)
            before = tally.frames
            for part in (stage.still(SETTLE), case.play(stage), stage.still(SETTLE)):
                for shot in part:
                    time += PERIOD
                    stamp = time if shot.stamp is None else time + shot.stamp
                    seen = tracker.update(shot.image, stamp)
                    _judge(tally, seen, shot.true)
                    warned = bool(case.warning) and case.warning in seen.sentence
                    recognised = recognised or seen.problem in case.problems or warned
            tally.runs += 1
            tally.unrecognised += int(not recognised)
            total += tally.frames - before
        number += 1
        yield _report(tallies, total)


def _report(tallies: dict[str, Tally], total: int) -> dict[str, Any]:
    return {
        "frames": total,
        "wrong": sum(tally.wrong for tally in tallies.values()),
        "unrecognised": sum(tally.unrecognised for tally in tallies.values()),
        "cases": {
            name: {**vars(t), "problems": dict(t.problems.most_common())}
            for name, t in tallies.items()
        },
    }


def _judge(tally: Tally, seen: Observation, true: np.ndarray) -> None:
    tally.frames += 1
    if seen.covariance is None:
        tally.problems[seen.problem.name] += 1
        return
    tally.good += 1
    error = error_of(seen, true)
    gap, turn = math.hypot(error[0], error[1]) * 1e3, math.degrees(abs(error[2]))
    sigmas = math.sqrt(float(error @ np.linalg.solve(seen.covariance, error)))
    tally.worst_mm = max(tally.worst_mm, gap)
    tally.wrong += int(sigmas > WRONG_SIGMAS and (gap > WRONG_MM or turn > WRONG_DEG))


def _other_resolution(cell: Cell) -> bool:
    """Use a calibration for another resolution. Return whether each frame is rejected with a
    message that contains both sizes."""
    half = replace(cell.camera, width=cell.camera.width // 2, height=cell.camera.height // 2)
    tracker = PoseTracker(half, cell.table, cell.marker)
    frame = np.full((cell.camera.height, cell.camera.width), 90, np.uint8)
    answers = [tracker.update(frame, 0.1 * k) for k in range(3)]
    sizes = str(cell.camera.width), str(half.width)
    return all(
        a.problem is Problem.WRONG_IMAGE and all(size in a.sentence for size in sizes)
        for a in answers
    )


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    first, *table = lines_of_cases(report)
    refused = "refused" if report["other_resolution_refused"] else "NOT REFUSED"
    return [f"{first}; calibration of another resolution {refused}", *table]


def lines_of_cases(report: dict[str, Any]) -> list[str]:
    """Format a report of :func:`reports_of_cases` as lines of text."""
    width = max(len(name) for name in report["cases"])
    rows = [
        f"{report['frames']} frames, {report['wrong']} wrong (off by more than "
        f"{WRONG_SIGMAS:.0f} sigma and {WRONG_MM} mm or {WRONG_DEG} degrees), "
        f"{report['unrecognised']} disturbances not recognised",
        f"{'':<{width}}  {'runs':>4} {'frames':>6} {'good':>6} {'wrong':>5} {'missed':>6}"
        f" {'worst mm':>8}  reported",
    ]
    for name, f in report["cases"].items():
        problems = ", ".join(f"{n} {p.lower()}" for p, n in f["problems"].items())
        rows.append(
            f"{name:<{width}}  {f['runs']:>4} {f['frames']:>6} {f['good']:>6} {f['wrong']:>5} "
            f"{f['unrecognised']:>6} {f['worst_mm']:>8.3f}  {problems}"
        )
    return rows
