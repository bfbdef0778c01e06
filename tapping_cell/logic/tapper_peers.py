"""Whom a tapper must hear before it charges and fires: arm, planner and camera.

Tappers at fixed mounts have no arm. In its place stand the mounts, which the board has proven, and
the cell's other boards, none of which may be charged or have a striker out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tapping_cell.logic.clock import Now
from tapping_cell.logic.peer_clock import SKEW_LIMIT_S, PeerClock
from tapping_cell.logic.poses import from_message
from tapping_cell.logic.tap_commands import Trouble
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    ObjectState,
    ObjectStates,
    PlanState,
    TapperState,
)
from tapping_cell.se2 import Pose

TAPPING = (PlanState.PLACING, PlanState.FIRING)
"""Phases of a planner that waits for its tap."""
BLIND = frozenset(
    {
        ErrorCode.CAMERA_SILENT,
        ErrorCode.CAMERA_NOT_CALIBRATED,
        ErrorCode.IMAGE_INVALID,
        ErrorCode.STAMP_INVALID,
    }
)
"""Codes with which no usable picture comes: they do not count as a word of the camera."""
ABOVE_M, ABOVE_RAD = 0.005, 0.05
"""How near above its strike pose the arm must stand, as read back, for charging to begin."""
IDLE_LIMIT_S = 1.5
"""A planner whose tap it is not speaks twice a second: it is missed only after so long."""


@dataclass(frozen=True, slots=True)
class PeerLimits:
    """What is tolerated of the peers."""

    arm_freshness: float = 0.3
    """Greatest age of the arm's read-back, s."""
    silence: float = 0.45
    """Longest silence of planner and camera, s."""
    unseen: float = 0.45
    """Longest time for which the object may not be seen before the shot, s; longer where the arm
    itself covers the object on its way to some strike poses."""
    moved: float = 0.002
    """Greatest distance of the object from where the tap was planned, m."""
    turned: float = math.radians(3)
    """Greatest rotation of the object from how the tap was planned, rad."""


RESTING = (
    TapperState.SAFE,
    TapperState.STOPPED,
    TapperState.FAULT,
    TapperState.DISCONNECTED,
)
"""States of a board in which it fires nothing before it says so; its strikers may still be out."""


@dataclass(slots=True)
class Mounts:
    """What the own board tells of its strikers. ``proven``: since its start each was seen at its
    mount and, where it was released, to leave it and come back; ``away``: names of those that are
    not there; ``fitted``: whether switches tell."""

    proven: bool = False
    fitted: bool = False
    away: tuple[str, ...] = ()

    def doubt(self) -> Trouble | None:
        """Why no tapper of this board may be charged; None where one may."""
        if not self.fitted:
            return (
                ErrorCode.TAPPER_MOUNT_NOT_PROVEN,
                "the board has no switches at its mounts, so that it cannot prove that the strikers"
                " are back; flash firmware 2.1 or newer, built for its channels",
            )
        if self.away:
            return (
                ErrorCode.TAPPER_STRIKER_AWAY,
                f"the striker of {', '.join(self.away)} is not at its mount; free it and check its"
                " switch",
            )
        if not self.proven:
            return (
                ErrorCode.TAPPER_MOUNT_NOT_PROVEN,
                "the strikers were not yet proven to be at their mounts since the board's start",
            )
        return None


class TapperPeers:
    """What arm, planner and camera said last, and when by the own steady clock.

    A planner or camera that was never heard is not missed: a person or a program may command
    single taps without it. One that was heard and falls silent is lost, hung processes included;
    each word is as old as its stamp.
    """

    def __init__(self, limits: PeerLimits) -> None:
        self._limits = limits
        self._arm: ArmState | None = None
        self._arm_heard = -math.inf
        self._clocks = {"arm": PeerClock(), "planner": PeerClock(), "camera": PeerClock()}
        self._plan_heard: float | None = None
        self._phase = PlanState.IDLE
        self._planners_tap = False
        self._picture_at: float | None = None
        self._object = ""
        self._seen: dict[str, tuple[ObjectState, float]] = {}
        self._mounts: Mounts | None = None
        self._boards: dict[tuple[str, ...], tuple[TapperState, float]] = {}
        self._other_boards: frozenset[tuple[str, ...]] = frozenset()

    def use_mounts(self, mounts: Mounts, other_boards: Sequence[Sequence[str]]) -> None:
        """This cell has no arm: ``mounts`` of the own board, and the tappers' names of each of the
        others."""
        self._mounts = mounts
        self._other_boards = frozenset(tuple(names) for names in other_boards)

    def hear_tapper(self, message: TapperState, now: Now) -> None:
        """Hear ``tapper_state`` of any board."""
        names = tuple(message.tappers)
        if names in self._other_boards:
            self._boards[names] = message, now.steady

    def begin_tap(self, object_id: str) -> None:
        """A tap of an object was commanded (empty: the cell's own): whose it is shows in what the
        planner says from now on."""
        self._planners_tap = False
        self._object = object_id

    def hear_arm(self, message: ArmState, now: Now) -> None:
        """Hear ``arm_state``."""
        self._clocks["arm"].hear(message.header.stamp, now)
        self._arm, self._arm_heard = message, now.steady

    def hear_plan(self, message: PlanState, now: Now) -> None:
        """Hear ``plan_state``."""
        self._clocks["planner"].hear(message.header.stamp, now)
        self._phase = message.state
        self._plan_heard = self._clocks["planner"].to_steady(message.header.stamp, now)
        if message.state in TAPPING:
            self._planners_tap = True

    def hear_object(self, message: ObjectState, now: Now) -> None:
        """Hear ``object_state``."""
        if message.error_code in BLIND:
            return
        self._clocks["camera"].hear(message.header.stamp, now)
        self._picture_at = self._clocks["camera"].to_steady(message.header.stamp, now)
        if message.visible and message.error_code == ErrorCode.NONE:
            self._seen[""] = self._seen[message.object_id] = message, self._picture_at

    def hear_objects(self, message: ObjectStates, now: Now) -> None:
        """Hear ``object_states``: each state is as old as its own stamp."""
        for state in message.objects:
            seen_at = self._clocks["camera"].to_steady(state.header.stamp, now)
            last = self._seen.get(state.object_id, (state, -math.inf))[1]
            if state.visible and state.error_code == ErrorCode.NONE and seen_at > last:
                self._seen[state.object_id] = state, seen_at

    def given_up(self) -> Trouble | None:
        """Why the tap under way is nobody's any more: its planner does something else."""
        if self._planners_tap and self._phase not in TAPPING:
            return (
                ErrorCode.NOT_READY,
                "the planner that commanded the tap no longer waits for it; it was restarted or"
                " gave the tap up",
            )
        return None

    def doubt(self, tap_id: int, planned: Pose, strike: Pose, now: Now) -> Trouble | None:
        """What arm, planner or camera say, or fail to say, against this tap; None for nothing.

        ``planned``: where the object lay when the tap was planned; ``strike``: where the tap wants
        the tip, in ``table``.
        """
        if self._mounts is not None:
            return self._mount_doubt(now) or self._other_doubt(planned, now)
        return self._arm_doubt(tap_id, strike, now) or self._other_doubt(planned, now)

    def charging_doubt(self, tap_id: int, planned: Pose, strike: Pose, now: Now) -> Trouble | None:
        """The same against charging, which may begin while the arm lowers the striker.

        ``strike``: the commanded strike pose, in ``table``. The arm must have been read back above
        it, so that the only motion left is straight down, and must still be heard.
        """
        if self._mounts is not None:
            return self._mount_doubt(now) or self._other_doubt(planned, now)
        if not self._lowers(tap_id, strike, now):
            doubt = self._arm_doubt(tap_id, strike, now)
            if doubt is not None:
                return doubt
        return self._other_doubt(planned, now)

    def _other_doubt(self, planned: Pose, now: Now) -> Trouble | None:
        return (
            self.given_up()
            or self._skew(now)
            or self._silence(now)
            or self._disturbance(planned, now)
        )

    def _lowers(self, tap_id: int, strike: Pose, now: Now) -> bool:
        """True while the arm, heard lately, is on its way down to the strike pose of a tap."""
        arm = self._arm
        if arm is None or arm.state != ArmState.MOVING or arm.tap_id != tap_id or not arm.homed:
            return False
        if now.steady - self._arm_heard > self._limits.arm_freshness:
            return False
        return _above(arm, strike)

    def _arm_doubt(self, tap_id: int, strike: Pose, now: Now) -> Trouble | None:
        arm, limit = self._arm, self._limits.arm_freshness
        code = ErrorCode.TAPPER_ARM_NOT_IN_POSITION
        if arm is None:
            return code, "the arm has not reported yet"
        if arm.state != ArmState.IN_POSITION or arm.tap_id != tap_id:
            return (
                code,
                f"the arm is not in position for tap {tap_id} (state {arm.state}, tap"
                f" {arm.tap_id})",
            )
        age = max(self._clocks["arm"].age(arm.header.stamp, now), now.steady - self._arm_heard)
        if age > limit:
            return code, f"the arm's read-back is {age:.2f} s old, more than {limit:.2f} s"
        if not _above(arm, strike):
            # Two planners by mistake may give one id to two taps.
            return code, f"the arm is in position for another tap with the id {tap_id}"
        return None

    def _mount_doubt(self, now: Now) -> Trouble | None:
        """What is to be said against a tap from the board's own mounts: they are not proven, or
        another board is not at rest."""
        assert self._mounts is not None
        doubt = self._mounts.doubt()
        if doubt is not None:
            return doubt
        for names in sorted(self._other_boards):
            state, heard = self._boards.get(names, (None, -math.inf))
            if state is None or now.steady - heard > self._limits.silence:
                how = "has not been heard" if state is None else "is silent"
                return (
                    ErrorCode.TAPPER_OTHER_ACTIVE,
                    f"the board of '{names[0]}' {how}; check its tapper_trigger",
                )
            if state.state not in RESTING or state.away:
                return (
                    ErrorCode.TAPPER_OTHER_ACTIVE,
                    f"the board of '{names[0]}' is charged or has a striker out; one tap at a time",
                )
        return None

    def _skew(self, now: Now) -> Trouble | None:
        for name, clock in self._clocks.items():
            skew = clock.skew(now)
            if abs(skew) > SKEW_LIMIT_S:
                return (
                    ErrorCode.CLOCKS_DIFFER,
                    f"the clock of this computer is {skew:+.2f} s off that of the {name} (limit"
                    f" {SKEW_LIMIT_S:.2f} s), or its messages are that late; synchronise the"
                    " clocks",
                )
        return None

    def _silence(self, now: Now) -> Trouble | None:
        silence = self._limits.silence
        of_planner = silence if self._planners_tap else max(silence, IDLE_LIMIT_S)
        for heard, limit, code, sentence in (
            (
                self._plan_heard,
                of_planner,
                ErrorCode.NOT_READY,
                "the planner has been silent for {:.2f} s, more than {:.2f} s; check its node",
            ),
            (
                self._picture_at,
                silence,
                ErrorCode.CAMERA_SILENT,
                "the camera's last usable picture is {:.2f} s old, more than {:.2f} s; check the"
                " camera and its node",
            ),
        ):
            if heard is not None and now.steady - heard > limit:
                return code, sentence.format(now.steady - heard, limit)
        return None

    def _disturbance(self, planned: Pose, now: Now) -> Trouble | None:
        """The object must be seen where the tap was planned."""
        if self._picture_at is None:
            return None
        seen, seen_at = self._seen.get(self._object, (None, -math.inf))
        limits, unseen = self._limits, now.steady - seen_at
        if seen is None or unseen > limits.unseen:
            return (
                ErrorCode.OBJECT_NOT_SEEN,
                f"the object has not been seen for {unseen:.2f} s (limit {limits.unseen:.2f} s);"
                " uncover it, or raise unseen_limit where the arm itself covers it",
            )
        if self._mounts is not None and not seen.at_rest:
            return (
                ErrorCode.OBJECT_NOT_AT_REST,
                "the object moves; a fixed tapper fires at an object at rest alone",
            )
        pose = from_message(seen.pose.pose)
        moved, turned = planned.distance_to(pose), abs(planned.rotation_to(pose))
        if moved <= limits.moved and turned <= limits.turned:
            return None
        return (
            ErrorCode.OBJECT_MOVED,
            f"the object lies {1000 * moved:.1f} mm and {math.degrees(turned):.1f} deg from where"
            f" the tap was planned (limits {1000 * limits.moved:.1f} mm and"
            f" {math.degrees(limits.turned):.1f} deg); it was moved",
        )


def _above(arm: ArmState, strike: Pose) -> bool:
    """Whether the tip was read back at or above a strike pose."""
    tip = from_message(arm.tip_pose)
    return tip.distance_to(strike) <= ABOVE_M and abs(tip.rotation_to(strike)) <= ABOVE_RAD
