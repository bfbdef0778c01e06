"""Run of one positioning cell (fixed tappers, no arm) in virtual time."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from lab.faults.fixed_faults import (
    FIXED_AT_A_SHOT,
    FIXED_MAKERS,
    FIXED_MOMENTS,
    FIXED_OF_A_SHOT,
    FIXED_SET_UP_MAKERS,
)
from lab.oracle.fixed import FixedOracle
from lab.trial import (
    NOTICED_S,
    RECOVERY_S,
    SERVES,
    SUBSCRIPTIONS,
    Trial,
)
from lab.virtual_cell.fixed_cell import PhysicalFixedCell
from lab.virtual_cell.host import Program, copy_of
from lab.virtual_cell.network import STRANGER
from lab.virtual_cell.serial_line import BusyLine, SerialLine
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.hardware.tapper import TapperDriver, TapperSettings
from tapping_cell.hardware.tapper_boards import TapperBoards
from tapping_cell.hardware.tapper_protocol import Mode
from tapping_cell.logic.fixed_goal_handling import FixedGoalHandling
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.table_maps import TableMaps
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
from tapping_cell.logic.tapper_peers import PeerLimits
from tapping_cell.messages import TapCommand, TapperState
from tapping_cell.planning.fixed_solver import GoalSolver
from tapping_cell.se2 import Pose
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.truth import TruthFile

GOALS = ((0.0, 0.0), (0.020, -0.015), (-0.025, 0.010))
"""Positions of all goals (x, y), m. There are only a few positions, because it takes a second to
compute the policy for each goal position."""
TURN_RAD = 1.0
"""Maximum rotation from the object's pose to a goal, rad. The solver of these runs uses only the
coarsest grid. On this grid, the solver may find no solution for half a turn."""
NEAR_M = 0.045
"""Maximum distance from the middle of the working area at which a person puts the object, m."""


@cache
def shipped_fixed_cell(boards: int) -> Cell:
    """Return the shipped positioning cell with its tappers spread over 1 or 2 boards."""
    cell = load_cell(shared_folder() / "positioning_cell" / "cell.yaml")
    entries = tuple(
        replace(entry, channel=index // boards, port=f"tapper_{index % boards}")
        for index, entry in enumerate(cell.fixed_tappers.tappers)
    )
    section = replace(cell.fixed_tappers, tappers=entries)
    return replace(cell, file=replace(cell.file, fixed_tappers=section))


@cache
def _solver() -> GoalSolver:
    """Return the solver that all runs of this process share; this solver uses only the coarsest
    grid."""
    return GoalSolver(finer=())


class _GoalHandling(FixedGoalHandling):
    """Goal handling with the shared solver."""

    def _prepare(self, cell: Cell, maps: TableMaps | None) -> None:
        super()._prepare(cell, maps)
        self._solver = _solver()


class FixedTrial(Trial):
    """The complete positioning cell of one seed, with one board or two. Times are in s from the
    start of the run."""

    physical: PhysicalFixedCell

    has_confirmation = False
    set_up_makers = FIXED_SET_UP_MAKERS
    devices = ("tapper_trigger",)
    nodes = ("tap_planner", "tapper_trigger")
    arm_node = "tapper_trigger"
    goal_handling = _GoalHandling
    makers = FIXED_MAKERS
    at_a_shot = FIXED_AT_A_SHOT
    of_a_shot = FIXED_OF_A_SHOT
    moments = FIXED_MOMENTS

    def _make_cell(self, seed: int) -> Cell:
        return shipped_fixed_cell(1 + seed % 2)

    def _make_physical(self, truth: TruthFile, seed: int) -> PhysicalFixedCell:
        return PhysicalFixedCell(self.scheduler, self.cell, truth, seed)

    def _make_oracle(self, unseen: float) -> FixedOracle:
        clock = self.clocks["tapper_trigger"]
        return FixedOracle(self.scheduler, self.physical, self.network, clock, unseen + NOTICED_S)

    def _covers(self) -> bool:
        return False

    def _tapper_boards(self) -> list[tuple[TapperEmulator, SerialLine]]:
        return list(zip(self.physical.boards, self.physical.lines, strict=True))

    def _lines(self) -> tuple[SerialLine, ...]:
        return tuple(self.physical.lines)

    def _busy_lines(self) -> tuple[SerialLine, ...]:
        return tuple(BusyLine(self.scheduler, line.layer, "tapper") for line in self._lines())

    def _maps(self) -> None:
        """Return None: the planner of fixed tappers uses no maps."""

    def _programs(self, *lines: SerialLine) -> dict[str, Program]:
        cell = self.cell

        def tapper() -> tuple[TapperLogic, TapperBoards]:
            draw = np.random.default_rng([self.seed, 4, round(1e6 * self.scheduler.now)])
            for line in lines:
                line.set_clock(self.clocks["tapper_trigger"].steady_offset)
            settings = TapperSettings(mode=Mode.SETUP if self.set_up else Mode.RUN)
            drivers = [
                TapperDriver(line, settings, draw_number=lambda below: int(draw.integers(below)))
                for line in lines
            ]
            limits = PeerLimits(needs_camera=True)
            return TapperLogic(TapperOptions(limits=limits, set_up=self.set_up)), TapperBoards(
                drivers
            )

        return {
            "tap_planner": Program(
                lambda: (PlannerLogic(self.settings), None),
                self._connect_planner,
                cell,
                SUBSCRIPTIONS["tap_planner"],
                SERVES["tap_planner"],
            ),
            "tapper_trigger": Program(
                tapper,
                lambda driver, patience, _: driver.connect(timeout=patience),
                cell,
                SUBSCRIPTIONS["tapper_trigger"],
                SERVES["tapper_trigger"],
                lines,
            ),
        }

    # Goals and taps

    def draw_goal(self, rng: np.random.Generator) -> Pose:
        """Choose one of ``GOALS`` at random, rotated by up to ``TURN_RAD`` relative to the
        object."""
        x, y = GOALS[int(rng.integers(len(GOALS)))]
        true = self.physical.object_pose(self.scheduler.now)
        return Pose(x, y, true.theta + float(rng.uniform(-TURN_RAD, TURN_RAD)))

    def next_goal(self, number: int) -> Pose:
        """Choose the next goal at random."""
        return self.draw_goal(self.rng)

    def _fit_to_object(self, command: TapCommand, model: TapCommand, seen: Pose) -> None:
        """Keep the poses of the last tap: a fixed mount does not follow the object."""
        command.strike_pose = copy_of(model.strike_pose)
        command.predicted_pose = copy_of(model.predicted_pose)

    def _publish_conflicting(self, command: TapCommand, conflicting: TapCommand) -> None:
        """Have two programs send commands with the same tap id to two tappers."""
        entries = self.cell.fixed_tappers.tappers
        entry = entries[int(self.rng.integers(len(entries)))]
        conflicting.tapper = entry.name
        conflicting.strike_pose = to_message(
            Pose(*entry.position, entry.direction), self.cell.strike_height
        )
        for node, message in ((STRANGER, conflicting), ("program", command)):
            self.network.publish(node, "tap_command", message)

    def _place_by_hand(self, pose: Pose) -> None:
        way = math.hypot(pose.x, pose.y)
        share = min(1.0, NEAR_M / way) if way else 1.0
        self.physical.world.place(Pose(share * pose.x, share * pose.y, pose.theta))

    def _object_lost(self) -> bool:
        pose = self.physical.object_pose(self.scheduler.now)
        return math.hypot(pose.x, pose.y) > NEAR_M + 0.01

    def recover(self) -> None:
        """Recover the cell as a person would, until it is ready for a goal: inspect it, press the
        clear buttons, and clear faults."""
        self._away_until = -math.inf
        until = self.scheduler.now + RECOVERY_S
        if self._enabler is not None:
            self._enabler.change_grip()
        while self.scheduler.now < until:
            self.scheduler.run(self.scheduler.now + 1.0)
            tapper = self._last("tapper_state")
            alive = all(process.alive and process.active for process in self.processes.values())
            if not alive or tapper is None or self._waits():
                continue
            if tapper.state == TapperState.SAFE and tapper.mounts_proven and not tapper.away:
                if not self._object_lost():
                    return
                self.physical.world.place(Pose(0.0, 0.0, 0.0))
                self.oracle.note_hand()
            elif tapper.state in (TapperState.STOPPED, TapperState.FAULT):
                self.physical.press_clear_button()
                self._ask_to_clear("tapper_trigger")
        self.oracle.violate("no way back", f"tapper {self._last('tapper_state')}")
