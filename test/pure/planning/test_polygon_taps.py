"""Taps on polygons chosen for many trials at once, compared with those chosen by a session."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tapping_cell.mechanics import Impact, Polygon, Sliding, Striker, Tap
from tapping_cell.planning import Gains, PlannerSettings, Scatter, make_planner
from tapping_cell.planning.alternatives import alternative_taps
from tapping_cell.planning.evaluation import Evaluation, PhysicsWorld, evaluate, summarise
from tapping_cell.planning.evaluation.polygon_taps import contact_taps

CORNERS = ((0.04, 0.03), (-0.04, 0.03), (-0.04, -0.03), (0.04, -0.03))
BODY = Polygon(CORNERS, mass=0.2, height=0.012)
TAP = Tap(
    sliding=Sliding(BODY, friction=0.17, torque_factor=3.0).tabulated(),
    impact=Impact(BODY, Striker(mass=0.1, tip_radius=0.0054), restitution=0.86, friction=0.20),
    smallest_distance=0.0,
)
PLANNER = make_planner("exact", PlannerSettings(cone_slope=TAP.cone_slope))


def states(count, seed=3):
    """Return poses, goals, the taps that the exact method prefers from the poses to the goals, and
    initial gains."""
    rng = np.random.default_rng(seed)
    pose = rng.uniform([-0.1, -0.1, -math.pi], [0.1, 0.1, math.pi], (count, 3))
    goal = pose + rng.uniform([-0.03, -0.03, -0.3], [0.03, 0.03, 0.3], (count, 3))
    gains = Gains.start((count,))
    box = PLANNER.settings.stopping.rotation
    distance, turn, heading = gains.to_plan(goal - pose, box)
    tap = PLANNER.choose(distance, turn)
    rotation = gains.from_plan(goal - pose, tap.rotation, box)
    first = gains.command(tap.distance, rotation, heading, pose[:, 2], TAP.cone_slope)
    return pose, goal, first, gains


class StraightPaths:
    def __init__(self, goal):
        self.goal = goal

    def length(self, points):
        return np.hypot(points[..., 0] - self.goal[0], points[..., 1] - self.goal[1])


def test_every_tap_has_a_contact_and_single_and_batch_choices_agree():
    pose, goal, first, gains = states(40)
    chosen = contact_taps(pose, goal, first, gains.value, PLANNER, TAP)
    direct = TAP.reachable(first, pose)
    assert 0 < direct.sum() < 40
    assert np.all(TAP.reachable(chosen, pose))
    assert np.array_equal(chosen[direct], first[direct])
    for row in range(40):
        one = slice(row, row + 1)
        alone = contact_taps(pose[one], goal[one], first[one], gains.value[one], PLANNER, TAP)
        assert alone == pytest.approx(chosen[one], abs=1e-12)


def test_the_choice_matches_that_of_a_session():
    """Taps are chosen for many states at once. At least 80 % of these taps must be those that a
    session chooses for the same states."""
    pose, goal, first, gains = states(30, seed=8)
    chosen = contact_taps(pose, goal, first, gains.value, PLANNER, TAP)
    rough = replace(TAP, sliding=TAP.sliding.approximated())
    alike = 0
    rows = np.flatnonzero(~TAP.reachable(first, pose))
    for row in rows:
        one = gains.of(np.array(row))
        paths = StraightPaths(goal[row])
        for taps, _ in alternative_taps(
            pose[row],
            goal[row],
            first[row],
            one,
            PLANNER,
            paths,
            rough,
            lambda poses, taps: rough.reachable(taps, poses),
        ):
            reached = np.flatnonzero(rough.reachable(taps, pose[row]))
            if reached.size:
                alike += bool(np.allclose(taps[reached[0]], chosen[row], atol=1e-9))
                break
    # The other choices differ because two taps have the same cost, or because the tap that the
    # approximation ranks first is impossible with the polygon's exact slide.
    assert alike >= 0.8 * rows.size


def test_polygons_reach_their_goals_by_their_own_physics():
    scatter = Scatter()
    settings = PlannerSettings(cone_slope=TAP.cone_slope, scatter=scatter)
    world = PhysicsWorld(model=TAP, truth=TAP, scatter=scatter)
    task = Evaluation("exact", settings, trials=60, world=world, random_tasks=(0.04, 0.35))
    found = summarise(evaluate(task, 1))
    assert found["success_rate"] == 1.0 and found["truly_inside_rate"] == 1.0
    assert found["refused_before"] == 0 and found["taps"]["mean"] < 5.0
