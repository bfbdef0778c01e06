"""Oracle of a cell with several objects: no striker meets an object that lay there visibly."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from lab.oracle.oracle import Oracle
from lab.virtual_cell.physical_cell import Release
from lab.virtual_cell.table_cell import Outline, PhysicalTable, TableRelease, depth
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import TapCommand
from tapping_cell.se2 import Pose

KNOWN_S = 12.0
"""Time after which an object that lies still in view must be known to the planner."""
OVERLAP_M = 0.002
"""Allowance for the errors of arm and camera when the tool and an object overlap."""
AXIS_POINTS = 12
"""Number of points on the axis of the tool at which an overlap is checked."""


@dataclass
class TableOracle(Oracle):
    """Checks a cell with several objects. Times are in s from the start of the run."""

    _laid: dict[Outline, float] = field(default_factory=dict)
    """Time since which each object without an object file has lain on the table."""
    _disturbed: dict[str, float] = field(default_factory=dict)
    """Time at which each object was last struck, or hit by another one."""

    @property
    def _table(self) -> PhysicalTable:
        assert isinstance(self.physical, PhysicalTable)
        return self.physical

    @contextmanager
    def regarding(self, name: str) -> Iterator[None]:
        """Let the ground truth report this object."""
        with self._table.regarding(name or self.own):
            yield

    def after_event(self) -> None:
        """Check the releases, contacts, charge and motion after an event."""
        super().after_event()
        now = self.scheduler.now
        if self._laid.keys() != set(self._table.unknown):
            self._laid = {one: self._laid.get(one, now) for one in self._table.unknown}
        for contact in self._table.table.take_contacts():
            self._disturbed[contact.name] = self._disturbed[contact.other] = now

    def _check_scene(self, release: Release, command: TapCommand, true: Pose) -> None:
        assert isinstance(release, TableRelease)
        name = command.object_id or self.own
        true = release.poses[name]
        super()._check_scene(replace(release, object_pose=true), command, true)
        self._disturbed[name] = release.time
        if release.shot not in self.planners:
            return
        met = release.met
        if met not in ("", name) and release.time > self._lies_since(met) + KNOWN_S:
            self.violate(
                "other object struck",
                f"shot {release.shot} was released for '{name}', but '{met}' lies in the striker's"
                " way",
            )
        tip = from_message(command.strike_pose)
        for outline, since in self._laid.items():
            inside = max(depth(outline, part) for part in self._axis_of_tool(tip))
            inside += self.physical.cell.file.tapper.tool_radius
            if inside > OVERLAP_M and release.time > since + KNOWN_S:
                self.violate(
                    "tool in an unknown object",
                    f"at shot {release.shot}, the tool overlaps an object without an object file by"
                    f" {1e3 * inside:.0f} mm",
                )

    def _lies_since(self, name: str) -> float:
        """Return the time since which an object has lain still in view; inf: it does not."""
        sight = self.sight(name)
        if name in self._table.absent or math.isfinite(sight.hidden_since):
            return math.inf
        return max(sight.moved_by_hand, sight.seen_again, self._disturbed.get(name, -math.inf))

    def _axis_of_tool(self, tip: Pose) -> list[tuple[float, float]]:
        """Return points on the axis of the tool, which is a bar behind the tip."""
        tapper = self.physical.cell.file.tapper
        behind = np.linspace(tapper.tool_start, tapper.tool_length, AXIS_POINTS)
        x, y = tip.x - behind * math.cos(tip.theta), tip.y - behind * math.sin(tip.theta)
        return list(zip(x.tolist(), y.tolist(), strict=True))
