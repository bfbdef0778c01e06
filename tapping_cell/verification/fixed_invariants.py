"""Safety invariants of a positioning cell, in addition to those that also hold for a cell with an
arm."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from tapping_cell.logic.poses import from_message
from tapping_cell.messages import TapCommand, TapperState
from tapping_cell.verification.fixed_cell import FixedRelease, PhysicalFixedCell
from tapping_cell.verification.invariants import CHECK_S, InvariantChecker
from tapping_cell.verification.physical_cell import Release

OTHERS_ASKED_S = 0.1
"""Before a shot, the other boards are asked whether their strikers are at rest. At the last check
before FIRE, the replies may be at most this old, s."""
UNNOTICED_S = 3.0
"""Maximum time from when a striker leaves its mount until the tapper's node reports it. This
maximum covers a request with all its repetitions, and the time for which a board waits until a
released striker has returned."""

LINE_POSITION_M, LINE_ANGLE_RAD = 0.005, 0.1
"""Maximum deviation of the commanded line from the line in the cell file, m and rad. The two lines
differ because the commanded line includes learnt corrections."""


@dataclass(slots=True)
class FixedInvariantChecker(InvariantChecker):
    """Checks the tappers at fixed mounts. Times are in s from the start of the run."""

    unread_until: Callable[[], float] = lambda: -math.inf
    """Time until which a fault may have prevented the tapper's node from reading the boards."""
    _motion_at_check: bool = False
    """Whether the object was in motion in the latest observation that the tapper had received at
    the last check."""

    @property
    def _cell(self) -> PhysicalFixedCell:
        assert isinstance(self.physical, PhysicalFixedCell)
        return self.physical

    def _check_release(self, release: Release, earlier: list[Release]) -> None:
        super(FixedInvariantChecker, self)._check_release(release, earlier)
        assert isinstance(release, FixedRelease)
        shot = release.shot
        if release.others_charged:
            self.violate(
                "fired while another was charged",
                f"shot {shot} was released by '{release.tapper}' while board"
                f" {release.others_charged[0]} was charged",
            )
        if release.others_out:
            self.violate(
                "second striker",
                f"shot {shot} was released by '{release.tapper}' while the striker of"
                f" '{release.others_out[0]}' was out",
            )
        for name, since in self._cell.out_since.items():
            if release.time > since + OTHERS_ASKED_S + CHECK_S:
                self.violate(
                    "fired at a striker",
                    f"shot {shot} was released {release.time - since:.2f} s after the striker of"
                    f" '{name}' had left its mount",
                )
        command = self._command_of(release)
        if command is not None and command.tapper != release.tapper:
            self.violate(
                "wrong tapper",
                f"shot {shot} was released by '{release.tapper}', but the command named"
                f" '{command.tapper}'",
            )
        if self._motion_at_check:
            self.violate(
                "fired at observed motion",
                f"shot {shot} was fired although, at the last check, the tapper's latest"
                " observation showed the object in motion",
            )
        if not release.object_at_rest and not self._recently_moved(release.time):
            self.violate("object in motion", f"shot {shot} was fired while the object moved")

    def _difference_of_place(self, command: TapCommand, release: Release) -> float:
        # A planner may have learnt a slightly different pose of a fixed tapper.
        assert isinstance(release, FixedRelease)
        return 0.0 if command.tapper == release.tapper else math.inf

    def on_asked(self, process: str, job: str, answer: object | None) -> None:
        """Process the answer that a state machine gives to its running job."""
        super(FixedInvariantChecker, self).on_asked(process, job, answer)
        if process == "tapper_trigger" and job == "fire":
            self._motion_at_check = self.motion_seen_by_tapper

    def _recently_moved(self, time: float) -> bool:
        moved = self.moved_by_hand
        return moved is not None and time < moved[0] + self.unseen_limit

    def _check_place(self, release: Release, command: TapCommand) -> None:
        """Check that the commanded strike pose is on the line of the tapper that fired."""
        wanted = from_message(command.strike_pose)
        if (
            wanted.distance_to(release.tip) > LINE_POSITION_M
            or abs(wanted.rotation_to(release.tip)) > LINE_ANGLE_RAD
        ):
            self.violate(
                "other line",
                f"shot {release.shot} was commanded along a line that does not belong to the tapper"
                " that fired",
            )

    def _check_permit(self, release: Release) -> None:
        """Do nothing: a fixed mount cannot move, so it need not promise to stand still."""

    def _check_charge(self) -> None:
        charged = self._cell.charged()
        if len(charged) > 1:
            self.violate("two charged", f"the boards {charged} are charged at the same time")
        self._check_charged(bool(charged))

    def _on_tapper_state(self, message: TapperState) -> None:
        super(FixedInvariantChecker, self)._on_tapper_state(message)
        now = self.scheduler.now
        claims_rest = message.state == TapperState.SAFE and message.mounts_proven
        if not claims_rest or message.away:
            return
        for name, since in self._cell.out_since.items():
            unnoticed = now - max(since, self.unread_until())
            if unnoticed > UNNOTICED_S:
                self.violate(
                    "striker out unreported",
                    "the tapper reports that all strikers are at their mounts, but the striker of"
                    f" '{name}' has been out for {now - since:.1f} s",
                )
                self._cell.out_since[name] = math.inf
