"""Physical part of a simulated cell with several objects on its table."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields

import cv2
import numpy as np

from lab.virtual_cell.physical_cell import PhysicalCell, Release
from lab.virtual_cell.scheduler import Scheduler
from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.hardware.scara import Joints
from tapping_cell.se2 import Pose
from tapping_cell.simulation.tabletop import Tabletop
from tapping_cell.simulation.truth import TruthFile

Outline = tuple[tuple[float, float], ...]
"""Corners of a convex polygon in ``table``, m."""
HALF_LENGTH_M, HALF_WIDTH_M = 0.2, 0.13
"""Area of the table, symmetric about its middle, in which people put objects, m."""
AWAY = Pose(2.0, 2.0, 0.0)
"""Pose of the first object that was taken off the table. Further ones are put beside it."""


@dataclass(frozen=True, slots=True)
class TableRelease(Release):
    """Ground truth of a release in a cell with several objects."""

    poses: Mapping[str, Pose]
    """Poses of all objects."""
    met: str
    """Name of the first object in the striker's path; empty if there is none."""


class PhysicalTable(PhysicalCell):
    """Parts of a cell with several objects that exist independently of any program.

    ``object_pose`` and ``view`` report the cell's own object, unless another object is regarded.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        cell: Cell,
        others: Sequence[ObjectFile],
        truth: TruthFile,
        seed: int,
    ) -> None:
        super().__init__(scheduler, cell, truth, seed)
        size = cell.file.table.length, cell.file.table.width
        files = (cell.object, *others)
        tapper = cell.file.tapper
        self.table = Tabletop(files, tapper.striker(), tapper.stroke, truth, seed, size)
        self.world = self.table.worlds[cell.object.name]
        self.radius = max(file.shape.reach() for file in files)
        """Radius of the largest object, m."""
        self.own = cell.object.name
        """Name of the cell's own object."""
        self.inner_radius = min(_inner_radius(file) for file in files)
        """Smallest distance of an outline from the middle of its object, m."""
        self.absent: set[str] = set()
        """Objects that were taken off the table."""
        self.unknown: tuple[Outline, ...] = ()
        """Outlines of the objects on the table that have no object file."""
        self._regarded = self.own
        self._seen_at: dict[str, tuple[Pose, Joints, bool]] = {}

    @contextmanager
    def regarding(self, name: str) -> Iterator[None]:
        """Let ``object_pose`` and ``view`` report this object."""
        before, self._regarded = self._regarded, name
        try:
            yield
        finally:
            self._regarded = before

    def object_pose(self, time: float) -> Pose:
        """Return the true pose of the regarded object."""
        return self.pose_of(self._regarded, time)

    def pose_of(self, name: str, time: float) -> Pose:
        """Return the true pose of an object."""
        self.table.advance(time)
        return self.table.worlds[name].pose

    def is_free(self, name: str, pose: Pose, gap: float) -> bool:
        """Return whether an object at this pose would be in the area that people use, at least
        ``gap`` m from all other objects."""
        return (
            abs(pose.x) <= HALF_LENGTH_M
            and abs(pose.y) <= HALF_WIDTH_M
            and all(depth(one, (pose.x, pose.y)) <= -self.radius - gap for one in self.unknown)
            and all(
                pose.distance_to(world.pose) >= 2.0 * self.radius + gap
                for other, world in self.table.worlds.items()
                if other != name
            )
        )

    def is_free_of_objects(self, outline: Outline, gap: float) -> bool:
        """Return whether an outline is at least ``gap`` m away from all objects."""
        return all(
            depth(outline, (world.pose.x, world.pose.y)) <= -self.radius - gap
            for world in self.table.worlds.values()
        )

    def take_away(self, name: str) -> None:
        """Take an object off the table."""
        self.absent.add(name)
        place = list(self.table.worlds).index(name)
        self.table.place(name, Pose(AWAY.x + place, AWAY.y, AWAY.theta))

    def put_back(self, name: str, pose: Pose, gap: float) -> None:
        """Put an object back on the table at this pose, or at a random pose if it is not free."""
        self.absent.discard(name)
        free = self.is_free(name, pose, gap)
        self.table.place(name, pose if free else self.table.free_pose(name))

    def _described(self, release: Release, speed: float) -> Release:
        travels = {
            name: world.travel_to_meet(release.tip, release.height, speed)
            for name, world in self.table.worlds.items()
        }
        met = min(travels, key=lambda name: travels[name])
        known = {entry.name: getattr(release, entry.name) for entry in fields(release)}
        poses = dict(self.table.poses)
        return TableRelease(**known, poses=poses, met=met if math.isfinite(travels[met]) else "")

    def _strike(self, release: Release, speed: float) -> None:
        self.table.strike(release.tip, release.height, speed, release.time)

    def _hidden(self, pose: Pose, time: float) -> bool:
        joints = self.joints(time)
        before = self._seen_at.get(self._regarded)
        if before is None or before[:2] != (pose, joints):
            before = pose, joints, self._silhouette_meets(pose, joints)
            self._seen_at[self._regarded] = before
        return before[2]


def depth(outline: Outline, point: tuple[float, float]) -> float:
    """Return how far a point is inside a convex outline, m; negative outside."""
    corners = np.array(outline, dtype=np.float32)
    return float(cv2.pointPolygonTest(corners, point, True))


def _inner_radius(file: ObjectFile) -> float:
    corners = file.shape.vertices
    if corners is None:
        return file.shape.reach()
    return depth(tuple((float(x), float(y)) for x, y in corners), (0.0, 0.0))
