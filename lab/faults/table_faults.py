"""Random faults of the other objects in a cell with several objects."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from lab.faults.fault_target import FaultTarget, Made, Maker
from lab.faults.faults import AT_A_SHOT, MAKERS, draw_duration
from lab.virtual_cell.table_camera import TableCamera
from lab.virtual_cell.table_cell import (
    HALF_LENGTH_M,
    HALF_WIDTH_M,
    Outline,
    PhysicalTable,
)
from tapping_cell.se2 import Pose

GAP_M = 0.01
"""Minimum gap between an object that a hand moves and the others, m."""
LAID_S, UNKNOWN_SIZE_M, UNKNOWN_GAP_M = (2.0, 60.0), (0.01, 0.03), (0.005, 0.05)
"""Ranges for an object without an object file: time for which it lies on the table, s, distance of
its corners from its middle, and gap to the object behind which it is laid, m."""
HIDDEN_S, REMOVED_S = (0.1, 4.0), (0.5, 60.0)
"""Ranges of the time for which another object is hidden, or taken off the table, s. After 5 s
without observation, the planner assumes that an object was removed."""
LINKS = (
    ("object_states", "tap_planner"),
    ("object_states", "tapper_trigger"),
    ("unknown_objects", "tap_planner"),
)


def _parts(trial: FaultTarget) -> tuple[PhysicalTable, TableCamera]:
    table, camera = trial.physical, trial.camera
    assert isinstance(table, PhysicalTable) and isinstance(camera, TableCamera)
    return table, camera


def _name(rng: np.random.Generator, trial: FaultTarget) -> str:
    table = _parts(trial)[0]
    others = tuple(name for name in table.table.worlds if name != table.own)
    return others[int(rng.integers(len(others)))]


def _moved(rng: np.random.Generator, trial: FaultTarget) -> Made:
    name, way = _name(rng, trial), draw_duration(rng, 0.003, 0.06)
    angle, turn = float(rng.uniform(-math.pi, math.pi)), float(rng.normal(0, 0.4))
    shift = Pose(way * math.cos(angle), way * math.sin(angle), turn)
    return partial(_shift, name=name, shift=shift), f"'{name}' is moved by {1e3 * way:.0f} mm"


def _turned(rng: np.random.Generator, trial: FaultTarget) -> Made:
    name, turn = _name(rng, trial), float(rng.normal(0, 0.4))
    return partial(_shift, name=name, shift=Pose(0.0, 0.0, turn)), (
        f"'{name}' is turned by {math.degrees(turn):.0f} deg"
    )


def _shift(trial: FaultTarget, name: str, shift: Pose) -> None:
    table, _ = _parts(trial)
    before = table.pose_of(name, trial.scheduler.now)
    after = Pose(before.x + shift.x, before.y + shift.y, before.theta + shift.theta)
    if name in table.absent or not table.is_free(name, after, GAP_M):
        return
    trial.oracle.note_hand(name)
    table.table.place(name, after)


def _hidden(rng: np.random.Generator, trial: FaultTarget) -> Made:
    name, lasting = _name(rng, trial), draw_duration(rng, *HIDDEN_S)

    def strike(t: FaultTarget) -> None:
        camera, now = _parts(t)[1], t.scheduler.now
        if now >= camera.others_hidden_until[name]:
            t.oracle.hide(name)
            camera.others_hidden_until[name] = now + lasting
            t.scheduler.after(lasting, lambda: t.oracle.uncover(name))

    return strike, f"'{name}' hidden for {lasting:.2f} s"


def _removed(rng: np.random.Generator, trial: FaultTarget) -> Made:
    name, lasting = _name(rng, trial), draw_duration(rng, *REMOVED_S)

    def strike(t: FaultTarget) -> None:
        table, _ = _parts(t)
        before = table.pose_of(name, t.scheduler.now)
        if name in table.absent:
            return
        t.oracle.note_hand(name)
        table.take_away(name)
        t.scheduler.after(lasting, partial(put_back, t, before))

    def put_back(t: FaultTarget, pose: Pose) -> None:
        table, _ = _parts(t)
        t.oracle.note_hand(name)
        table.put_back(name, pose, GAP_M)

    return strike, f"'{name}' taken off the table for {lasting:.1f} s"


def _unknown_laid(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Somebody lays an object without an object file on the table and takes it away later. It often
    lies behind an object that is to be tapped, where the striker would be placed."""
    behind, lasting = rng.random() < 0.7, draw_duration(rng, *LAID_S)
    size, gap = float(rng.uniform(*UNKNOWN_SIZE_M)), float(rng.uniform(*UNKNOWN_GAP_M))
    turn, choice = float(rng.normal(0.0, 0.3)), int(rng.integers(1000))
    place = rng.uniform((-HALF_LENGTH_M, -HALF_WIDTH_M), (HALF_LENGTH_M, HALF_WIDTH_M))
    corners = rng.uniform(-math.pi, math.pi) + np.linspace(
        0.0, 2.0 * math.pi, int(rng.integers(3, 7)), endpoint=False
    )

    def middle(t: FaultTarget) -> tuple[float, float]:
        table, _ = _parts(t)
        goals = list(t.pursued_goals().items())
        if not behind or not goals:
            return float(place[0]), float(place[1])
        name, goal = goals[choice % len(goals)]
        here = table.pose_of(name, t.scheduler.now)
        back = math.atan2(here.y - goal.y, here.x - goal.x) + turn
        way = table.radius + gap + size
        return here.x + way * math.cos(back), here.y + way * math.sin(back)

    def strike(t: FaultTarget) -> None:
        table, (x, y) = _parts(t)[0], middle(t)
        outline = tuple(
            # Messages have single precision.
            (float(np.float32(x + size * math.cos(a))), float(np.float32(y + size * math.sin(a))))
            for a in corners
        )
        if not table.unknown and table.is_free_of_objects(outline, 0.5 * UNKNOWN_GAP_M[0]):
            table.unknown = (outline,)
            t.scheduler.after(lasting, partial(take_away, table, outline))

    def take_away(table: PhysicalTable, outline: Outline) -> None:
        table.unknown = tuple(one for one in table.unknown if one is not outline)

    where = "behind a tapped object" if behind else "somewhere"
    return strike, f"unknown object {where} for {lasting:.1f} s"


def _late_states(rng: np.random.Generator, trial: FaultTarget) -> Made:
    topic, towards = LINKS[int(rng.integers(len(LINKS)))]
    delay, lasting = draw_duration(rng, 0.05, 2.0), draw_duration(rng, 0.2, 6.0)

    def strike(t: FaultTarget) -> None:
        t.network.faults.slow[topic, towards] = delay
        t.scheduler.after(lasting, partial(t.network.end_delay, topic, towards))

    return strike, f"{topic} to {towards} delayed by {delay:.2f} s for {lasting:.1f} s"


OTHERS: dict[str, Maker] = {
    "other object moved": _moved,
    "other object turned": _turned,
    "other object hidden": _hidden,
    "other object removed": _removed,
    "unknown object": _unknown_laid,
    "late object states": _late_states,
}
TABLE_MAKERS: dict[str, Maker] = {**MAKERS, **OTHERS}
TABLE_AT_A_SHOT = (
    *AT_A_SHOT,
    *("other object moved",) * 12,
    *("other object turned", "other object hidden", "other object removed") * 3,
    *("late object states", "unknown object") * 3,
)
