"""What camera, arm and tapper say, and what that means for the planner."""

from __future__ import annotations

import math
import time

from rclpy.time import Time
from tapping_cell_msgs.msg import ArmState, ErrorCode, ObjectState, TapperState

from tapping_cell.nodes.conversions import from_message
from tapping_cell.se2 import Pose

Trouble = tuple[int, str]
"""An error code and a sentence."""


class CellMonitor:
    """The last word of each of the three, and how long ago it was said."""

    def __init__(self, silence_limit: float) -> None:
        self._silence_limit = silence_limit
        self.object: ObjectState | None = None
        self.arm: ArmState | None = None
        self.tapper: TapperState | None = None
        self._heard = {"object": -math.inf, "arm": -math.inf, "tapper": -math.inf}

    def on_object(self, message: ObjectState) -> None:
        """Hear ``object_state``."""
        self.object = message
        self._heard["object"] = time.monotonic()

    def on_arm(self, message: ArmState) -> None:
        """Hear ``arm_state``."""
        self.arm = message
        self._heard["arm"] = time.monotonic()

    def on_tapper(self, message: TapperState) -> None:
        """Hear ``tapper_state``."""
        self.tapper = message
        self._heard["tapper"] = time.monotonic()

    def silent(self, who: str) -> bool:
        """Whether ``object``, ``arm`` or ``tapper`` has said nothing for longer than the limit."""
        return time.monotonic() - self._heard[who] > self._silence_limit

    @property
    def pose(self) -> Pose | None:
        """Where the object is seen now; None while it is not seen."""
        seen = self.object
        return from_message(seen.pose.pose) if seen is not None and seen.visible else None

    def usable(self, after: Time, frames: int) -> bool:
        """True for a look at the object at rest that is newer than a moment, of so many frames."""
        seen = self.object
        return bool(
            seen is not None
            and not self.silent("object")
            and Time.from_msg(seen.header.stamp) > after
            and seen.visible
            and seen.at_rest
            and seen.error_code == ErrorCode.NONE
            and seen.frames_fused >= frames
        )

    def missing(self) -> Trouble | None:
        """What keeps the cell from tapping; None when nothing does."""
        arm, tapper = self.arm, self.tapper
        if arm is None or self.silent("arm"):
            return ErrorCode.ARM_SILENT, "the arm's driver says nothing; start scara_arm"
        if arm.state != ArmState.IDLE or not arm.homed:
            return arm.error_code or ErrorCode.ARM_BUSY, arm.error_msg or "the arm is busy"
        if tapper is None or self.silent("tapper"):
            return ErrorCode.TAPPER_SILENT, "the tapper's driver says nothing; start tapper_trigger"
        if tapper.state != TapperState.SAFE:
            code = tapper.error_code or ErrorCode.TAPPER_BUSY
            return code, tapper.error_msg or "the tapper is busy"
        if not tapper.interlock_closed:
            return ErrorCode.TAPPER_INTERLOCK_OPEN, "the tapper's interlock is open; close it"
        if self.object is None or self.silent("object"):
            return ErrorCode.CAMERA_SILENT, "the camera's node says nothing; start camera_pose"
        return None

    def fault(self) -> Trouble | None:
        """A fault of arm or tapper that needs a person; None where there is none."""
        for state, faults in (
            (self.arm, (ArmState.FAULT, ArmState.STOPPED)),
            (self.tapper, (TapperState.FAULT, TapperState.STOPPED)),
        ):
            if state is not None and state.state in faults:
                return state.error_code or ErrorCode.NOT_READY, state.error_msg
        return None

    def lost(self) -> bool:
        """True when arm or tapper went away: their drivers come back by themselves."""
        arm, tapper = self.arm, self.tapper
        return (
            self.silent("arm")
            or self.silent("tapper")
            or (arm is not None and arm.state == ArmState.DISCONNECTED)
            or (tapper is not None and tapper.state == TapperState.DISCONNECTED)
        )

    def withdrawn(self) -> bool:
        """True when the arm gives the camera a free view and nothing is drawn."""
        arm, tapper = self.arm, self.tapper
        return (
            arm is not None
            and tapper is not None
            and arm.state == ArmState.IDLE
            and arm.clear_of_camera
            and tapper.state == TapperState.SAFE
            and not self.lost()
        )

    def in_position(self, tap_id: int) -> bool:
        """True when the arm says that it is in position for that tap."""
        arm = self.arm
        return arm is not None and arm.tap_id == tap_id and arm.state == ArmState.IN_POSITION

    def left_behind(self) -> int:
        """Id of a tap that the arm still serves for a planner that is gone; 0 for none."""
        arm = self.arm
        serving = arm is not None and arm.state in (ArmState.IN_POSITION, ArmState.MOVING)
        return int(arm.tap_id) if serving else 0

    def outcome(self, tap_id: int) -> int:
        """The outcome that the tapper reports for a tap; NONE while it reports none."""
        tapper = self.tapper
        if tapper is None or tapper.tap_id != tap_id:
            return int(TapperState.NONE)
        return int(tapper.outcome)

    def seen_away_from(self, pose: Pose, limit: float) -> bool:
        """True when the object is seen farther than ``limit`` m from a pose."""
        seen = self.object
        if seen is None or not seen.visible or seen.error_code:
            return False
        return pose.distance_to(from_message(seen.pose.pose)) > limit

    def blind(self, patience: float) -> Trouble:
        """Why no look was possible within ``patience`` s."""
        seen = self.object
        if seen is None or self.silent("object"):
            return ErrorCode.CAMERA_SILENT, "the camera's node says nothing; look after it"
        if seen.error_code:
            return int(seen.error_code), str(seen.error_msg)
        if not seen.visible:
            return ErrorCode.OBJECT_NOT_SEEN, "the object is not seen; uncover its marker"
        return (
            ErrorCode.OBJECT_NOT_AT_REST,
            f"the object was not at rest within {patience:.0f} s; hold nothing against it and "
            "send the goal again",
        )
