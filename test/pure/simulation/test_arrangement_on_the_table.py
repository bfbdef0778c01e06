"""An arrangement in the simulated world: a tap that hits another object is noticed and
corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tapping_cell.configuration.assembly import make_planner_settings, make_strike_space
from tapping_cell.configuration.cell import load_cell
from tapping_cell.planning import FreeSpace, make_planner
from tapping_cell.planning.arrangement import (
    AllDone,
    ArrangementSession,
    Body,
    Observation,
    ObserveLonger,
    TapOf,
)
from tapping_cell.planning.interface import Array
from tapping_cell.se2 import Pose
from tapping_cell.simulation.tabletop import Tabletop
from tapping_cell.simulation.truth import TruthFile

CELL = load_cell()
STRIKER, STROKE = CELL.file.tapper.striker(), CELL.file.tapper.stroke
TABLE = CELL.file.table
ONE, OTHER = CELL.object.name, "second disk"
STARTS = {ONE: Pose(-0.12, 0.0, 0.0), OTHER: Pose(0.06, 0.005, 0.0)}
GOALS = {ONE: Pose(-0.05, 0.0, 0.0), OTHER: STARTS[OTHER]}
"""The second disk starts at its goal. When the first disk is at its goal, the gap between them is
20 mm."""


def tabletop() -> Tabletop:
    files = (CELL.object, replace(CELL.object, name=OTHER))
    truth = TruthFile(object_start=tuple(STARTS[ONE]), further_starts=(tuple(STARTS[OTHER]),))
    size = (TABLE.length, TABLE.width)
    top = Tabletop(files, STRIKER, STROKE, truth, 1, size)
    top.advance(0.0)
    return top


def bodies() -> list[Body]:
    space = make_strike_space(CELL)
    free, planner = (
        FreeSpace(space),
        make_planner("exact", make_planner_settings(CELL, CELL.tolerance)),
    )
    return [Body(name, free, planner, goal) for name, goal in GOALS.items()]


class Camera:
    """Observes the true poses with the camera's noise; a longer observation has less noise."""

    def __init__(self, body: Body) -> None:
        self._noise = body.planner.settings.camera
        self._random = np.random.default_rng(5)

    def observe(self, top: Tabletop, frames: int = 1) -> dict[str, Observation]:
        noise: Array = np.array([self._noise.position, self._noise.position, self._noise.angle])
        noise = noise / np.sqrt(frames)
        return {
            name: Observation(
                Pose(*(np.array(pose) + noise * self._random.standard_normal(3)).tolist()),
                np.diag(noise**2),
            )
            for name, pose in top.poses.items()
        }


@pytest.mark.parametrize("too_strong", [1, 0])
def test_after_a_contact_both_objects_are_brought_to_their_goals(too_strong: int) -> None:
    """The first ``too_strong`` taps have three times the planned speed. The first disk therefore
    hits the other one, although the planner leaves a clearance for slides of several times the
    planned length. Without such taps, the disks do not touch."""
    top, now = tabletop(), 0.0
    table = bodies()
    session, camera = ArrangementSession(table), Camera(table[0])
    contacts, touched, names = 0, [], []
    while True:
        seen = camera.observe(top)
        decision = session.decide(seen, observe_again=True)
        if isinstance(decision, ObserveLonger):
            seen = camera.observe(top, 16)
            decision = session.decide(seen)
        touched += session.touched
        if not isinstance(decision, TapOf):
            break
        assert sum(session.taps.values()) < 40
        names.append(decision.name)
        plan = decision.strike.plan
        speed = plan.striker_speed * (3.0 if len(names) <= too_strong else 1.0)
        height = CELL.file.arm.strike_height if CELL.file.arm else 0.0
        assert top.strike(plan.strike_pose, height, speed, now)
        while not top.at_rest or top.worlds[decision.name].struck:
            now += 0.02
            top.advance(now)
        now += 0.5
        top.advance(now)
        before = seen[decision.name]
        session.observe(decision, before, camera.observe(top)[decision.name])
        contacts += len(top.take_contacts())
    assert isinstance(decision, AllDone), decision
    settings = table[0].planner.settings
    for name, goal in GOALS.items():
        true = top.poses[name]
        assert true.distance_to(goal) <= settings.tolerance_position
        assert abs(true.rotation_to(goal)) <= settings.tolerance_angle
    if too_strong:
        assert contacts >= 1 and OTHER in touched and OTHER in names
    else:
        assert contacts == 0 and not touched and set(names) == {ONE}
