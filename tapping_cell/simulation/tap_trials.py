"""Taps in the simulated world to evaluate planners: many trials without devices or images.

One tap takes about 10 ms. ``answer`` has the signature that ``planning.evaluation`` requires.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.mechanics import Tap
from tapping_cell.mechanics.tap import tips_at_rest
from tapping_cell.se2 import Pose
from tapping_cell.simulation.truth import TruthFile
from tapping_cell.simulation.world import World

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SimulatedTaps:
    """Simulates taps, with the striker placed according to the planner's mechanics.

    ``model``: mechanics of the planner, which convert a displacement into a strike. ``content``:
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
            now = world.settle()
            end = world.pose
            moved[index] = end.x - start.x, end.y - start.y, start.rotation_to(end)
        return moved * np.asarray(gains)[:, [0, 0, 1]]
