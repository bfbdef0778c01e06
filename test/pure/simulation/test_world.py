"""The simulated world reacts to a strike according to its true parameters, not to the planner's
parameters."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import load
from tapping_cell.mechanics import Striker
from tapping_cell.se2 import Pose
from tapping_cell.simulation.truth import ImpactTruth, ScatterTruth, SupportTruth, TruthFile
from tapping_cell.simulation.world import World

CELL = load_cell()
STRIKER = CELL.file.tapper.striker()
STROKE = CELL.file.tapper.stroke
PLAIN = TruthFile(object_start=(0.05, -0.03, 0.7))
START = Pose(0.05, -0.03, 0.7)


def world_of(truth: TruthFile, seed: int = 1) -> World:
    world = World(CELL.object, STRIKER, STROKE, truth, seed)
    world.advance(0.0)
    return world


def settled(world: World) -> Pose:
    for step in range(1, 400):
        world.advance(0.01 * step)
        if world.at_rest:
            return world.pose
    raise AssertionError("the object does not come to rest")


@settings(max_examples=settings.default.max_examples // 5)
@given(distance=st.floats(0.003, 0.08), heading=st.floats(-3.1, 3.1), share=st.floats(-0.9, 0.9))
def test_a_world_without_errors_gives_the_planned_result(distance, heading, share):
    tap = CELL.object.tap(STRIKER)
    turn = share * tap.cone_slope * distance
    wanted = (distance * math.cos(heading), distance * math.sin(heading), turn)
    plan = tap.plan(wanted, START)
    contact = Pose(*np.asarray(plan.strike_pose).tolist())
    tip = contact @ Pose(-0.015, 0.0, 0.0)
    world = world_of(PLAIN)
    assert world.strike(tip, 0.006, float(plan.striker_speed), 0.0)
    assert not world.at_rest
    end = settled(world)
    moved = (end.x - START.x, end.y - START.y)
    assert math.hypot(*moved) == pytest.approx(distance, rel=0.02)
    assert START.rotation_to(end) == pytest.approx(turn, rel=0.03, abs=1e-3)


def test_the_object_stays_until_the_striker_arrives() -> None:
    world = world_of(PLAIN)
    tip = Pose(START.x - 0.048 - 0.0054 - 0.015, START.y, 0.0)
    assert world.strike(tip, 0.006, 0.1, 0.0)
    world.advance(0.149)
    assert world.pose == pytest.approx(START)
    world.advance(0.2)
    assert world.pose.x > START.x


@pytest.mark.parametrize(
    ("tip", "height"),
    [
        (Pose(START.x - 0.07, START.y + 0.08, 0.0), 0.006),
        (Pose(START.x - 0.07, START.y, math.pi), 0.006),
        (Pose(START.x - 0.07, START.y, 0.0), 0.020),
        (Pose(START.x - 0.07, START.y, 0.0), -0.001),
        (Pose(START.x - 0.16, START.y, 0.0), 0.006),
    ],
    ids=["beside", "away from it", "above it", "into the table", "beyond the stroke"],
)
def test_a_striker_that_misses_the_object_moves_nothing(tip: Pose, height: float) -> None:
    world = world_of(PLAIN)
    assert not world.strike(tip, height, 0.3, 0.0)
    world.advance(1.0)
    assert world.pose == pytest.approx(START)


def spread(truth: TruthFile, seeds: int = 40) -> np.ndarray:
    tip = Pose(START.x - 0.07, START.y, 0.0)
    ends = []
    for seed in range(seeds):
        world = world_of(truth, seed)
        world.strike(tip, 0.006, 0.3, 0.0)
        ends.append(settled(world))
    return np.asarray(ends)


def test_taps_scatter_as_given_by_the_simulation_parameters() -> None:
    ends = spread(replace(PLAIN, scatter=ScatterTruth(speed=0.05, spin=0.0, direction=0.02)))
    distance = np.hypot(ends[:, 0] - START.x, ends[:, 1] - START.y)
    # The distance is proportional to the square of the speed, so a scatter of 5 % in speed becomes
    # 10 % in distance. With 40 samples, the standard error of the scatter is 11 %.
    assert 0.07 < distance.std() / distance.mean() < 0.14
    heading = np.arctan2(ends[:, 1] - START.y, ends[:, 0] - START.x)
    assert 0.014 < heading.std() < 0.028


def test_the_same_seed_gives_the_same_world() -> None:
    truth = replace(PLAIN, scatter=ScatterTruth(speed=0.05, spin=0.1, direction=0.02))
    assert np.array_equal(spread(truth, 3), spread(truth, 3))


def test_the_simulation_parameters_affect_the_result() -> None:
    tip = Pose(START.x - 0.07, START.y, 0.0)

    def distance(truth: TruthFile) -> float:
        world = world_of(truth)
        world.strike(tip, 0.006, 0.3, 0.0)
        return settled(world).x - START.x

    plain = distance(PLAIN)
    rougher = distance(replace(PLAIN, support=SupportTruth(friction_factor=1.2)))
    assert rougher == pytest.approx(plain / 1.2, rel=0.01)
    faster = distance(replace(PLAIN, impact=ImpactTruth(striker_speed_factor=1.1)))
    assert faster == pytest.approx(plain * 1.21, rel=0.01)


def test_a_placed_object_stays_where_it_was_placed() -> None:
    world = world_of(PLAIN)
    world.strike(Pose(START.x - 0.07, START.y, 0.0), 0.006, 0.3, 0.0)
    world.advance(0.12)
    world.place(Pose(0.1, 0.1, 4.0))
    assert world.at_rest
    world.advance(1.0)
    assert world.pose == pytest.approx((0.1, 0.1, 4.0 - 2 * math.pi))


@settings(max_examples=settings.default.max_examples // 5)
@given(gaps=st.lists(st.floats(0.0005, 0.05), min_size=5, max_size=60))
def test_the_rest_pose_does_not_depend_on_the_observation_times(gaps: list[float]) -> None:
    tip = Pose(START.x - 0.07, START.y + 0.01, 0.1)
    glimpsed, once = world_of(PLAIN), world_of(PLAIN)
    for world in (glimpsed, once):
        assert world.strike(tip, 0.006, 0.3, 0.0)
    time, before = 0.0, START
    for gap in gaps:
        time += gap
        glimpsed.advance(time)
        # The object is never faster than the striker (0.3 m/s).
        assert math.dist(glimpsed.pose[:2], before[:2]) < 0.3 * gap + 1e-9
        before = glimpsed.pose
    glimpsed.advance(10.0)
    once.advance(10.0)
    assert glimpsed.pose == once.pose
    assert glimpsed.at_rest


def test_a_striker_follows_through_to_the_end_of_its_stroke() -> None:
    """A heavy striker that hardly rebounds keeps pushing a light object until the end of the
    stroke. A shorter stroke ends earlier."""
    content = replace(CELL.object, name="light disk", mass=0.02, restitution=0.1, friction=0.6)
    striker = Striker(0.3, 0.0054, "linear_bearings")
    tip = Pose(START.x - 0.0054 - 0.048 - 0.005, START.y, 0.0)

    def moved(stroke: float, follow_through: float) -> float:
        truth = replace(PLAIN, impact=ImpactTruth(follow_through=follow_through))
        world = World(content, striker, stroke, truth, 1)
        assert world.strike(tip, 0.006, 0.2, 0.0)
        world.advance(3.0)
        assert world.at_rest
        return world.pose.x - START.x

    alone = moved(0.025, 0.0)
    pushed = moved(0.025, 2.0)
    # After a single impact, the object has (1 + e) m_s / (m + m_s) times the striker's speed.
    speed = 1.1 * 0.3 / 0.32 * 0.2
    assert alone == pytest.approx(speed**2 / (2 * 0.6 * 9.81), rel=0.02)
    # The object is pushed to the end of the striker's stroke and then slides on.
    assert 0.020 < pushed < 0.023
    assert alone < moved(0.012, 2.0) < pushed


def test_a_centre_of_mass_off_the_middle_turns_a_push_through_the_middle() -> None:
    tip = Pose(START.x - 0.07, START.y, 0.0)

    def turned(offset: float) -> float:
        truth = TruthFile((START.x, START.y, 0.0), SupportTruth(mass_offset=(0.0, offset)))
        world = world_of(truth)
        world.strike(tip, 0.006, 0.3, 0.0)
        return settled(world).theta

    # Struck to the right of its centre of mass, the object turns to the left.
    assert turned(0.004) > 0.01
    assert turned(-0.004) == pytest.approx(-turned(0.004), rel=1e-6)
    assert turned(0.0) == pytest.approx(0.0, abs=1e-9)


def test_a_generator_may_be_injected() -> None:
    truth = replace(PLAIN, scatter=ScatterTruth(speed=0.05, spin=0.1, direction=0.02))
    tip = Pose(START.x - 0.07, START.y, 0.0)
    ends = []
    for random in (np.random.default_rng(5), 5):
        world = World(CELL.object, STRIKER, STROKE, truth, random)
        world.strike(tip, 0.006, 0.3, 0.0)
        ends.append((settled(world), world.gate_speed(0.3)))
    assert ends[0] == ends[1]


@pytest.mark.parametrize(
    "file", sorted((shared_folder() / "truth").glob("*.yaml")), ids=lambda file: file.stem
)
def test_every_supplied_world_answers_a_tap(file: Path) -> None:
    truth = replace(load(TruthFile, file), object_start=tuple(START))
    world = world_of(truth)
    assert world.strike(Pose(START.x - 0.07, START.y, 0.0), 0.006, 0.3, 0.0)
    moved = math.dist(settled(world)[:2], START[:2])
    assert 0.001 < moved < 0.02


@pytest.mark.parametrize("share", [0.0, 0.7])
def test_small_taps_scatter_by_the_floor(share: float) -> None:
    """For taps of two lengths, the final pose scatters by the constant floor: along the tap, across
    it, and in rotation."""
    floor = ScatterTruth(position_floor=3e-4, angle_floor=0.004)
    tap = CELL.object.tap(STRIKER)
    for distance in (0.003, 0.02):
        wanted = (distance, 0.0, share * tap.cone_slope * distance)
        plan = tap.plan(wanted, START)
        tip = Pose(*np.asarray(plan.strike_pose).tolist()) @ Pose(-0.015, 0.0, 0.0)
        ends = []
        for seed in range(30):
            world = world_of(replace(PLAIN, scatter=floor), seed)
            assert world.strike(tip, 0.006, float(plan.striker_speed), 0.0)
            world.settle()
            ends.append((world.pose.x, world.pose.y, START.rotation_to(world.pose)))
        spread = np.std(ends, axis=0)
        assert spread == pytest.approx([3e-4, 3e-4, 0.004], rel=0.35)
