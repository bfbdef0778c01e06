"""Oracle of a positioning cell: one striker at a time, along the line of its tapper."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lab.oracle.oracle import Oracle
from lab.virtual_cell.fixed_cell import FixedRelease, PhysicalFixedCell
from lab.virtual_cell.physical_cell import Release
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import TapCommand
from tapping_cell.se2 import Pose

OUT_S = 0.15
"""Time before a release from which a striker that is off its mount must have been noticed."""
LINE_M, LINE_RAD = 0.005, 0.1
"""Maximum deviation of the commanded line, which includes learnt corrections, from the mount's."""


@dataclass
class FixedOracle(Oracle):
    """Checks the tappers at fixed mounts. Times are in s from the start of the run."""

    @property
    def _cell(self) -> PhysicalFixedCell:
        assert isinstance(self.physical, PhysicalFixedCell)
        return self.physical

    def check_place(self, release: Release, command: TapCommand) -> None:
        """Check that the named tapper fired along its line, and no other striker was out."""
        assert isinstance(release, FixedRelease)
        wanted, shot = from_message(command.strike_pose), release.shot
        if (
            wanted.distance_to(release.tip) > LINE_M
            or abs(wanted.rotation_to(release.tip)) > LINE_RAD
        ):
            self.violate("other line", f"shot {shot} was not commanded along the tapper's line")
        if command.tapper != release.tapper:
            self.violate(
                "wrong tapper",
                f"shot {shot} was released by '{release.tapper}' instead of '{command.tapper}'",
            )
        if release.others_charged or release.others_out:
            self.violate(
                "second striker", f"shot {shot} was released with another striker charged or out"
            )
        for name, since in self._cell.out_since.items():
            if release.time > since + OUT_S:
                self.violate(
                    "fired at a striker",
                    f"shot {shot} was released {release.time - since:.2f} s after the striker of"
                    f" '{name}' had left its mount",
                )

    def _check_promise(self, release: Release) -> None:
        """Do nothing: a fixed mount cannot move."""

    def _check_scene(self, release: Release, command: TapCommand, true: Pose) -> None:
        assert isinstance(release, FixedRelease)
        super()._check_scene(release, command, true)
        recently = release.time < self.sight("").moved_by_hand + self.unseen_limit
        if not release.object_at_rest and not recently:
            self.violate("object in motion", f"shot {release.shot} was fired at a moving object")

    def difference_of_place(self, command: TapCommand, release: Release) -> float:
        """Return 0 for a command of the tapper that fired, otherwise infinity."""
        assert isinstance(release, FixedRelease)
        return 0.0 if command.tapper == release.tapper else math.inf

    def is_charged(self) -> bool:
        """Return whether a striker is or may be charged; at most one board may be."""
        charged = self._cell.charged()
        if len(charged) > 1:
            self.violate("two charged", f"the boards {charged} are charged at the same time")
        return bool(charged)
