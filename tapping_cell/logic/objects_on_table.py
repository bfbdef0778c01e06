"""The objects on the table, at their last observed poses: for the object that is tapped, the others
are obstacles.

They include objects without an object file; only the outlines of such objects are known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.logic.clock import Now
from tapping_cell.logic.peer_clock import PeerClock
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import ObjectState, Time, UnknownObjects
from tapping_cell.planning import CircleArea, KeepOut, PolygonArea
from tapping_cell.se2 import Pose, transform_points

FARTHEST_M = 5.0
"""Maximum coordinates of an object on the table, m; observations beyond it are wrong."""
UNKNOWN = "unknown object"
"""Prefix of the names of the objects without an object file."""


@dataclass(slots=True)
class _Known:
    """Last observations of one object; times in s of the steady clock."""

    stamp: Time = field(default_factory=Time)
    observed_at: float = -math.inf
    pose: Pose | None = None
    seen_at: float = -math.inf
    """Time at which it was last seen, or the arm may have hidden it."""


class ObjectsOnTable:
    """Poses of the cell's objects, and areas of the objects without an object file.

    An object that is no longer seen keeps its pose for a while, because a hand may hide it, and for
    as long as the arm may hide it. After that time, the object counts as removed.
    """

    def __init__(self, files: Sequence[ObjectFile], memory: float, moved: float) -> None:
        """``files``: every object of the cell; ``memory`` in s; ``moved``: minimum displacement in
        m that counts as motion."""
        self._files = tuple(files)
        self.memory = memory
        """Time after which an unseen object counts as removed, s."""
        self._moved = moved
        self._known: dict[str, _Known] = {}
        self._unknown: tuple[PolygonArea, ...] = ()
        self._searches = False
        self._searched_at = -math.inf

    @property
    def files(self) -> tuple[ObjectFile, ...]:
        """Object files of the cell's objects."""
        return self._files

    def on_object(
        self, message: ObjectState, clock: PeerClock, now: Now, covered: bool = False
    ) -> None:
        """Process the last observation of one object; ``clock``: clock of the camera's computer.
        ``covered``: the arm may hide the object's last pose."""
        shape = next((file.shape for file in self._files if file.name == message.object_id), None)
        if shape is None:
            return
        known = self._known.setdefault(message.object_id, _Known())
        if covered:
            known.seen_at = now.steady
        if message.header.stamp == known.stamp:  # the object was not searched for since then
            return
        known.stamp = message.header.stamp
        known.observed_at = clock.to_steady(message.header.stamp, now)
        if not message.visible:
            return
        pose, radius = from_message(message.pose.pose), shape.reach()
        if not (_on_table(pose.x, pose.y) and math.isfinite(pose.theta)):
            return
        before, known.seen_at = known.pose, now.steady
        shift = math.inf
        if before is not None:
            shift = before.distance_to(pose)
            if shape.vertices is not None:
                shift += abs(before.rotation_to(pose)) * radius
        if shift > self._moved:
            known.pose = pose

    def search(self, searches: bool) -> None:
        """Note whether the camera searches for objects without an object file."""
        self._searches = searches

    def on_unknown(self, message: UnknownObjects, clock: PeerClock, now: Now) -> None:
        """Process the outlines of the objects without an object file."""
        self._searched_at = clock.to_steady(message.header.stamp, now)
        outlines = (
            [(point.x, point.y) for point in outline.points if _on_table(point.x, point.y)]
            for outline in message.outlines
        )
        self._unknown = tuple(_unknown_area(corners) for corners in outlines if len(corners) >= 3)

    @property
    def unknown(self) -> tuple[PolygonArea, ...]:
        """Areas of the objects without an object file."""
        return self._unknown if self._searches else ()

    def searched(self, since: float) -> bool:
        """Return whether the camera has searched for objects without an object file since
        ``since``, in s of the steady clock. Also return True if the camera does not search for such
        objects."""
        return not self._searches or self._searched_at > since

    def areas(self, now: Now, tapped: str = "") -> tuple[KeepOut | None, ...]:
        """Return the areas that all objects but ``tapped`` cover. First come the objects with an
        object file, in the order of the files, with None for an object that is not on the table;
        then the objects without a file."""
        return (
            *(self._area(file, now) for file in self._files if file.name != tapped),
            *self.unknown,
        )

    def moved_since(self, areas: Sequence[KeepOut | None], now: Now, tapped: str = "") -> bool:
        """Return whether an object has moved or appeared since :meth:`areas` returned ``areas``."""
        return any(area is not None and area not in areas for area in self.areas(now, tapped))

    def unobserved(self, since: float, tapped: str) -> str:
        """Return the names of the objects besides ``tapped`` that the camera has not observed since
        ``since``, in s of the steady clock; empty if there are no such objects."""
        return ", ".join(
            f"'{file.name}'"
            for file in self._files
            if file.name != tapped
            and (file.name not in self._known or self._known[file.name].observed_at <= since)
        )

    def _area(self, file: ObjectFile, now: Now) -> KeepOut | None:
        known = self._known.get(file.name)
        if known is None or known.pose is None or now.steady - known.seen_at > self.memory:
            return None
        if file.shape.vertices is None:
            return CircleArea(known.pose.x, known.pose.y, file.shape.reach(), file.name)
        corners = transform_points(known.pose, file.shape.vertices)
        return PolygonArea(tuple((float(x), float(y)) for x, y in corners), file.name)


def _on_table(x: float, y: float) -> bool:
    """Return whether a point can be on the table. A number that is not finite cannot."""
    return abs(x) <= FARTHEST_M and abs(y) <= FARTHEST_M


def _unknown_area(corners: list[tuple[float, float]]) -> PolygonArea:
    x, y = (sum(part) / len(corners) for part in zip(*corners, strict=True))
    return PolygonArea(tuple(corners), f"{UNKNOWN} at x {1000 * x:.0f} mm, y {1000 * y:.0f} mm")
