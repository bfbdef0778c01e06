"""Run of one cell with several objects on its table in virtual time."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from lab.faults.faults import ALL, MOMENTS, Mix, moment_name
from lab.faults.table_faults import TABLE_AT_A_SHOT, TABLE_MAKERS
from lab.oracle.oracle import Request
from lab.oracle.table import TableOracle
from lab.trial import CAMERA_SIGMA, NOTICED_S, Trial
from lab.virtual_cell.table_camera import TableCamera
from lab.virtual_cell.table_cell import HALF_LENGTH_M, HALF_WIDTH_M, PhysicalTable
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.logic.poses import to_message
from tapping_cell.messages import (
    ArrangeObjects,
    ObjectGoal,
    ObjectState,
    PlanState,
    PoseStamped,
    PositionObject,
    TapCommand,
)
from tapping_cell.se2 import Pose
from tapping_cell.simulation.truth import TruthFile

SHARE_OF_TABLES = 0.1
"""Fraction of the runs that have several objects."""
NAMES = ("second disk", "third disk")
OWN_GOAL, OTHER_GOAL = 0.35, 0.3
"""Fractions of the goals that are for the cell's own object, and for another one. The other goals
are arrangements."""
FAR_M = 0.03
"""Maximum distance of most goals from their objects, m."""
GAP_M = 0.035
"""Minimum gap between a goal and the other objects, m."""
APART_M = 0.02
"""Minimum gap between two objects at the beginning of a goal, m; a person moves closer ones
apart."""
CENTRAL_M = (0.1, 0.06)
"""Largest |x| and |y| of the area in which the goals that are not near their objects lie, m."""
TRIES = 40
SHARE_OF_OTHER_OBJECTS = 0.5
"""Fraction of the second client's goals that are action goals of another object."""


def has_several_objects(seed: int) -> bool:
    """Return whether the cell of this seed has several objects."""
    return bool(np.random.default_rng([seed, 20]).random() < SHARE_OF_TABLES)


class TableTrial(Trial):
    """The complete cell of one seed with two or three objects of the same shape. Times are in s
    from the start of the run."""

    physical: PhysicalTable
    camera: TableCamera

    makers = TABLE_MAKERS
    at_a_shot = TABLE_AT_A_SHOT
    # In a cell with several objects, a job computes the decision, which takes some time.
    moments = (*MOMENTS, moment_name("plan_state", PlanState.PLANNING))
    has_set_up, has_confirmation = False, False

    def __init__(
        self, seed: int, trace: bool = False, *, faults: bool = True, mix: Mix = ALL
    ) -> None:
        """``faults``: whether to inject faults; ``mix``: distribution of the faults."""
        self._goal_rng = np.random.default_rng([seed, 21])
        count = 1 + int(self._goal_rng.integers(len(NAMES)))
        self._names = NAMES[:count]
        self._second_rng = np.random.default_rng([seed, 24])
        self._goals: dict[str, Pose] = {}
        self._is_arrangement = False
        self._arranged_in_order = False
        self._may_move: tuple[str, ...] = ()
        super().__init__(seed, trace, faults=faults, mix=mix)

    def _other_files(self) -> tuple[ObjectFile, ...]:
        return tuple(replace(self.cell.object, name=name) for name in self._names)

    def _make_physical(self, truth: TruthFile, seed: int) -> PhysicalTable:
        return PhysicalTable(self.scheduler, self.cell, self._other_files(), truth, seed)

    def _make_oracle(self, unseen: float) -> TableOracle:
        clock = self.clocks["tapper_trigger"]
        return TableOracle(self.scheduler, self.physical, self.network, clock, unseen + NOTICED_S)

    def _make_camera(self) -> TableCamera:
        return TableCamera(
            self.scheduler,
            np.random.default_rng([self.seed, 3]),
            self._observe,
            lambda: self.clocks["camera_pose"].now().ros,
            self.network,
            self.cell.object.name,
            CAMERA_SIGMA,
            self._names,
            self._observe_other,
            self.physical.absent,
            lambda: self.physical.unknown,
        )

    def _observe_other(self, name: str, time: float) -> Pose | None:
        with self.physical.regarding(name):
            return self._observe(time)

    # Goals

    def next_goal(self, number: int) -> Pose:
        """Choose the next goal at random: of the cell's own object, of another object, or an
        arrangement. Return the goal of its first object."""
        self.physical.unknown = ()  # a person clears the table before the next goal
        rng, own = self._goal_rng, self.cell.object.name
        kind = rng.random()
        if kind < OWN_GOAL:
            names: tuple[str, ...] = (own,)
        elif kind < OWN_GOAL + OTHER_GOAL:
            names = (self._names[int(rng.integers(len(self._names)))],)
        else:
            everything = (own, *self._names)
            count = 1 + int(rng.integers(len(everything)))
            names = tuple(str(name) for name in rng.permutation(everything)[:count])
        goals: dict[str, Pose] = {}
        for name in names:
            goals[name] = self._goal_of(name, goals)
        self._goals, self._is_arrangement = goals, kind >= OWN_GOAL + OTHER_GOAL
        self._arranged_in_order = bool(rng.random() < 0.3)
        others = tuple(name for name in (own, *self._names) if name not in goals)
        self._may_move = others if rng.random() < 0.5 else ()
        return goals[names[0]]

    def _goal_of(self, name: str, chosen: dict[str, Pose]) -> Pose:
        """Choose a goal that is free of the other objects and of the chosen goals. In 80 % of the
        cases, the goal is near the object."""
        rng, now = self._goal_rng, self.scheduler.now
        here = self.physical.pose_of(name, now)
        taken = [
            chosen.get(other, self.physical.pose_of(other, now))
            for other in self.physical.table.worlds
            if other != name
        ]
        taken += [self.physical.pose_of(other, now) for other in chosen]
        near = rng.random() < 0.8
        for _ in range(TRIES):
            way, angle = rng.uniform(0.0, FAR_M), rng.uniform(-math.pi, math.pi)
            x, y = here.x + way * math.cos(angle), here.y + way * math.sin(angle)
            if not near:
                x, y = rng.uniform(np.negative(CENTRAL_M), CENTRAL_M)
            goal = Pose(
                float(np.clip(x, -0.15, 0.15)),
                float(np.clip(y, -0.1, 0.1)),
                float(here.theta + rng.uniform(-0.3, 0.3)),
            )
            if all(goal.distance_to(p) > 2.0 * self.physical.radius + GAP_M for p in taken):
                return goal
        return here

    def send_goal(self, goal: Pose, foreign: bool = False) -> None:
        """Send an action goal to the planner if the planner's process is running. ``foreign``: send
        the goal of a second client instead; it is for the cell's own object or another one."""
        rng, process = self._second_rng, self.processes["tap_planner"]
        other = foreign and process.alive and rng.random() < SHARE_OF_OTHER_OBJECTS
        if not other:
            super().send_goal(goal, foreign)
            return
        name = self._names[int(rng.integers(len(self._names)))]
        asked = self.oracle.on_goal_sent({name: goal}, self.cell.tolerance)
        message = PoseStamped(pose=to_message(goal))
        message.header.frame_id = "table"
        request = self._goal_for(name, message)
        self._note(f"a second client's goal for '{name}': {goal}")
        process.request(
            "position_object",
            request,
            ("second client", id(asked)),
            lambda result: self.oracle.check_result(asked, result, self.tap_limit),
        )

    def _request(self, message: PoseStamped) -> tuple[str, Any, Request]:
        asked = self.oracle.on_goal_sent(self._goals, self.cell.tolerance)
        if not self._is_arrangement:
            (name,) = self._goals
            return "position_object", self._goal_for(name, message), asked
        goals = []
        for name, pose in self._goals.items():
            stamped = PoseStamped(header=message.header, pose=to_message(pose))
            goals.append(ObjectGoal(object_id=name, goal_pose=stamped))
        arrangement = ArrangeObjects.Goal(
            goals=goals,
            in_order=self._arranged_in_order,
            may_move=list(self._may_move),
            time_limit=self._goal_limit,
            max_taps=self.tap_limit,
        )
        return "arrange_objects", arrangement, asked

    def _goal_for(self, name: str, message: PoseStamped) -> PositionObject.Goal:
        return PositionObject.Goal(
            goal_pose=message,
            object_id=name,
            time_limit=self._goal_limit,
            max_taps=self.tap_limit,
        )

    # Taps of another program

    def _state_for(self, tap_id: int) -> ObjectState | None:
        """Return the last published state of the object of a tap."""
        states = self._last("object_states")
        if states is None or tap_id not in self.oracle.commands:
            return None
        name = self.oracle.commands[tap_id].object_id or self.cell.object.name
        found: ObjectState = next(one for one in states.objects if one.object_id == name)
        return found

    def _fit_to_object(self, command: TapCommand, model: TapCommand, there: Pose) -> None:
        """Command a tap of the same object as the last one."""
        command.object_id = model.object_id
        super()._fit_to_object(command, model, there)

    # People

    def _place_by_hand(self, pose: Pose) -> None:
        x = float(np.clip(pose.x, -HALF_LENGTH_M, HALF_LENGTH_M))
        y = float(np.clip(pose.y, -HALF_WIDTH_M, HALF_WIDTH_M))
        place = Pose(x, y, pose.theta)
        own = self.cell.object.name
        before = self.physical.pose_of(own, self.scheduler.now)
        # A hand does not push the object into another one.
        if place[:2] == before[:2] or self.physical.is_free(own, place, 0.0):
            self.physical.table.place(own, place)

    def _object_lost(self) -> bool:
        now = self.scheduler.now
        return any(
            name not in self.physical.absent
            and not self.physical.is_free(name, self.physical.pose_of(name, now), APART_M)
            for name in self.physical.table.worlds
        )

    def _put_back(self) -> None:
        """Spread the objects on the table, and take away those without an object file."""
        self.physical.unknown = ()
        table = self.physical.table
        present = [name for name in table.worlds if name not in self.physical.absent]
        for name in present:
            self.oracle.note_hand(name)
        table.spread(present)
