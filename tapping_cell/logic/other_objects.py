"""The other objects on the table as obstacles for the planner, at their last observed poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.logic.clock import Now
from tapping_cell.logic.peer_clock import PeerClock
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import ObjectState
from tapping_cell.planning import CircleArea, KeepOut, PolygonArea
from tapping_cell.se2 import Pose, transform_points


@dataclass(slots=True)
class _Known:
    """Last observations of one object; times on the steady clock, in s."""

    observed_at: float = -math.inf
    pose: Pose | None = None
    seen_at: float = -math.inf


class OtherObjects:
    """Poses of the objects on the table besides the cell's own object.

    An object that is no longer seen keeps its pose for a while, because a hand may hide it. After
    that it counts as removed.
    """

    def __init__(self, files: Sequence[ObjectFile], memory: float, moved: float) -> None:
        """``memory``: time in s after which an unseen object counts as removed; ``moved``: minimum
        displacement in m that counts as motion."""
        self._files = tuple(files)
        self._memory = memory
        self._moved = moved
        self._known: dict[str, _Known] = {}

    @property
    def files(self) -> tuple[ObjectFile, ...]:
        """Object files of these objects."""
        return self._files

    def on_object(self, message: ObjectState, clock: PeerClock, now: Now) -> None:
        """Process an observation of one object; ``clock``: clock of the camera's computer."""
        shape = next((file.shape for file in self._files if file.name == message.object_id), None)
        if shape is None:
            return
        known = self._known.setdefault(message.object_id, _Known())
        known.observed_at = clock.to_steady(message.header.stamp, now)
        if not message.visible:
            return
        pose, radius = from_message(message.pose.pose), shape.reach()
        before, known.seen_at = known.pose, now.steady
        shift = math.inf
        if before is not None:
            shift = before.distance_to(pose)
            if shape.vertices is not None:
                shift += abs(before.rotation_to(pose)) * radius
        if shift > self._moved:
            known.pose = pose

    def areas(self, now: Now) -> tuple[KeepOut | None, ...]:
        """Return the area that each object covers, in the order of the files; None if absent."""
        return tuple(self._area(file, now) for file in self._files)

    def moved_since(self, areas: Sequence[KeepOut | None], now: Now) -> bool:
        """Return whether an object has moved or appeared since ``areas`` (see :meth:`areas`)."""
        return any(area is not None and area not in areas for area in self.areas(now))

    def unobserved(self, since: float) -> str:
        """Return the names of the objects that the camera has not observed since ``since``, a time
        on the steady clock in s; empty if there are none."""
        return ", ".join(
            f"'{file.name}'"
            for file in self._files
            if file.name not in self._known or self._known[file.name].observed_at <= since
        )

    def _area(self, file: ObjectFile, now: Now) -> KeepOut | None:
        known = self._known.get(file.name)
        if known is None or known.pose is None or now.steady - known.seen_at > self._memory:
            return None
        if file.shape.vertices is None:
            return CircleArea(known.pose.x, known.pose.y, file.shape.reach(), file.name)
        corners = transform_points(known.pose, file.shape.vertices)
        return PolygonArea(tuple((float(x), float(y)) for x, y in corners), file.name)
