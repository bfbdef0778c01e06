"""Taps in the simulated world without devices and images. One tap takes about 10 ms."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.configuration.schema import load
from tapping_cell.mechanics import Tap
from tapping_cell.mechanics.tap import tips_at_rest
from tapping_cell.se2 import Pose
from tapping_cell.simulation.truth import TruthFile
from tapping_cell.simulation.world import World

Array = NDArray[np.float64]

PATH_STEP_S = 1 / 240
"""Interval between the poses of a path, s."""


@dataclass(frozen=True, slots=True)
class SimulatedTaps:
    """Simulates the taps of an evaluation.

    ``model``: mechanics of the planner, which place the striker. ``content``:
    object file to which ``truth`` is relative. ``standoff``: distance from the tip at rest to the
    contact, m. ``stroke``: maximum travel of the tip, m. ``round_position``, ``round_angle``:
    increments to which the tip's pose at rest is rounded (m, rad); 0 for none.
    """

    model: Tap
    content: ObjectFile
    truth: TruthFile
    standoff: float = 0.015
    stroke: float = 0.05
    round_position: float = 0.0
    round_angle: float = 0.0
    _path: list[tuple[float, Pose]] = field(default_factory=list, compare=False, repr=False)

    def path(self) -> tuple[Array, Array]:
        """Return times (n,) at steps of ``PATH_STEP_S`` and the object's poses (n, 3) of the last
        tap, from before the strike until the object is at rest."""
        times, poses = zip(*self._path, strict=True)
        return np.array(times), np.array(poses)

    def answer(
        self,
        poses: Array,
        seen: Array,
        commanded: Array,
        gains: Array,
        rng: np.random.Generator,
    ) -> Array:
        """Return the true displacements (n, 3) of taps on objects at ``poses``; each tap was
        planned for the pose in ``seen``.

        All arrays except ``gains`` are (n, 3) in ``table`` axes. ``gains`` (n, 4): the simulated
        distance is multiplied by the first column, and the rotation by the second. The other two
        columns are ignored, because ``truth`` contains the centre of mass. A tap that misses does
        not move the object.
        """
        plan = self.model.plan(commanded, seen)
        tips = tips_at_rest(plan.strike_pose, self.standoff, self.round_position, self.round_angle)
        world = World(self.content, self.model.impact.striker, self.stroke, self.truth, rng)
        world.advance(0.0)
        moved = np.empty((len(tips), 3))
        now = 0.0
        for index, (pose, tip, speed) in enumerate(
            zip(poses.tolist(), tips.tolist(), plan.striker_speed.tolist(), strict=True)
        ):
            start = Pose(*pose)
            world.place(start)
            world.strike(Pose(*tip), self.content.height / 2, speed, now)
            self._path[:] = [(now, start)]
            while True:
                now += PATH_STEP_S
                world.advance(now)
                self._path.append((now, world.pose))
                if world.at_rest:
                    break
            end = world.pose
            moved[index] = end.x - start.x, end.y - start.y, start.rotation_to(end)
        return moved * np.asarray(gains)[:, [0, 0, 1]]


class SimulatedTable:
    """A table with the cell's object: an observation and a tap are one call each.

    The object starts at the pose in ``truth``. The camera has the noise in the cell file.
    """

    def __init__(
        self, cell: Cell, truth: TruthFile | None = None, seed: int | np.random.Generator = 0
    ) -> None:
        """``truth``: simulation parameters; None for those of the package."""
        self._cell = cell
        self._random = np.random.default_rng(seed)
        if truth is None:
            truth = load(TruthFile, shared_folder() / "truth" / "default.yaml")
        tapper = cell.file.tapper
        self._world = World(cell.object, tapper.striker(), tapper.stroke, truth, self._random)
        self._now = 0.0
        self._world.advance(self._now)

    @property
    def pose(self) -> Pose:
        """True pose of the object in `table`."""
        return self._world.pose

    def place(self, pose: Pose) -> None:
        """Place the object at a pose in `table`, at rest."""
        self._world.place(pose)

    def observe(self) -> tuple[Array, Array]:
        """Return a measured pose (3,) of the object, m and rad, and its covariance (3, 3)."""
        noise = self._cell.file.camera
        deviations = np.array([noise.position_noise, noise.position_noise, noise.angle_noise])
        seen = np.array(self.pose) + deviations * self._random.standard_normal(3)
        return seen, np.diag(deviations**2)

    def tap(self, strike_pose: Pose, striker_speed: float) -> None:
        """Fire the striker with its tip at rest at ``strike_pose``, at a speed in m/s, and wait
        until the object is at rest."""
        self._world.strike(strike_pose, self._cell.object.height / 2, striker_speed, self._now)
        self._now = self._world.settle()
