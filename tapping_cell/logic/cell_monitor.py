"""What camera, arm and tapper last published, and what that means for the planner."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tapping_cell.logic import enabling
from tapping_cell.logic.clock import Now
from tapping_cell.logic.peer_clock import SKEW_LIMIT_S, PeerClock
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import ArmState, ErrorCode, ObjectState, ObjectStates, TapperState
from tapping_cell.se2 import Pose

Trouble = tuple[int, str]
"""An error code and a sentence."""

QUICKEST_IMAGE_S = 0.05
"""Bound of the least delay of an image until its observation is heard, beyond that of the arm's
messages: it cannot be told from a difference of the clocks, and makes images look later than they
were taken."""
FAULTED = (TapperState.FAULT, TapperState.STOPPED)
ENGAGED = (TapperState.CHARGING, TapperState.CHARGED, TapperState.FIRING)
NAMES = {"object": "camera_pose", "arm": "scara_arm", "tapper": "tapper_trigger"}


class CellMonitor:
    """The last message of each of the three, and when it arrived.

    Whether an observation was made before or after something is judged on this computer's steady
    clock, with the estimated difference of the camera's clock.
    """

    def __init__(self, silence_limit: float) -> None:
        self._silence_limit = silence_limit
        self._own: ObjectState | None = None
        self._states: dict[str, ObjectState] = {}
        self._watched = ""
        self.arm: ArmState | None = None
        self._boards: dict[tuple[str, ...], TapperState] = {}
        self._boards_heard: dict[tuple[str, ...], float] = {}
        self._spoke: tuple[str, ...] = ()
        self._expected: frozenset[tuple[str, ...]] = frozenset()
        self._arm_expected: bool | None = None
        self.camera_clock = PeerClock()
        self._heard = {name: -math.inf for name in NAMES}
        self._seen_at: dict[str, float] = {}

    @property
    def object(self) -> ObjectState | None:
        """What is known of the object that is watched."""
        return self._states.get(self._watched) if self._watched else self._own

    def watch(self, name: str) -> None:
        """From now on every question about the object is about the one of that name, as
        ``object_states`` tells of it; empty for the cell's own, as ``object_state`` does."""
        self._watched = name

    def expect(self, has_arm: bool, boards: Sequence[Sequence[str]]) -> None:
        """What the cell consists of: an arm or none, and the tappers' names of each board. Whoever
        does not know judges by what is heard."""
        self._arm_expected = has_arm
        self._expected = frozenset(tuple(names) for names in boards)

    @property
    def has_arm(self) -> bool:
        """Whether the cell has an arm."""
        if self._arm_expected is not None:
            return self._arm_expected
        return not any(state.fixed_mounts for state in self._boards.values())

    @property
    def tip(self) -> tuple[float, float, float, float] | None:
        """Where the arm says that its tip stands, x, y, height and yaw in ``table``; None where it
        does not know."""
        if self.arm is None or not self.arm.homed:
            return None
        place = from_message(self.arm.tip_pose)
        return place.x, place.y, self.arm.tip_pose.position.z, place.theta

    @property
    def tapper(self) -> TapperState | None:
        """What there is to say of the tappers: the last word of the board that has something to
        say; a fault before a tap under way before rest."""
        states = self._boards
        for wanted in (FAULTED, ENGAGED):
            for state in states.values():
                if state.state in wanted:
                    return state
        return states.get(self._spoke)

    def on_object(self, message: ObjectState, now: Now) -> None:
        """Take in ``object_state``."""
        self._own = message
        self._heard["object"] = now.steady
        self.camera_clock.hear(message.header.stamp, now)
        self._note_seen("", message, now)

    def on_objects(self, message: ObjectStates, now: Now) -> None:
        """Take in ``object_states``."""
        for state in message.objects:
            self._states[state.object_id] = state
            self._note_seen(state.object_id, state, now)

    def _note_seen(self, name: str, state: ObjectState, now: Now) -> None:
        if state.visible and not state.error_code:
            seen = self.camera_clock.to_steady(state.header.stamp, now)
            self._seen_at[name] = max(self._seen_at.get(name, -math.inf), seen)

    def on_arm(self, message: ArmState, now: Now) -> None:
        """Take in ``arm_state``."""
        self.arm = message
        self._heard["arm"] = now.steady

    def on_tapper(self, message: TapperState, now: Now) -> None:
        """Take in ``tapper_state``."""
        board = tuple(message.tappers) or self._only_board()
        if board is None or (self._expected and board not in self._expected):
            return  # one that has not read its cell file yet, or of another cell
        if board:
            self._boards.pop((), None)
        self._spoke = board
        self._boards[self._spoke] = message
        self._boards_heard[self._spoke] = now.steady

    def _only_board(self) -> tuple[str, ...] | None:
        """The board that a state without names speaks of; None where there are several."""
        known = self._expected or frozenset(self._boards)
        if len(known) > 1:
            return None
        return next(iter(known), ())

    def silent(self, name: str, now: Now) -> bool:
        """Whether ``object``, ``arm`` or ``tapper`` was not heard for longer than the limit."""
        return now.steady - self._last_heard(name) > self._silence_limit

    def _last_heard(self, name: str) -> float:
        """Steady time of the last word; of the tappers that of the board unheard for longest."""
        if name != "tapper":
            return self._heard[name]
        boards = self._expected or frozenset(self._boards_heard)
        return min(
            (self._boards_heard.get(board, -math.inf) for board in boards), default=-math.inf
        )

    def observed_at(self, now: Now) -> float:
        """When the last image was taken, on the own steady clock, s."""
        if self.object is None:
            return -math.inf
        return self.camera_clock.to_steady(self.object.header.stamp, now)

    def unseen_for(self, now: Now) -> float:
        """How long ago the object was last seen, s."""
        return now.steady - self._seen_at.get(self._watched, -math.inf)

    @property
    def pose(self) -> Pose | None:
        """Where the object is seen now; None while it is not seen."""
        seen = self.object
        return from_message(seen.pose.pose) if seen is not None and seen.visible else None

    def usable(self, after: float, frames: int, now: Now) -> bool:
        """True for an observation of the object at rest that was made after a steady time."""
        seen = self.object
        return bool(
            seen is not None
            and not self.silent("object", now)
            and now.steady - self.observed_at(now) <= self._silence_limit
            and self.observed_at(now) > after + QUICKEST_IMAGE_S
            and seen.visible
            and seen.at_rest
            and seen.error_code == ErrorCode.NONE
            and seen.frames_fused >= frames
        )

    def missing(self, now: Now) -> Trouble | None:
        """What keeps the cell from tapping; None when nothing does."""
        arm, tapper = self.arm, self.tapper
        of_arm = self._arm_missing(arm, now) if self.has_arm else None
        if of_arm is not None:
            return of_arm
        if tapper is None or self.silent("tapper", now):
            return ErrorCode.TAPPER_SILENT, self._silence("tapper", now)
        if tapper.state != TapperState.SAFE:
            code = tapper.error_code or ErrorCode.TAPPER_BUSY
            return code, tapper.error_msg or "the tapper is busy"
        for board in self._boards.values():
            if not self.has_arm and (not board.mounts_proven or board.away):
                code = board.error_code or ErrorCode.TAPPER_MOUNT_NOT_PROVEN
                return code, board.error_msg or "the mounts of the tappers are not proven yet"
        if not all(board.interlock_closed for board in self._boards.values()):
            return ErrorCode.TAPPER_INTERLOCK_OPEN, "the tapper's interlock is open; close it"
        if self._own is None or self.silent("object", now):
            return ErrorCode.CAMERA_SILENT, self._silence("object", now)
        skew = self.camera_clock.skew(now)
        if abs(skew) > SKEW_LIMIT_S:
            return (
                ErrorCode.CLOCKS_DIFFER,
                f"the clock of the camera's computer differs by {skew:+.2f} s from this one's"
                f" (limit {SKEW_LIMIT_S:.2f} s); synchronise the computers' clocks",
            )
        return None

    def _arm_missing(self, arm: ArmState | None, now: Now) -> Trouble | None:
        if arm is None or self.silent("arm", now):
            return ErrorCode.ARM_SILENT, self._silence("arm", now)
        if arm.set_up and not arm.enabled:
            return enabling.RELEASED
        if arm.state != ArmState.IDLE:
            return arm.error_code or ErrorCode.ARM_BUSY, arm.error_msg or "the arm is busy"
        return None

    def fault(self) -> Trouble | None:
        """A fault of arm or tapper that needs a person; None where there is none."""
        for state, faults in (
            (self.arm, (ArmState.FAULT, ArmState.STOPPED)),
            (self.tapper, FAULTED),
        ):
            if state is not None and state.state in faults:
                return state.error_code or ErrorCode.NOT_READY, state.error_msg
        return None

    def lost(self, now: Now) -> bool:
        """True when arm or tapper went away: their drivers come back by themselves."""
        arm = self.arm
        arm_lost = self.has_arm and (
            self.silent("arm", now) or (arm is not None and arm.state == ArmState.DISCONNECTED)
        )
        return (
            arm_lost
            or self.silent("tapper", now)
            or any(state.state == TapperState.DISCONNECTED for state in self._boards.values())
        )

    def withdrawn(self, now: Now) -> bool:
        """True when the arm gives the camera a free view, nothing is charged and no striker of a
        fixed mount is out."""
        arm = self.arm
        free = not self.has_arm or (
            arm is not None and arm.state == ArmState.IDLE and arm.clear_of_camera
        )
        safe = all(state.state == TapperState.SAFE for state in self._boards.values())
        return free and bool(self._boards) and safe and not self.lost(now)

    def in_position(self, tap_id: int) -> bool:
        """True when the arm publishes that it is in position for that tap."""
        arm = self.arm
        return arm is not None and arm.tap_id == tap_id and arm.state == ArmState.IN_POSITION

    def left_behind(self) -> int:
        """Id of a tap that the arm still serves for a planner that is gone; 0 for none."""
        arm = self.arm
        serving = arm is not None and arm.state in (ArmState.IN_POSITION, ArmState.MOVING)
        return int(arm.tap_id) if arm is not None and serving else 0

    def last_tap_id(self) -> int:
        """The greatest tap id that arm and tapper have published."""
        return max(
            self.arm.tap_id if self.arm is not None else 0,
            *(state.tap_id for state in self._boards.values()),
            0,
        )

    def outcome(self, tap_id: int) -> int:
        """The outcome that the tapper publishes for a tap; NONE while it publishes none."""
        tapper = self.tapper_of(tap_id)
        return int(TapperState.NONE) if tapper is None else int(tapper.outcome)

    def tapper_of(self, tap_id: int) -> TapperState | None:
        """The last word of the board that serves or served a tap; None where none did."""
        serving = [state for state in self._boards.values() if state.tap_id == tap_id]
        return serving[0] if serving else None

    def seen_away_from(self, pose: Pose, distance: float, angle: float) -> bool:
        """True when the object is seen farther than ``distance`` m or turned by more than
        ``angle`` rad from a pose."""
        return _away(self.object, pose, distance, angle)

    def moved(self, name: str, pose: Pose, distance: float, angle: float) -> bool:
        """The same of any object that ``object_states`` tells of."""
        return _away(self._states.get(name), pose, distance, angle)

    def blind(self, waited: float, frames: int, now: Now) -> Trouble:
        """Why no usable observation was made within ``waited`` s."""
        seen, name = self.object, f"'{self._watched}'" if self._watched else "the object"
        if self._own is None or self.silent("object", now):
            return ErrorCode.CAMERA_SILENT, self._silence("object", now)
        if seen is None:
            return (
                ErrorCode.OBJECT_NOT_SEEN,
                f"nothing is heard of {name} on object_states; give camera_pose the same cell file"
                " and other_object_files as tap_planner",
            )
        if seen.error_code:
            told = str(seen.error_msg)
            return int(seen.error_code), f"{name}: {told}" if self._watched else told
        if not seen.visible:
            covers = self.arm is not None and not self.arm.clear_of_camera
            way = (
                "the arm was not withdrawn and may cover it: home the arm, or uncover its marker"
                if covers
                else "uncover its marker"
            )
            return ErrorCode.OBJECT_NOT_SEEN, f"{name} is not seen; {way}"
        age = now.steady - self.observed_at(now)
        if age > self._silence_limit:
            return (
                ErrorCode.CAMERA_SILENT,
                f"the last image is {age:.2f} s old (limit {self._silence_limit:.2f} s); check the"
                " camera's rate and the connection to its computer",
            )
        if seen.at_rest and seen.frames_fused < frames:
            return (
                ErrorCode.TOO_FEW_FRAMES,
                f"only {seen.frames_fused} images of {name} at rest were fused within"
                f" {waited:.0f} s, {frames} are needed (parameter frames_needed); check the"
                " camera's rate",
            )
        return (
            ErrorCode.OBJECT_NOT_AT_REST,
            f"{name} was not at rest within {waited:.0f} s; see that nothing moves it and send"
            " the goal again",
        )

    def _silence(self, name: str, now: Now) -> str:
        heard = now.steady - self._last_heard(name)
        node = NAMES[name]
        if math.isinf(heard):
            return f"{node} has not been heard; start it"
        return (
            f"{node} was last heard {heard:.1f} s ago (limit {self._silence_limit:.1f} s); check"
            " that it is running"
        )


def _away(seen: ObjectState | None, pose: Pose, distance: float, angle: float) -> bool:
    """Whether an object is seen farther or turned by more than that from a pose."""
    if seen is None or not seen.visible or seen.error_code:
        return False
    found = from_message(seen.pose.pose)
    return pose.distance_to(found) > distance or abs(pose.rotation_to(found)) > angle
