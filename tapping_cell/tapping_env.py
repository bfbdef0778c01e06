"""The simulated cell as a gymnasium environment, for policies that are learnt.

    gymnasium.make("tapping_cell.tapping_env:Tapping-v0")

One episode is one task: an object on the table and a goal. One action is one tap; the simulated
world computes its result. After each tap, the camera observes the object as long as a cell does
that confirms a goal, so an episode ends when the cell would report that the goal is reached.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "TappingEnv needs gymnasium: pip install '.[gym]'", name=error.name
    ) from error

from tapping_cell.configuration.assembly import make_planner_settings, make_strike_space
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.planning import PlanningError, check_goal
from tapping_cell.planning.stopping import LONG_OBSERVATION
from tapping_cell.se2 import Array, Pose, difference, displaced
from tapping_cell.simulation.tap_trials import SimulatedTable
from tapping_cell.simulation.truth import TruthFile

MOST_TAPS = 20
"""Number of taps after which an episode of the registered environment is truncated."""

START_AREA = 0.05
"""Half width of the square in the middle of the table where objects start, m."""


class TappingEnv(gymnasium.Env[NDArray[np.float64], NDArray[np.float64]]):
    """Position an object by taps.

    Observation: measured pose of the object, then the goal; x, y (m), theta (rad) in ``table``,
    (6,).
    Action: displacement of the object that the tap shall cause: dx, dy (m), dtheta (rad) in
    ``table``, (3,). Its length is limited to the shortest and the longest tap, its rotation to what
    a tap of this length can cause.
    Reward: -1 for each tap, and -20 more if the object's centre leaves the table, so that this
    costs more than any number of taps.
    Terminated: the goal is reached with the confidence that the cell requires, or the object's
    centre has left the table.
    ``info``: ``reached``; ``inside``, whether the true pose is within the tolerance; ``possible``,
    whether arm and striker could make the tap. A tap that they cannot make counts and leaves the
    object where it is.

    Args:
        cell: the cell and its object; None for those of the package.
        truth: simulation parameters; None for those of the package.
        task: largest distance (m) and rotation (rad) from start to goal. ``reset`` draws both, or
            takes the displacement ``options={"goal": (dx, dy, dtheta)}``.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (declared so by gymnasium)

    def __init__(
        self,
        cell: Cell | None = None,
        truth: TruthFile | None = None,
        task: tuple[float, float] = (0.040, math.radians(20.0)),
    ) -> None:
        self._cell = load_cell() if cell is None else cell
        self._truth, self._task = truth, task
        self._space = make_strike_space(self._cell)
        self.settings = make_planner_settings(self._cell, self._cell.tolerance)
        """Cone, limits and scatter of a tap, tolerance and camera."""
        table, far = self._cell.file.table, self.settings.largest_distance
        # A slide may end beyond the edge of the table.
        pose = np.array([table.length, table.width, math.pi])
        self.observation_space = gymnasium.spaces.Box(
            -np.tile(pose, 2), np.tile(pose, 2), dtype=np.float64
        )
        most = np.array([far, far, self.settings.cone_slope * far])
        self.action_space = gymnasium.spaces.Box(-most, most, dtype=np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Place the object and draw a goal.

        Raises:
            PlanningError: ``options`` has another key than ``goal``, or its goal is not a possible
                one of this table.
        """
        super().reset(seed=seed)
        unknown = sorted(set(options or {}) - {"goal"})
        if unknown:
            raise PlanningError(f"reset has no option {', '.join(unknown)}; the only one is goal")
        random = self.np_random
        self._table = SimulatedTable(self._cell, self._truth, random)
        x, y = random.uniform(-START_AREA, START_AREA, 2).tolist()
        self._table.place(Pose(x, y, float(random.uniform(-math.pi, math.pi))))
        heading, far, turn = random.uniform([-math.pi, 0.0, -1.0], [math.pi, 1.0, 1.0])
        distance = self._task[0] * far
        drawn = (distance * math.cos(heading), distance * math.sin(heading), self._task[1] * turn)
        self._goal = displaced(np.array(self._table.pose), self._displacement(options, drawn))
        refused = check_goal(self._goal, self._space) if options else None
        if refused is not None:
            raise PlanningError(refused.sentence)
        self._seen = self._observe()[0]
        return self._observation(), self._info(False, True)

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Make one tap and observe the object."""
        strike = self._space.first_strike(Pose(*self._seen.tolist()), self.limited(action)[None])
        if strike is not None:
            self._table.tap(strike[1].strike_pose, strike[1].striker_speed)
        self._seen, covariance = self._observe()
        arrival = self.settings.arrival(difference(self._seen, self._goal), covariance)
        reached = bool(arrival.done)
        off = bool(self._space.workspace.edge_distance(self._seen[:2]) < 0.0)
        info = self._info(reached, strike is not None)
        reward = -1.0 - (MOST_TAPS if off else 0)
        return self._observation(), reward, reached or off, False, info

    @staticmethod
    def _displacement(options: dict[str, Any] | None, drawn: tuple[float, float, float]) -> Array:
        """Return the displacement (3,) from start to goal."""
        given = (options or {}).get("goal", drawn)
        wanted = np.asarray(given, dtype=float)
        if wanted.shape != (3,):
            raise PlanningError(
                f"goal is {given!r}; give the displacement (dx, dy, dtheta), m, rad"
            )
        return wanted

    def limited(self, action: Array) -> Array:
        """Return the displacement (3,) of the tap that is made for an action."""
        settings = self.settings
        dx, dy, turn = np.asarray(action, dtype=float).tolist()
        wanted = math.hypot(dx, dy)
        size = min(max(wanted, settings.smallest_distance), settings.largest_distance)
        heading = math.atan2(dy, dx)
        most = settings.cone_slope * size
        return np.array(
            [size * math.cos(heading), size * math.sin(heading), min(max(turn, -most), most)]
        )

    def _observe(self) -> tuple[Array, Array]:
        """Return the mean (3,) of a long observation and its covariance (3, 3)."""
        first, covariance = self._table.observe()
        others = [self._table.observe()[0] for _ in range(LONG_OBSERVATION - 1)]
        mean = np.mean([np.zeros(3), *(difference(first, pose) for pose in others)], axis=0)
        return displaced(first, mean), covariance / LONG_OBSERVATION

    def _observation(self) -> Array:
        return np.concatenate([self._seen, self._goal])

    def _info(self, reached: bool, possible: bool) -> dict[str, Any]:
        left = difference(self._table.pose, self._goal)
        inside = bool(self.settings.within_tolerance(left))
        return {"reached": reached, "inside": inside, "possible": possible}


gymnasium.register("Tapping-v0", f"{__name__}:TappingEnv", max_episode_steps=MOST_TAPS)
