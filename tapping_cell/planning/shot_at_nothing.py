"""A single shot that hits nothing, to test arm and tapper during set-up.

The shot passes every check of a tap, but the striker's path keeps a margin from all objects.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.free_space import FreeSpace
from tapping_cell.planning.gains import Gains
from tapping_cell.planning.goal import others_text, place_text
from tapping_cell.planning.interface import Array
from tapping_cell.planning.prescribed import METHOD, PrescribedSession, Prescription
from tapping_cell.planning.refusal import Refusal, RefusalReason
from tapping_cell.planning.session import Decision, Done, Strike
from tapping_cell.planning.strike import StrikeSpace
from tapping_cell.se2 import Pose, unit_vectors

MARGIN_M = 0.020
"""Minimum distance from the ball tip, anywhere on its stroke, to every object and keep-out."""
GRID_M, HEADINGS, PATH_POINTS = 0.030, 24, 9


class ShotAtNothing(PrescribedSession):
    """Session of one shot, with the interface of a prescribed tap. It teaches the model nothing."""

    def __init__(
        self, speed: float, stroke: float, space: StrikeSpace, free: FreeSpace, gains: Gains
    ) -> None:
        """``speed`` of the striker in m/s; ``stroke``: its longest travel, m."""
        super().__init__(Prescription(speed, 0.0), space, free, gains, adapt=False)
        self._stroke = stroke

    def decide(
        self,
        object_pose: ArrayLike,
        covariance: ArrayLike | None = None,
        in_view: ArrayLike | None = None,
    ) -> Decision:
        """Return the shot whose path is farthest from the object, Done after the shot, or why there
        is no such path. Arguments as in :meth:`PrescribedSession.decide`."""
        if self._tapped is not None:
            return Done(Pose(0.0, 0.0, 0.0), None)
        pose, space = np.asarray(object_pose, dtype=float), self._space
        rest = _tips(space)
        gap = self._gap(pose, rest)
        rest, gap = rest[gap >= MARGIN_M], gap[gap >= MARGIN_M]
        fits = (
            np.any(space.elbows(rest), axis=-1)
            & space.tool_is_clear(rest)
            & space.tool_clears_object(pose, rest)
        )
        if not np.any(fits):
            return Refusal(
                RefusalReason.NO_STRIKE,
                f"no place within the arm's reach lets the striker shoot at nothing: its stroke of "
                f"{1e3 * self._stroke:.0f} mm must end {1e3 * MARGIN_M:.0f} mm from the object at "
                f"{place_text(pose)}; move the object" + others_text(space),
            )
        tip = rest[fits][np.argmax(gap[fits])]
        contact = tip.copy()
        contact[:2] += space.settings.standoff * unit_vectors(tip[2])
        nothing, here = Pose(0.0, 0.0, 0.0), Pose(*pose.tolist())
        return Strike(
            commanded=nothing,
            wanted=nothing,
            predicted=here,
            residual=nothing,
            plan=space.plan_at(0.0, contact, self.prescription.striker_speed),
            method=METHOD,
        )

    def predicted_covariance(self, strike: Strike, pose: Pose) -> Array:
        """Return zeros (3, 3): the object does not move."""
        return np.zeros((3, 3))

    def _gap(self, pose: Array, rest: Array) -> Array:
        """Return the smallest distance of the ball tip to the object, a keep-out and the table's
        edge during the strokes from the rest poses (n, 3): (n,), m."""
        along = np.linspace(0.0, self._stroke, PATH_POINTS)[:, None]
        path = rest[:, None, :2] + along * unit_vectors(rest[:, 2])[:, None]
        table, radius = self._space.workspace, self._space.tip_radius
        object_gap = np.hypot(*np.moveaxis(path - pose[:2], -1, 0)) - self._space.object_radius
        gaps = (object_gap, table.keep_out_distance(path), table.edge_distance(path))
        return np.asarray(np.minimum.reduce(gaps).min(axis=-1) - radius)


def _tips(space: StrikeSpace) -> Array:
    """Return tip poses (n, 3) all over the table, in all directions."""
    x, y = (
        np.arange(-size / 2 + GRID_M, size / 2, GRID_M)
        for size in (space.workspace.length, space.workspace.width)
    )
    angle = np.linspace(-math.pi, math.pi, HEADINGS, endpoint=False)
    return np.stack(np.meshgrid(x, y, angle, indexing="ij"), axis=-1).reshape(-1, 3)
