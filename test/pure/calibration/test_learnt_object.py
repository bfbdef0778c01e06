"""Values learnt from taps of unknown objects are compared with the true values of the simulated
world."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from tapping_cell.calibration import learnt_object
from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.learnt_object import (
    Launches,
    LearntObject,
    advice,
    learn_object,
    learning_record,
)
from tapping_cell.calibration.object_file import object_yaml
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.objects import GRAVITY, ObjectFile, ShapeSection, load_object
from tapping_cell.mechanics import Body, Impact, Sliding
from tapping_cell.mechanics.planar import cross, to_left, turn
from tapping_cell.mechanics.slide_track import decay_of
from tapping_cell.mechanics.tap import line_of_action
from tapping_cell.planning.evaluation.worlds import scattered
from tapping_cell.planning.settings import Scatter
from tapping_cell.planning.track import Track, launch_from
from tapping_cell.se2 import Array
from tapping_cell.simulation.tap_trials import SimulatedTaps
from tapping_cell.simulation.truth import ScatterTruth, SupportTruth, TruthFile

CELL = load_cell()
STRIKER = CELL.file.tapper.striker()
GUESS = replace(CELL.object, friction=0.2, torque_factor=1.8, smallest_tap=0.0017)


def drawn(seed: int) -> tuple[ObjectFile, float, float]:
    """Choose a random object. Return its object file, in which the values are guessed, its true
    friction and its true torque factor."""
    random = np.random.default_rng(seed)
    kind = ("disk", "ring", "polygon")[seed % 3]
    if kind != "polygon":
        shape = ShapeSection(kind, radius=float(random.uniform(0.03, 0.06)))
    else:
        angles = np.sort(np.arange(5) * 2 * math.pi / 5 + random.uniform(-0.4, 0.4, 5))
        corners = 0.045 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        shape = ShapeSection(kind, vertices=tuple((float(x), float(y)) for x, y in corners))
    friction = float(np.exp(random.uniform(math.log(0.05), math.log(0.6))))
    factor = float(np.exp(random.uniform(math.log(0.8), math.log(4.0))))
    return replace(GUESS, shape=shape), friction, factor


def learnt(seed: int, count: int = 12, bumps: int = 0) -> tuple[LearntObject, float, float]:
    content, friction, factor = drawn(seed)
    random = np.random.default_rng(100 + seed)
    tap = replace(content.tap(STRIKER), smallest_distance=0.0)
    asked = np.empty((0, 3))
    while len(asked) < count:
        # Check 64 taps in one call of ``reachable``, because each call integrates the slides of a
        # polygon again.
        distance, heading = random.uniform(0.004, 0.03, 64), random.uniform(-3, 3, 64)
        turn = random.uniform(-0.9, 0.9, 64) * tap.cone_slope * distance
        some = np.column_stack([distance * np.cos(heading), distance * np.sin(heading), turn])
        asked = np.concatenate([asked, some[tap.reachable(some)]])[:count]
    truth = TruthFile(
        (0.0, 0.0, 0.0),
        support=SupportTruth(friction / content.friction, factor / content.torque_factor),
        scatter=ScatterTruth(0.02, 0.08, 0.01),
    )
    world = SimulatedTaps(tap, content, truth)
    gains = np.tile([1.0, 1.0, 0.0, 0.0], (count, 1))
    moved = world.answer(np.zeros((count, 3)), np.zeros((count, 3)), asked, gains, random)
    moved[:bumps] *= 2.5
    return learn_object(content, asked, moved), friction, factor


@pytest.mark.parametrize("seed", range(3), ids=["disk", "ring", "polygon"])
def test_friction_and_torque_factor_of_unknown_objects_are_learnt(seed: int) -> None:
    found, friction, factor = learnt(seed)
    assert found.content.friction == pytest.approx(friction, rel=0.08)
    assert found.content.torque_factor == pytest.approx(factor, rel=0.35)
    estimate = {entry.name: entry for entry in found.estimates}
    assert estimate["friction"].low < found.content.friction < estimate["friction"].high
    assert 0.01 < found.content.scatter.distance < 0.1


def test_disturbed_taps_are_excluded() -> None:
    found, friction, _ = learnt(0, bumps=2)
    assert found.left_out == 2
    assert found.content.friction == pytest.approx(friction, rel=0.08)


def test_the_written_file_is_a_valid_object_file(tmp_path) -> None:  # type: ignore[no-untyped-def]
    found, _, _ = learnt(1, 8)
    record = learning_record(found, [])
    path = tmp_path / "object.yaml"
    path.write_text(object_yaml(replace(found.content, calibration=record), record))
    again = load_object(path)
    assert again.friction == found.content.friction and again.calibration is not None


def test_too_few_taps_are_refused() -> None:
    with pytest.raises(RecordError, match="at least 5"):
        learn_object(GUESS, np.full((4, 3), 0.01), np.full((4, 3), 0.01))


FOREIGN_TAPS = 15
IMAGE_S, POSE_STD, ANGLE_STD = 1 / 30, 5e-5, math.radians(0.05)


def foreign_fit(
    seed: int, *, tracked: bool, contact_friction: tuple[float, float] = (0.1, 0.35)
) -> tuple[LearntObject, float, float]:
    """Learn a round object whose mass, restitution and contact friction are not those of the file,
    from poses at rest, and with ``tracked`` also from images at 30 Hz. Return the true friction and
    torque factor too. ``contact_friction``: range of its true value."""
    content, friction, factor = drawn(3 * (seed // 2) + seed % 2)
    random = np.random.default_rng(seed)
    true = replace(
        content,
        friction=friction,
        torque_factor=factor,
        mass=content.mass * float(np.exp(random.uniform(-0.7, 0.7))),
        restitution=float(random.uniform(0.5, 1.0)),
        contact_friction=float(random.uniform(*contact_friction)),
    )
    tap = replace(content.tap(STRIKER), smallest_distance=0.0)
    length = np.exp(random.uniform(math.log(0.004), math.log(0.04), FOREIGN_TAPS))
    heading = random.uniform(-math.pi, math.pi, FOREIGN_TAPS)
    slope = np.clip(random.uniform(-1.3, 1.3, FOREIGN_TAPS), -1.0, 1.0) * tap.cone_slope
    asked = np.stack([length * np.cos(heading), length * np.sin(heading), slope * length], -1)
    # The length of a slide is what was requested, because the planner learns while it taps.
    asked = asked * friction / content.friction
    plan = tap.plan(asked)
    twist = true.tap(STRIKER).strike(np.zeros(3), plan.strike_pose, plan.striker_speed).twist
    speed = np.hypot(twist[:, 0], twist[:, 1]) * (1 + random.normal(0.0, 0.025, FOREIGN_TAPS))
    spin = twist[:, 2] * (1 + random.normal(0.0, 0.15, FOREIGN_TAPS))
    heading = np.arctan2(twist[:, 1], twist[:, 0]) + random.normal(0.0, 0.017, FOREIGN_TAPS)
    launch = np.stack([speed * np.cos(heading), speed * np.sin(heading), spin], axis=-1)
    slide = Sliding(true.body(), friction, factor, GRAVITY)
    moved = slide.displace(launch)
    moved = moved + random.normal(0.0, 1.0, moved.shape) * [POSE_STD, POSE_STD, ANGLE_STD]
    launches = None
    if tracked:
        times = np.arange(0.0, 1.5, IMAGE_S)
        known = Sliding(content.body(), content.friction, content.torque_factor, GRAVITY)
        rows = []
        for index in range(FOREIGN_TAPS):
            since = times + random.uniform(0.0, IMAGE_S)
            way = slide.profile(speed[index], spin[index], since)
            x, y = way.distance * math.cos(heading[index]), way.distance * math.sin(heading[index])
            poses = np.concatenate([np.zeros((2, 3)), np.stack([x, y, way.rotation], axis=-1)])
            poses += random.normal(0.0, 1.0, poses.shape) * [POSE_STD, POSE_STD, ANGLE_STD]
            images = np.concatenate([since[0] - IMAGE_S * np.array([2.0, 1.0]), since])
            track = Track(images, poses, np.tile([POSE_STD, ANGLE_STD], (len(images), 1)))
            found = launch_from(track, np.zeros(3), moved[index], known)
            assert found is not None
            rows.append([found.speed, found.spin, found.speed_std, found.spin_std])
        launches = Launches(*np.array(rows, dtype=float).T)
    return learn_object(content, asked, moved, launches), friction, factor


@pytest.mark.campaign
@pytest.mark.parametrize("tracked", [False, True])
def test_intervals_contain_the_true_values_in_a_foreign_impact(tracked: bool) -> None:
    inside, width = [], []
    for seed in range(3):
        found, friction, factor = foreign_fit(seed, tracked=tracked)
        estimate = {entry.name: entry for entry in found.estimates}
        for name, value in (("friction", friction), ("torque_factor", factor)):
            entry = estimate[name]
            assert entry.low < entry.value < entry.high
            inside.append(entry.low < value < entry.high)
        width.append(estimate["friction"].std / estimate["friction"].value)
        # Only a track tells the friction from the launch speed, and the user is told so.
        assert any("launch speed was measured in 0 of" in line for line in advice(found)) != tracked
        assert estimate["launch_speed"].fitted == tracked
    assert all(inside)
    assert (max(width) < 0.06) if tracked else (min(width) > 0.3)


@pytest.mark.parametrize("tracked", [False, True])
def test_taps_without_tangential_impulses_do_not_tell_the_torque_factor(tracked: bool) -> None:
    found, _, factor = foreign_fit(0, tracked=tracked, contact_friction=(0.005, 0.01))
    learnt = next(entry for entry in found.estimates if entry.name == "torque_factor")
    if learnt.fitted:
        assert tracked and learnt.low < factor < learnt.high
    else:
        assert any("torque factor is not known well" in line for line in advice(found))


def test_a_floor_of_the_scatter_is_learnt() -> None:
    """Learn from taps of 2 to 30 mm. Their end positions scatter by 0.3 mm regardless of the
    length, in addition to the scatter that is proportional to the length."""
    content, *_ = drawn(0)
    body = content.body()
    rng = np.random.default_rng(5)
    length = np.exp(rng.uniform(math.log(0.002), math.log(0.03), 60))
    heading = rng.uniform(-math.pi, math.pi, 60)
    asked = np.stack(
        [length * np.cos(heading), length * np.sin(heading), rng.uniform(-2, 2, 60) * length], -1
    )
    sliding = Sliding(body, content.friction, content.torque_factor, GRAVITY)
    gains = np.tile([1.0, 1.0, 0.0, 0.0], (60, 1))
    scatter = Scatter(0.03, 0.1, 0.01, position_floor=3e-4)
    exact = sliding.displace(sliding.twist_for(asked))
    moved = scattered(exact, gains, np.zeros((60, 3)), scatter, rng)
    made = learn_object(content, asked, moved)
    assert made.content.scatter.position_floor == pytest.approx(3e-4, rel=0.35)
    assert made.content.scatter.distance == pytest.approx(0.03, rel=0.6)


class SmallSpin(NamedTuple):
    """Slides whose spin is small in comparison with the speed (docs/mechanics.md): closed forms."""

    body: Body
    friction: float
    torque_factor: float
    gravity: float

    def displace(self, twist: Array) -> Array:
        speed = np.hypot(twist[:, 0], twist[:, 1])[:, None]
        decay = decay_of(self.body.gamma, self.torque_factor)
        return twist * speed / (self.friction * self.gravity) / np.array([2.0, 2.0, decay])

    def twist_for(self, displacement: Array) -> Array:
        decay = decay_of(self.body.gamma, self.torque_factor)
        twist = displacement * self.friction * self.gravity * np.array([2.0, 2.0, decay])
        return twist / np.sqrt(np.hypot(twist[:, 0], twist[:, 1]))[:, None]


def polygon_taps(seed: int, count: int) -> tuple[ObjectFile, Array, Array, float]:
    """Tap a polygon whose mass, restitution and contact friction are not those of its file, on
    edges whose normals do not point at the centre. Return the file, the commanded and the measured
    displacements, and the true torque factor."""
    content, friction, factor = drawn(3 * seed + 2)
    content = replace(content, friction=friction)
    random = np.random.default_rng(seed)
    true = replace(
        content,
        mass=content.mass * float(np.exp(random.uniform(-0.7, 0.7))),
        restitution=float(random.uniform(0.4, 0.9)),
        contact_friction=float(random.uniform(0.2, 0.35)),
    )
    body, mass = true.body(), true.mass
    speed, heading = random.uniform(0.1, 0.4, 40 * count), random.uniform(-3.1, 3.1, 40 * count)
    planned = np.stack([np.cos(heading), np.sin(heading), random.uniform(-9, 9, len(speed))], -1)
    planned *= speed[:, None]
    line, slope = line_of_action(body, planned)
    usable = np.flatnonzero(~line.missed & (np.abs(slope) < 0.95 * content.contact_friction))
    normal, point, planned = line.normal[usable], line.point[usable], planned[usable]
    local = np.stack([(normal * point).sum(axis=1), cross(normal, point)], axis=1)
    before, after = (
        Impact(o.body(), STRIKER, restitution=o.restitution, friction=o.contact_friction)
        for o in (content, true)
    )
    incidence = before.incidence_for(slope[usable], local)
    kept = np.flatnonzero(np.isfinite(incidence))[:count]
    assert len(kept) == count
    normal, point, planned, local = normal[kept], point[kept], planned[kept], local[kept]
    hit = before.strike(1.0, incidence[kept], local)
    needed = content.mass * np.hypot(planned[:, 0], planned[:, 1])
    needed = needed / np.hypot(hit.normal_impulse, hit.tangential_impulse)
    hit = after.strike(needed, incidence[kept], local)
    push = hit.normal_impulse[:, None] * normal + hit.tangential_impulse[:, None] * to_left(normal)
    push = turn(push * random.normal(1.0, 0.025, (count, 1)), random.normal(0.0, 0.017, count))
    spin = cross(point, push) / body.radius_of_gyration**2 * random.normal(1.0, 0.15, count)
    moved = SmallSpin(body, friction, factor, GRAVITY).displace(
        np.column_stack([push, spin]) / mass
    )
    slide = SmallSpin(content.body(), content.friction, content.torque_factor, GRAVITY)
    return content, slide.displace(planned), moved, factor


def test_intervals_contain_the_torque_factors_of_polygons(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learnt_object, "Sliding", SmallSpin)
    errors, inside, widths = [], [], []
    for seed in range(20):
        content, asked, moved, factor = polygon_taps(seed, 24)
        estimate = {entry.name: entry for entry in learn_object(content, asked, moved).estimates}
        found = estimate["torque_factor"]
        errors.append(math.log(found.value / factor))
        inside.append(found.low < factor < found.high)
        widths.append(found.high / found.low)
    assert sum(inside) >= 18
    assert abs(float(np.mean(errors))) < 0.1
    assert float(np.median(widths)) < 2.5


def test_tracks_that_contradict_one_another_are_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learnt_object, "Sliding", SmallSpin)
    content, _, _ = drawn(0)
    length = np.linspace(0.005, 0.03, 12)
    asked = np.stack([length, np.zeros(12), np.where(np.arange(12) % 2, 2.0, -2.0) * length], -1)
    slide = SmallSpin(content.body(), content.friction, content.torque_factor, GRAVITY)
    twist = slide.twist_for(asked)
    still, nothing = np.full(12, 0.01), np.full(12, math.nan)
    launches = Launches(twist[:, 0], nothing, still, nothing)
    assert learn_object(content, asked, asked, launches).tracked == 12
    # The striker stays behind a slowly moving object: the speed depends less on the length.
    pushed = launches._replace(speed=np.sqrt(twist[:, 0]))
    found = learn_object(content, asked, asked, pushed)
    assert found.tracked == 0
    assert found.estimates[0].low < content.friction < found.estimates[0].high
