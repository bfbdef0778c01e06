"""Checks of the messages of arm, planner and camera before the tapper charges and fires.

A cell with fixed tappers has no arm. In such a cell, the boards must instead have verified that the
strikers are at their mounts."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tapping_cell.logic.clock import Now
from tapping_cell.logic.peer_clock import SKEW_LIMIT_S, PeerClock, skewed_clock
from tapping_cell.logic.poses import from_message
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    ObjectState,
    ObjectStates,
    PlanState,
    Time,
)
from tapping_cell.se2 import Pose

TAPPING = (PlanState.PLACING, PlanState.FIRING)
"""States of the planner in which the planner waits for a commanded tap."""
BLIND = frozenset(
    {
        ErrorCode.CAMERA_SILENT,
        ErrorCode.CAMERA_NOT_CALIBRATED,
        ErrorCode.IMAGE_INVALID,
        ErrorCode.STAMP_INVALID,
    }
)
"""Error codes that mean that there was no usable image; messages with these codes do not count as a
camera heartbeat."""
ABOVE_M, ABOVE_RAD = 0.005, 0.05
"""Maximum horizontal distance and angle from the tip to its strike pose when charging begins and at
the shot."""
HEIGHT_M = 0.002
"""Maximum difference in height between the tip and its strike pose at the shot."""
ARM_HIDES_S = 4.0
"""Maximum time, s, for which the arm may hide the object on its way to a strike pose."""
IDLE_LIMIT_S = 1.5
"""Message timeout, s, of a planner that did not command the tap. Such a planner publishes only
twice a second."""


@dataclass(frozen=True, slots=True)
class PeerLimits:
    """Limits for the messages of arm, planner and camera."""

    arm_freshness: float = 0.3
    """Maximum age of the arm's read-back, s."""
    silence: float = 0.45
    """Message timeout of planner and camera, s."""
    unseen: float = 0.45
    """Maximum time, s, for which the object may be unseen before the shot, apart from the time for
    which the arm hides it."""
    moved: float = 0.002
    """Maximum distance of the object from the pose for which the tap was planned, m."""
    turned: float = 0.05
    """Maximum rotation of the object from the pose for which the tap was planned, rad."""
    needs_camera: bool = False
    """Whether a tap requires that a usable image has arrived since the node was started. If False,
    a camera that has sent nothing yet does not prevent taps."""


@dataclass(slots=True)
class Mounts:
    """State of the strikers as reported by the boards.

    ``proven``: whether all strikers have been detected at their mounts since the boards' start. A
    striker that was released since then must also have been detected leaving its mount and
    returning.
    ``away``: names of the strikers that are not at their mounts. ``fitted``: whether the mounts
    have switches.
    """

    proven: bool = False
    fitted: bool = False
    away: tuple[str, ...] = ()

    def check(self) -> CodedError | None:
        """Return why no tapper may be charged, or None if charging is allowed."""
        if not self.fitted:
            return (
                ErrorCode.TAPPER_MOUNT_NOT_PROVEN,
                "the board has no switches at its mounts, so that it cannot confirm that the "
                "strikers are back; flash firmware 2.1 or newer, built for its channels",
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
                "the strikers have not been confirmed to be at their mounts since the "
                "board's start",
            )
        return None


@dataclass(slots=True)
class Sight:
    """When an object was seen; times in s of the steady clock, by the stamps of the images.

    ``state``: newest state that shows the object. ``unexplained``: the longest time since then for
    which the object was hidden by something other than the arm, up to ``explained_at``.
    """

    state: ObjectState
    seen_at: float
    explained_at: float
    unexplained: float = 0.0

    def hide_by_arm(self, at: float) -> None:
        """Record that the arm hides the object."""
        if at > self.explained_at:
            self.unexplained = max(self.unexplained, at - self.explained_at)
            self.explained_at = at

    def unexplained_for(self, now: float) -> float:
        """Return the longest time for which the object was hidden by something else, s."""
        return max(self.unexplained, now - self.explained_at)


class TapperPeers:
    """Last messages of arm, planner and camera, with their times on this computer's steady clock.

    A planner that has sent no message yet does not count as lost, because a program may command
    single taps without a planner. ``PeerLimits.needs_camera`` decides whether a camera that has
    sent no message yet counts as lost. A peer whose messages end, for example because its process
    hangs, counts as lost. The age of a message is determined from its stamp.
    """

    def __init__(self, limits: PeerLimits) -> None:
        self._limits = limits
        self._arm: ArmState | None = None
        self._arm_received = -math.inf
        self._clocks = {"arm": PeerClock(), "planner": PeerClock(), "camera": PeerClock()}
        self._plan_received: float | None = None
        self._phase = PlanState.IDLE
        self._planner_commanded_tap = False
        self._picture_at: float | None = None
        self._own = self._object = ""
        self._height = 0.0
        self._names: set[str] = set()
        """Names of the objects that the camera has reported."""
        self._seen: dict[str, Sight] = {}
        self._received: dict[str, ObjectState] = {}
        """Last received state that shows each object. Its stamp may be older than that of the state
        in ``_seen``, because the camera's clock may be set back."""
        self._mounts: Mounts | None = None

    def use_mounts(self, mounts: Mounts) -> None:
        """From now on, check the state of the mounts instead of the arm."""
        self._mounts = mounts

    def begin_tap(self, object_id: str, height: float) -> None:
        """Begin the checks of a tap of the object with this name (empty: the cell's own object).

        ``height``: commanded height of the tip for the strike, m. Later messages of the planner
        show whether the planner commanded this tap.
        """
        self._planner_commanded_tap = False
        self._object, self._height = object_id, height

    def on_arm_state(self, message: ArmState, now: Now) -> None:
        """Process ``arm_state``."""
        self._clocks["arm"].receive(message.header.stamp, now)
        self._arm, self._arm_received = message, now.steady

    def on_plan_state(self, message: PlanState, now: Now) -> None:
        """Process ``plan_state``."""
        self._clocks["planner"].receive(message.header.stamp, now)
        self._phase = message.state
        self._plan_received = self._clocks["planner"].to_steady(message.header.stamp, now)
        if message.state in TAPPING:
            self._planner_commanded_tap = True

    def on_object_states(self, message: ObjectStates, now: Now) -> None:
        """Process ``object_states``; the age of each state is determined from its own stamp."""
        if message.objects:
            self._own = message.objects[0].object_id
        for state in message.objects:
            self._names.add(state.object_id)
            if state.error_code not in BLIND:
                self._on_object_state(state, message.header.stamp, now)

    def _on_object_state(self, state: ObjectState, taken: Time, now: Now) -> None:
        """Process an object's state; ``taken``: stamp of the last image."""
        name, camera = state.object_id, self._clocks["camera"]
        camera.receive(state.header.stamp, now)
        seen_at = camera.to_steady(state.header.stamp, now)
        if state.header.stamp == taken:
            self._picture_at = max(seen_at, self._picture_at or -math.inf)
        if state.visible and state.error_code == ErrorCode.NONE:
            is_newer = name not in self._seen or seen_at >= self._seen[name].seen_at
            if is_newer:
                self._seen[name] = Sight(state, seen_at, seen_at)
            if is_newer or state.header.stamp == taken:
                self._received[name] = state
        elif state.hidden_by_arm and name in self._seen:
            self._seen[name].hide_by_arm(seen_at)

    def object_error(self, name: str) -> CodedError | None:
        """Return an error if the camera reports objects but not the one with this name, or None.
        An empty name means the cell's own object."""
        if not name or not self._names or name in self._names:
            return None
        return (
            ErrorCode.CONFIGURATION_CONFLICT,
            f"the tap is for '{name}', but camera_pose reports"
            f" {', '.join(map(repr, sorted(self._names)))}; give camera_pose and tap_planner the"
            " same cell file and other_object_files",
        )

    def obstacle(self, tap_id: int, planned: Pose, strike: Pose, now: Now) -> CodedError | None:
        """Return what keeps a tap from being charged, apart from the arm's way to its strike pose,
        or None."""
        reason = self._check_others(planned, now)
        arm = self._arm
        if self._mounts is not None:
            return self._mounts.check() or reason
        silence = now.steady - self._arm_received
        if silence > self._limits.arm_freshness:
            return reason or (
                ErrorCode.ARM_SILENT,
                f"scara_arm has sent no arm_state for {silence:.2f} s (limit"
                f" {self._limits.arm_freshness:.2f} s); check scara_arm and the network",
            )
        if arm is None or arm.state != ArmState.MOVING or arm.tap_id != tap_id:
            return reason or self._check_arm(tap_id, strike, now)
        hidden = reason is not None and reason[0] == ErrorCode.OBJECT_NOT_SEEN
        return None if hidden else reason  # on its way, the arm may hide the object

    def abandonment_error(self) -> CodedError | None:
        """Return an error if the planner that commanded the tap no longer waits for it."""
        if self._planner_commanded_tap and self._phase not in TAPPING:
            return (
                ErrorCode.NOT_READY,
                "the planner that commanded the tap no longer waits for it; it was restarted or"
                " gave the tap up",
            )
        return None

    def check_firing(self, tap_id: int, planned: Pose, strike: Pose, now: Now) -> CodedError | None:
        """Return why the peers' messages forbid firing the tap, or None if firing is allowed.

        ``planned``: pose of the object for which the tap was planned; ``strike``: commanded pose of
        the tip. Both are in ``table``.
        """
        if self._mounts is not None:
            return self._mounts.check() or self._check_others(planned, now)
        return self._check_arm(tap_id, strike, now) or self._check_others(planned, now)

    def check_charging(
        self, tap_id: int, planned: Pose, strike: Pose, now: Now
    ) -> CodedError | None:
        """Return why the tapper must not be charged, or None if charging is allowed. Arguments as
        in :meth:`check_firing`.

        Charging may begin while the arm still lowers the striker. The arm's last read-back must
        then be recent and show the tip above the strike pose, so that only a vertical motion
        remains.
        """
        if self._mounts is not None:
            return self._mounts.check() or self._check_others(planned, now)
        if not self._is_lowering(tap_id, strike, now):
            reason = self._check_arm(tap_id, strike, now)
            if reason is not None:
                return reason
        return self._check_others(planned, now)

    def _check_others(self, planned: Pose, now: Now) -> CodedError | None:
        return (
            self.abandonment_error()
            or self.clock_error(now)
            or self._camera_missing()
            or self._silence(now)
            or self._disturbance(planned, now)
        )

    def _is_lowering(self, tap_id: int, strike: Pose, now: Now) -> bool:
        """Return whether the arm has recently reported that it moves down to the strike pose."""
        arm = self._arm
        if arm is None or arm.state != ArmState.MOVING or arm.tap_id != tap_id or not arm.homed:
            return False
        if now.steady - self._arm_received > self._limits.arm_freshness:
            return False
        return _above(arm, strike)

    def _check_arm(self, tap_id: int, strike: Pose, now: Now) -> CodedError | None:
        arm, limit = self._arm, self._limits.arm_freshness
        code = ErrorCode.TAPPER_ARM_NOT_IN_POSITION
        if arm is None:
            return code, "no arm_state has been received yet; check that scara_arm is running"
        if arm.state != ArmState.IN_POSITION or arm.tap_id != tap_id:
            return (
                code,
                f"the arm is not in position for tap {tap_id}: arm_state reports state"
                f" {arm.state} (in position: {ArmState.IN_POSITION}) and tap {arm.tap_id}",
            )
        age = max(self._clocks["arm"].age(arm.header.stamp, now), now.steady - self._arm_received)
        if age > limit:
            return (
                code,
                f"the arm's last position read-back is {age:.2f} s old (limit {limit:.2f} s); "
                "check scara_arm and the network",
            )
        if not _above(arm, strike):
            # If two planners were started by mistake, two taps may have the same id.
            return (
                code,
                f"the arm is in position for another tap with the same id {tap_id}; make sure "
                "that only one planner runs",
            )
        height = arm.tip_pose.position.z
        if not abs(height - self._height) <= HEIGHT_M:
            return (
                code,
                f"the arm is in position for tap {tap_id}, but its tip is {1e3 * height:.1f} mm"
                f" above the table instead of {1e3 * self._height:.1f} mm (limit of the difference"
                f" {1e3 * HEIGHT_M:.1f} mm); make sure that planner and scara_arm use the same"
                " arm.strike_height, and that strike_pose of tap_command contains this height",
            )
        return None

    def clock_error(self, now: Now) -> CodedError | None:
        """Return why the clocks of the cell's computers differ too much for a tap, or None."""
        skewed = skewed_clock(self._clocks, now)
        if skewed is None:
            return None
        name, skew = skewed
        return (
            ErrorCode.CLOCKS_DIFFER,
            f"the local clock differs by {skew:+.2f} s from that of the {name} (limit"
            f" {SKEW_LIMIT_S:.2f} s), or the {name}'s messages are delayed that much;"
            " synchronise the clocks",
        )

    def _camera_missing(self) -> CodedError | None:
        if self._limits.needs_camera and self._picture_at is None:
            return (
                ErrorCode.CAMERA_SILENT,
                "no usable image of the camera has been received since this node was started; check"
                " the camera and its node, or set needs_camera to false in a cell without a camera",
            )
        return None

    def _silence(self, now: Now) -> CodedError | None:
        silence = self._limits.silence
        planner_limit = silence if self._planner_commanded_tap else max(silence, IDLE_LIMIT_S)
        for received_at, limit, code, sentence in (
            (
                self._plan_received,
                planner_limit,
                ErrorCode.NOT_READY,
                "the planner has sent no message for {:.2f} s (limit {:.2f} s); check tap_planner",
            ),
            (
                self._picture_at,
                silence,
                ErrorCode.CAMERA_SILENT,
                "the camera's last usable image is {:.2f} s old (limit {:.2f} s); check "
                "the camera and its node",
            ),
        ):
            if received_at is not None and now.steady - received_at > limit:
                return code, sentence.format(now.steady - received_at, limit)
        return None

    def _disturbance(self, planned: Pose, now: Now) -> CodedError | None:
        """Return an error if the object is not seen at the pose for which the tap was planned, or
        None."""
        if self._picture_at is None:
            return None
        name, limits = self._object or self._own, self._limits
        sight = self._seen.get(name)
        if sight is None:
            return ErrorCode.OBJECT_NOT_SEEN, "the object has not been seen yet; uncover it"
        seen, unseen = sight.state, now.steady - sight.seen_at
        if sight.unexplained_for(now.steady) > limits.unseen:
            return (
                ErrorCode.OBJECT_NOT_SEEN,
                f"the object has not been seen for {unseen:.2f} s (limit {limits.unseen:.2f} s);"
                " uncover it",
            )
        longest = max(ARM_HIDES_S, limits.unseen)
        if unseen > longest:
            return (
                ErrorCode.OBJECT_NOT_SEEN,
                f"the arm has hidden the object for {unseen:.2f} s (limit {longest:.2f} s); raise"
                " unseen_limit if the arm needs longer to its strike poses",
            )
        if self._mounts is not None and not seen.at_rest:
            return (
                ErrorCode.OBJECT_NOT_AT_REST,
                "the object moves; a fixed tapper fires only at an object at rest",
            )
        for state in (seen, self._received[name]):
            pose = from_message(state.pose.pose)
            moved, turned = planned.distance_to(pose), abs(planned.rotation_to(pose))
            if moved <= limits.moved and turned <= limits.turned:
                continue
            return (
                ErrorCode.OBJECT_MOVED,
                f"the object was moved: it is {1000 * moved:.1f} mm and"
                f" {math.degrees(turned):.1f} deg away from the pose for which the tap was planned"
                f" (limits {1000 * limits.moved:.1f} mm and {math.degrees(limits.turned):.1f} deg)",
            )
        return None


def _above(arm: ArmState, strike: Pose) -> bool:
    """Return whether the tip was read back at or above a strike pose."""
    tip = from_message(arm.tip_pose)
    return tip.distance_to(strike) <= ABOVE_M and abs(tip.rotation_to(strike)) <= ABOVE_RAD
