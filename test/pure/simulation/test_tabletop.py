"""Several objects on one simulated table: gaps, impacts, the object that is struck, and the
reports."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import ObjectFile, load_object
from tapping_cell.mechanics import Disk, Polygon
from tapping_cell.se2 import Pose
from tapping_cell.simulation.collision import Solid, gap_between, impact
from tapping_cell.simulation.sliding import Motion
from tapping_cell.simulation.tabletop import START_GAP_M, Tabletop
from tapping_cell.simulation.truth import TruthFile
from tapping_cell.simulation.world import World

CELL = load_cell()
STRIKER, STROKE = CELL.file.tapper.striker(), CELL.file.tapper.stroke
SQUARE = load_object(shared_folder() / "objects" / "aluminium_square.yaml")
SIZE = (0.6, 0.44)
TRIANGLE = Polygon(((-0.02, -0.015), (0.03, -0.015), (-0.01, 0.03)), 0.1, 0.01)
SOLIDS = (
    Solid.of(Disk(0.03, 0.2, 0.01), (0.0, 0.0), 9e-5),
    Solid.of(Disk(0.02, 0.1, 0.01), (0.004, -0.002), 3e-5),
    Solid.of(TRIANGLE, (0.0, 0.0), TRIANGLE.inertia),
    Solid.of(SQUARE.body(), (0.0, 0.0), SQUARE.body().inertia),
)
motions = st.builds(
    Motion,
    st.floats(-0.1, 0.1),
    st.floats(-0.1, 0.1),
    st.floats(-3.1, 3.1),
    st.floats(-0.5, 0.5),
    st.floats(-0.5, 0.5),
    st.floats(-10.0, 10.0),
)
solids = st.sampled_from(SOLIDS)


def rim(solid: Solid, motion: Motion) -> np.ndarray:
    """Return points along the whole outline."""
    corners = solid.at(motion)
    edges = np.roll(corners, -1, axis=0) - corners
    shares = np.linspace(0.0, 1.0, 400)[:, None, None]
    points = (corners + shares * edges).reshape(-1, 2)
    if solid.radius == 0.0:
        return points
    angles = np.linspace(-math.pi, math.pi, 720)
    circle = solid.radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return (corners[:, None, :] + circle).reshape(-1, 2)


@given(solids, solids, motions, motions)
def test_the_gap_is_the_minimum_distance_of_the_outlines(first, second, here, there):
    gap = gap_between(first, second, here, there)
    back = gap_between(second, first, there, here)
    assert gap.distance == pytest.approx(back.distance, abs=1e-12)
    assert math.hypot(*gap.normal) == pytest.approx(1.0)
    if gap.distance > 1e-3:
        p, q = rim(first, here), rim(second, there)
        nearest = np.hypot(*(p[:, None, :] - q[None, :, :]).T).min()
        assert gap.distance == pytest.approx(nearest, abs=2e-4)
        # Moved by the gap along its normal, the first object touches the second.
        nx, ny = gap.normal
        moved = here._replace(x=here.x + gap.distance * nx, y=here.y + gap.distance * ny)
        assert gap_between(first, second, moved, there).distance == pytest.approx(0.0, abs=1e-9)
    elif gap.distance < -1e-3:
        nx, ny = gap.normal
        apart = here._replace(x=here.x + gap.distance * nx, y=here.y + gap.distance * ny)
        assert gap_between(first, second, apart, there).distance == pytest.approx(0.0, abs=1e-6)


@given(solids, solids, motions, motions)
def test_an_impact_keeps_momentum_and_leaves_no_closing_speed(first, second, here, there):
    gap = gap_between(first, second, here, there)
    met = impact(first, second, here, there, gap)
    if met is None:
        return
    after, other, closing = met
    assert closing > 0.0
    assert impact(first, second, after, other, gap) is None or (
        impact(first, second, after, other, gap)[2] < 1e-9  # type: ignore[index]
    )
    for axis in ("vx", "vy"):
        before = first.mass * getattr(here, axis) + second.mass * getattr(there, axis)
        assert first.mass * getattr(after, axis) + second.mass * getattr(
            other, axis
        ) == pytest.approx(before, abs=1e-12)

    def spin(solid: Solid, motion: Motion) -> float:
        orbit = solid.mass * (motion.x * motion.vy - motion.y * motion.vx)
        return orbit + solid.inertia * motion.omega

    def energy(solid: Solid, motion: Motion) -> float:
        moved = solid.mass * (motion.vx**2 + motion.vy**2)
        return 0.5 * (moved + solid.inertia * motion.omega**2)

    total = spin(first, here) + spin(second, there)
    assert spin(first, after) + spin(second, other) == pytest.approx(total, abs=1e-12)
    lost = energy(first, here) + energy(second, there)
    assert energy(first, after) + energy(second, other) <= lost + 1e-12


def named(content: ObjectFile, name: str) -> ObjectFile:
    return replace(content, name=name)


def tabletop(*starts: tuple[float, float, float], contents: tuple[ObjectFile, ...] = ()):
    """Return a table with objects at these places: the cell's disk and squares, or ``contents``."""
    files = contents or (
        CELL.object,
        *(named(SQUARE, f"square {n}") for n in range(1, len(starts))),
    )
    truth = TruthFile(object_start=starts[0], further_starts=starts[1:])
    top = Tabletop(files, STRIKER, STROKE, truth, 1, SIZE)
    top.advance(0.0)
    return top


def settle(top: Tabletop) -> None:
    for step in range(1, 1000):
        top.advance(0.005 * step)
        if top.at_rest:
            return
    raise AssertionError("the objects do not come to rest")


def test_one_object_on_a_table_gives_the_single_object_world() -> None:
    truth = TruthFile(object_start=(0.05, -0.03, 0.7))
    world = World(CELL.object, STRIKER, STROKE, truth, 3)
    top = Tabletop((CELL.object,), STRIKER, STROKE, truth, 3, SIZE)
    tip = Pose(0.05 - 0.07, -0.025, 0.0)
    for each in (world, top):
        each.advance(0.0)
        assert each.strike(tip, 0.006, 0.3, 0.0)
        each.advance(3.0)
    assert next(iter(top.poses.values())) == world.pose and top.take_contacts() == []


def test_an_object_that_slides_into_another_pushes_it_and_is_reported_once() -> None:
    top = tabletop((-0.10, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert top.strike(Pose(-0.17, 0.0, 0.0), 0.006, 1.0, 0.0)
    deepest = 0.0
    one, other = top.worlds.values()
    for step in range(1, 2000):
        top.advance(0.001 * step)
        gap = gap_between(one.solid, other.solid, one.motion, other.motion)
        deepest = min(deepest, gap.distance)
    assert top.at_rest and deepest > -1e-4
    (contact,) = top.take_contacts()
    assert (contact.name, contact.other) == (CELL.object.name, "square 1")
    assert contact.closing_speed > 0.05 and contact.place[0] == pytest.approx(-0.04, abs=1e-3)
    assert top.poses["square 1"].x > 0.005 and top.poses["square 1"].x > one.pose.x
    assert top.take_contacts() == []


def test_a_hit_off_the_middle_turns_the_other_object() -> None:
    top = tabletop((-0.10, 0.03, 0.0), (0.0, 0.0, 0.0))
    assert top.strike(Pose(-0.17, 0.03, 0.0), 0.006, 1.0, 0.0)
    settle(top)
    # The square is pushed along +x above its centre, so it turns clockwise.
    assert top.poses["square 1"].theta < -0.02


def test_the_striker_hits_only_the_first_object_on_its_path() -> None:
    top = tabletop((0.15, 0.0, 0.0), (0.0, 0.0, 0.0))
    before = dict(top.poses)
    assert top.strike(Pose(-0.055, 0.0, 0.0), 0.006, 0.2, 0.0)
    settle(top)
    assert top.poses[CELL.object.name] == before[CELL.object.name]
    assert top.poses["square 1"].x > 0.001 and top.take_contacts() == []
    assert not top.strike(Pose(-0.25, 0.15, 0.0), 0.006, 0.2, 6.0)


@settings(max_examples=settings.default.max_examples // 5)
@given(st.integers(0, 1000))
def test_objects_without_a_start_pose_are_placed_apart_on_the_table(seed: int) -> None:
    files = (CELL.object, *(named(SQUARE, f"square {n}") for n in range(1, 4)))
    top = Tabletop(files, STRIKER, STROKE, TruthFile((0.0, 0.0, 0.0)), seed, SIZE)
    assert_apart(top)
    # It does not matter where the objects lay before.
    for world in top.worlds.values():
        world.place(Pose(0.0, 0.0, 0.0))
    top.spread(list(top.worlds))
    assert_apart(top)


def assert_apart(top: Tabletop) -> None:
    worlds = list(top.worlds.values())
    for number, one in enumerate(worlds):
        assert abs(one.pose.x) <= SIZE[0] / 2 - 0.06 and abs(one.pose.y) <= SIZE[1] / 2 - 0.06
        for other in worlds[:number]:
            between = one.pose.distance_to(other.pose) - one.solid.reach - other.solid.reach
            assert between >= START_GAP_M - 1e-9


def test_a_table_without_free_space_is_reported() -> None:
    files = (CELL.object, *(named(SQUARE, f"square {n}") for n in range(1, 20)))
    with pytest.raises(ValueError, match="no free place for 'square"):
        Tabletop(files, STRIKER, STROKE, TruthFile((0.0, 0.0, 0.0)), 1, SIZE)
