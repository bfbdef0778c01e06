"""Monitor that evaluates the last messages of camera, arm and tapper for the planner."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from tapping_cell.logic import enabling
from tapping_cell.logic.clock import Now, to_nanoseconds
from tapping_cell.logic.device import LONGEST_TIMEOUT_S
from tapping_cell.logic.peer_clock import SKEW_LIMIT_S, PeerClock, skewed_clock
from tapping_cell.logic.poses import covariance_from_message, from_message
from tapping_cell.logic.slide_record import SlideRecord
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    ObjectState,
    ObjectStates,
    TapperState,
)
from tapping_cell.planning import PlanningError
from tapping_cell.planning.session import noise_of
from tapping_cell.planning.track import Track
from tapping_cell.se2 import Pose

CodedError = tuple[int, str]
"""Error code and message."""

QUICKEST_IMAGE_S = 0.05
"""Margin for the error of an image's estimated capture time, s. The estimate is too late by the
smallest delay of the camera's messages, because this delay cannot be distinguished from a
difference between the clocks. The capture time is compared with events of arm and tapper. The
messages of arm and tapper are delayed too, so the error is only the difference between the smallest
delays."""
OF_AN_OBJECT = (ErrorCode.NONE, ErrorCode.OBJECT_NOT_SEEN, ErrorCode.MARKER_AMBIGUOUS)
"""Codes of an observation that concern one object, not the whole image."""
FAULTED = (TapperState.FAULT, TapperState.STOPPED)
DOING = {
    ArmState.HOMING: "homing",
    ArmState.MOVING: "moving",
    ArmState.IN_POSITION: "at a strike pose",
    ArmState.WITHDRAWING: "withdrawing",
}
NAMES = {"object": "camera_pose", "arm": "scara_arm", "tapper": "tapper_trigger"}


class CellMonitor:
    """Stores the last messages of camera, arm and tapper boards, each with its time of arrival.

    The times of observations and of other events are compared on this computer's steady clock. The
    camera's stamps are converted with the estimated offset between the two clocks.
    """

    def __init__(self, silence_limit: float) -> None:
        self._silence_limit = silence_limit
        self._states: dict[str, ObjectState] = {}
        self._observed: tuple[str, ...] = ()
        """Names of the objects in the last message; the first one is the cell's own object."""
        self._chosen = self._expected = ""
        self.conflict = ""
        """Which nodes do the work of one node of the cell, as a sentence; empty: none."""
        self.arm: ArmState | None = None
        self.tapper: TapperState | None = None
        self._arm_expected: bool | None = None
        self._clocks = {name: PeerClock() for name in NAMES}
        self.camera_clock = self._clocks["object"]
        self._received = {name: -math.inf for name in NAMES}
        self._seen_at: dict[str, float] = {}
        """Time at which each object was last seen, s of the steady clock; the time of the first
        message about an object that was never seen."""
        self._places: dict[str, Pose] = {}
        """Pose at which each object of ``object_states`` was last seen."""
        self._slides: dict[str, SlideRecord] = {}
        self._covered_at: dict[str, float] = {}
        """Last time at which the arm may have hidden each object, s of the steady clock."""
        self._stops: dict[str, set[int]] = {}
        """Times (ns) of the stops that arm and tapper have reported; 0 for no stop. They are all
        kept, because an old message may arrive again."""

    @property
    def object(self) -> ObjectState | None:
        """Last received state of the watched object; None if no state was received."""
        return self._state_of(self._chosen)

    def _state_of(self, name: str) -> ObjectState | None:
        return self._states.get(name or self._own)

    @property
    def _own(self) -> str:
        """Name of the cell's own object."""
        return self._expected or next(iter(self._observed), "")

    @property
    def _watched(self) -> str:
        """Name of the watched object."""
        return self._chosen or self._own

    def watch(self, name: str) -> None:
        """Select the object for all following queries by its name in ``object_states``. An empty
        name selects the cell's own object."""
        self._chosen = name

    def expect(self, has_arm: bool, name: str) -> None:
        """Set whether the cell has an arm, and the name of its own object. Without this call, the
        monitor derives from the received messages whether there is an arm."""
        self._arm_expected, self._expected = has_arm, name

    @property
    def has_arm(self) -> bool:
        """Whether the cell has an arm."""
        if self._arm_expected is not None:
            return self._arm_expected
        return self.tapper is None or not self.tapper.fixed_mounts

    @property
    def tip(self) -> tuple[float, float, float, float] | None:
        """Last reported pose of the arm's tip: x, y, height and yaw in ``table``; None if the arm
        is not homed."""
        if self.arm is None or not self.arm.homed:
            return None
        place = from_message(self.arm.tip_pose)
        return place.x, place.y, self.arm.tip_pose.position.z, place.theta

    def on_objects(self, message: ObjectStates, now: Now) -> None:
        """Process ``object_states``."""
        self._received["object"] = now.steady
        self.camera_clock.receive(message.header.stamp, now)
        self._observed = tuple(state.object_id for state in message.objects)
        for state in message.objects:
            self._states[state.object_id] = state
            self._note_seen(state.object_id, state, now)
            if state.visible:
                self._places[state.object_id] = from_message(state.pose.pose)

    def place(self, name: str) -> Pose | None:
        """Return the pose at which an object of ``object_states`` was last seen; None if it was
        never seen."""
        return self._places.get(name)

    def note_covered(self, name: str, now: Now) -> None:
        """Store that the arm may hide an object of ``object_states`` now."""
        self._covered_at[name] = now.steady

    def begin_track(self) -> None:
        """Forget earlier slides of the watched object, because a tap is planned now."""
        if (record := self._slides.get(self._watched)) is not None:
            record.begin()

    def track(self, rest: ObjectState) -> Track | None:
        """Return the track of the slide of the watched object since ``begin_track``. It is observed
        at rest in ``rest``. Return None if no slide was seen."""
        record = self._slides.get(self._watched)
        return None if record is None else record.last_slide(rest)

    def _note_seen(self, name: str, state: ObjectState, now: Now) -> None:
        if state.visible and not state.error_code:
            if not _implausible(state):
                self._slides.setdefault(name, SlideRecord()).add(state)
            seen = min(self.camera_clock.to_steady(state.header.stamp, now), now.steady)
            self._seen_at[name] = max(self._seen_at.get(name, -math.inf), seen)
        else:
            # An object may have been hidden only just before this process started.
            self._seen_at.setdefault(name, now.steady)

    def on_arm(self, message: ArmState, now: Now) -> CodedError | None:
        """Process ``arm_state``. Return the error of a stop since the last message, or None."""
        self.arm = message
        self._received["arm"] = now.steady
        self._clocks["arm"].receive(message.header.stamp, now)
        return self._new_stop("arm", to_nanoseconds(message.last_stop))

    def on_tapper(self, message: TapperState, now: Now) -> CodedError | None:
        """Process ``tapper_state``. Return the error of a stop since the last message, or None."""
        self.tapper = message
        self._received["tapper"] = now.steady
        self._clocks["tapper"].receive(message.header.stamp, now)
        return self._new_stop("tapper", to_nanoseconds(message.last_stop))

    def _new_stop(self, name: str, stamp: int) -> CodedError | None:
        """Return the error of a stop since the last message, even if the messages with the state
        STOPPED were missed. ``stamp``: reported time of the last stop, ns; a restarted node reports
        0 until it is stopped again."""
        known = self._stops.setdefault(name, {0, stamp})
        if stamp in known:
            return None
        known.add(stamp)
        code = ErrorCode.ARM_STOPPED if name == "arm" else ErrorCode.TAPPER_STOPPED
        return code, f"the {name} was stopped; make the cell safe, then send the goal again"

    def known_stops(self) -> dict[str, list[int]]:
        """Return the times (ns) of all stops that arm and tapper have reported; 0 for no stop."""
        return {name: sorted(stamps) for name, stamps in self._stops.items()}

    def recall_stops(self, stops: Mapping[str, Iterable[int]]) -> CodedError | None:
        """Set the stops that a former process knew (see ``known_stops``). Every other one is new,
        also that in the first message. Return the error of a new one that was already received, or
        None."""
        received = self._stops
        # If the former process had received no message of a device, it knew none of its stops.
        self._stops = {name: {0, *stops.get(name, ())} for name in ("arm", "tapper")}
        errors = [self._new_stop(name, one) for name in received for one in received[name]]
        return next((error for error in errors if error is not None), None)

    def silent(self, name: str, now: Now) -> bool:
        """Return whether the message timeout of ``object``, ``arm`` or ``tapper`` has passed."""
        return now.steady - self._received[name] > self._silence_limit

    def observed_at(self, now: Now) -> float:
        """Return the time of the last image, in s of this computer's steady clock."""
        if self.object is None:
            return -math.inf
        return self.camera_clock.to_steady(self.object.header.stamp, now)

    def unseen_for(self, now: Now) -> float:
        """Return the time since the object was last seen, or since the first message about it if it
        was never seen, s; 0 if the last observation shows the object, however old that observation
        is."""
        seen = self.object
        if seen is not None and seen.visible and not seen.error_code:
            return 0.0
        return now.steady - self._seen_at.get(self._watched, -math.inf)

    def missing_for(self, now: Now) -> float:
        """Same as :meth:`unseen_for`, without the time until the arm last may have hidden the
        object, s."""
        covered = self._covered_at.get(self._watched, -math.inf)
        return min(self.unseen_for(now), now.steady - covered)

    @property
    def pose(self) -> Pose | None:
        """Present pose of the object; None while it is not seen."""
        return self.pose_of(self._watched)

    def pose_of(self, name: str) -> Pose | None:
        """Return the present pose of an object, which need not be watched; None while it is not
        seen. ``name``: see :meth:`watch`."""
        seen = self._state_of(name)
        return from_message(seen.pose.pose) if seen is not None and seen.visible else None

    def usable(self, after: float, frames: int, now: Now) -> bool:
        """Return whether the last observation shows the object at rest, was made after the steady
        time ``after``, and was fused from at least ``frames`` frames."""
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
            and not _implausible(seen)
        )

    def at_rest_after(self, moment: float, now: Now) -> bool:
        """Return whether the object is seen at rest and came to rest after the steady time
        ``moment``."""
        seen = self.object
        if seen is None or not seen.visible or not seen.at_rest:
            return False
        since = self.camera_clock.to_steady(seen.at_rest_since, now)
        return since > moment + QUICKEST_IMAGE_S

    def foreign_object(self) -> CodedError | None:
        """Return an error if the camera observes another object than that of the cell's file, or
        None."""
        if not self._observed or self._own in self._observed:
            return None
        return (
            ErrorCode.CONFIGURATION_CONFLICT,
            f"object_states is about {', '.join(map(repr, self._observed))}, but tap_planner"
            f" positions '{self._own}'; give camera_pose and tap_planner the same cell file",
        )

    def why_not_ready(self, now: Now) -> CodedError | None:
        """Return why the cell is not ready for a tap, or None if the cell is ready."""
        arm, tapper = self.arm, self.tapper
        if self.conflict:
            return ErrorCode.CONFIGURATION_CONFLICT, self.conflict
        if (foreign := self.foreign_object()) is not None:
            return foreign
        of_arm = self._why_arm_not_ready(arm, now) if self.has_arm else None
        if of_arm is not None:
            return of_arm
        if tapper is None or (
            self.silent("tapper", now) and not self._connecting("tapper", tapper, now)
        ):
            return ErrorCode.TAPPER_SILENT, self._silence("tapper", now)
        if tapper.state != TapperState.SAFE:
            code = tapper.error_code or ErrorCode.TAPPER_BUSY
            return code, tapper.error_msg or "the tapper is busy"
        if not self.has_arm and (not tapper.mounts_proven or tapper.away):
            code = tapper.error_code or ErrorCode.TAPPER_MOUNT_NOT_PROVEN
            return code, tapper.error_msg or (
                "the strikers are not yet confirmed to be at their mounts"
            )
        if not tapper.interlock_closed:
            return ErrorCode.TAPPER_INTERLOCK_OPEN, "the tapper's interlock is open; close it"
        if not self._observed or self.silent("object", now):
            return ErrorCode.CAMERA_SILENT, self._silence("object", now)
        return self._clock_error(now)

    def _clock_error(self, now: Now) -> CodedError | None:
        skewed = skewed_clock(self._clocks, now)
        if skewed is None:
            return None
        name, skew = skewed
        return (
            ErrorCode.CLOCKS_DIFFER,
            f"the local clock differs by {skew:+.2f} s from that of the computer of"
            f" {NAMES[name]} (limit {SKEW_LIMIT_S:.2f} s), or its messages are delayed that much;"
            " synchronise the computers' clocks",
        )

    def _why_arm_not_ready(self, arm: ArmState | None, now: Now) -> CodedError | None:
        if arm is None or (self.silent("arm", now) and not self._connecting("arm", arm, now)):
            return ErrorCode.ARM_SILENT, self._silence("arm", now)
        if arm.set_up and not arm.enabled:
            return enabling.RELEASED
        if arm.state != ArmState.IDLE:
            doing = DOING.get(arm.state, "busy")
            return arm.error_code or ErrorCode.ARM_BUSY, arm.error_msg or f"the arm is {doing}"
        return None

    def _connecting(self, name: str, state: ArmState | TapperState, now: Now) -> bool:
        """Return whether the last message of a silent driver reports a connection error that is
        still valid: a driver publishes nothing while it tries to connect."""
        disconnected = state.state == (
            ArmState.DISCONNECTED if name == "arm" else TapperState.DISCONNECTED
        )
        attempt = LONGEST_TIMEOUT_S + self._silence_limit
        age = now.steady - self._received[name]
        return disconnected and state.error_code != ErrorCode.NONE and age <= attempt

    def fault(self) -> CodedError | None:
        """Return a fault of arm or tapper that a person must clear, or None."""
        for state, faults in (
            (self.arm, (ArmState.FAULT, ArmState.STOPPED)),
            (self.tapper, FAULTED),
        ):
            if state is not None and state.state in faults:
                return state.error_code or ErrorCode.NOT_READY, state.error_msg
        return None

    def homing_error(self) -> CodedError | None:
        """Return the error of an arm whose position is not known, or None."""
        arm = self.arm
        if not self.has_arm or arm is None or arm.state != ArmState.NOT_HOMED:
            return None
        return arm.error_code or ErrorCode.ARM_NOT_HOMED, arm.error_msg

    def is_disconnected(self, now: Now) -> bool:
        """Return whether the connection to arm or tapper is lost; their drivers reconnect
        automatically."""
        arm, tapper = self.arm, self.tapper
        arm_lost = self.has_arm and (
            self.silent("arm", now) or (arm is not None and arm.state == ArmState.DISCONNECTED)
        )
        return (
            arm_lost
            or self.silent("tapper", now)
            or (tapper is not None and tapper.state == TapperState.DISCONNECTED)
        )

    def is_withdrawn(self, now: Now) -> bool:
        """Return whether the arm does not restrict the camera's view, no tapper is charged, and
        every striker at a fixed mount is retracted."""
        arm = self.arm
        free = not self.has_arm or (
            arm is not None and arm.state == ArmState.IDLE and arm.clear_of_camera
        )
        safe = self.tapper is not None and self.tapper.state == TapperState.SAFE
        return free and safe and not self.is_disconnected(now)

    def in_position(self, tap_id: int) -> bool:
        """Return whether the arm reports that it is in position for this tap."""
        arm = self.arm
        return arm is not None and arm.tap_id == tap_id and arm.state == ArmState.IN_POSITION

    def reach_error(self, tap_id: int) -> CodedError | None:
        """Return why the arm cannot reach the strike pose of this tap, or None if the arm has not
        reported this error."""
        arm = self.arm
        if arm is None or arm.tap_id != tap_id or arm.error_code != ErrorCode.ARM_OUT_OF_REACH:
            return None
        return arm.error_code, arm.error_msg

    def orphaned_tap_id(self) -> int:
        """Return the id of the tap that a previous planner has commanded and that the arm still
        executes; 0 if there is no such tap."""
        arm = self.arm
        serving = arm is not None and arm.state in (ArmState.IN_POSITION, ArmState.MOVING)
        return int(arm.tap_id) if arm is not None and serving else 0

    def last_tap_id(self, largest: int) -> int:
        """Return the greatest tap id up to ``largest`` that arm and tapper publish; 0 if there is
        none."""
        published = (state.tap_id for state in (self.arm, self.tapper) if state is not None)
        return max((tap_id for tap_id in published if tap_id <= largest), default=0)

    def outcome(self, tap_id: int) -> int:
        """Return the outcome that the tapper publishes for a tap; NONE if it publishes none."""
        tapper = self.tapper_of(tap_id)
        return int(TapperState.NONE) if tapper is None else int(tapper.outcome)

    def tapper_of(self, tap_id: int) -> TapperState | None:
        """Return the last state of the tapper if this state is about the given tap, otherwise
        None."""
        tapper = self.tapper
        return tapper if tapper is not None and tapper.tap_id == tap_id else None

    def seen_away_from(self, pose: Pose, distance: float, angle: float) -> bool:
        """Return whether the object is seen more than ``distance`` m or ``angle`` rad away from a
        pose."""
        return _away(self.object, pose, distance, angle)

    def moved(self, name: str, pose: Pose, distance: float, angle: float) -> bool:
        """Same as :meth:`seen_away_from` for the object ``name`` in ``object_states``."""
        return _away(self._states.get(name), pose, distance, angle)

    def sees_at_rest(self, name: str) -> bool:
        """Return whether the last observation shows the object ``name`` of ``object_states`` at
        rest."""
        return self.sees(name) and self._states[name].at_rest

    def sees(self, name: str) -> bool:
        """Return whether the last observation shows the object ``name`` of ``object_states``."""
        state = self._states.get(name)
        return state is not None and state.visible and not state.error_code

    def why_not_observed(
        self, waited: float | None, frames: int, now: Now, moved_aside: bool = False
    ) -> CodedError:
        """Return why there is no usable observation.

        ``waited``: time, s, for which the goal waited for a usable observation before the goal was
        given up; None if the goal is not given up. ``moved_aside``: whether the arm has already
        moved aside to uncover the object.
        """
        within = "" if waited is None else f" within {waited:.0f} s"
        seen, own = self.object, self._state_of("")
        name = f"'{self._chosen}'" if self._chosen else "the object"
        if not self._observed or self.silent("object", now):
            return ErrorCode.CAMERA_SILENT, self._silence("object", now)
        if own is not None and own.error_code not in OF_AN_OBJECT:
            # camera_pose reports a problem of the image only in the state of the cell's own object.
            return int(own.error_code), own.error_msg
        if seen is None:
            return (
                ErrorCode.OBJECT_NOT_SEEN,
                f"object_states has no message about {name}; give camera_pose the same cell "
                "file and other_object_files as tap_planner",
            )
        if seen.error_code:
            text = f"{name}: {seen.error_msg}" if self._chosen else str(seen.error_msg)
            if seen.error_code == ErrorCode.OBJECT_NOT_SEEN and not seen.visible:
                text += self._hidden_place(moved_aside)
            return int(seen.error_code), text
        if not seen.visible:
            return (
                ErrorCode.OBJECT_NOT_SEEN,
                f"{name} is not seen; uncover the marker{self._hidden_place(moved_aside)}",
            )
        age = now.steady - self.observed_at(now)
        if age > self._silence_limit:
            return self._clock_error(now) or (
                ErrorCode.CAMERA_SILENT,
                f"the last image is {age:.2f} s old (limit {self._silence_limit:.2f} s); check the"
                " camera's rate and the connection to its computer",
            )
        if implausible := _implausible(seen):
            return ErrorCode.OBJECT_NOT_SEEN, f"{name}: {implausible}; check camera_pose"
        if seen.at_rest and seen.frames_fused < frames:
            return (
                ErrorCode.TOO_FEW_FRAMES,
                f"only {seen.frames_fused} images of {name} at rest were fused{within}, but "
                f"{frames} are needed (parameter frames_needed); check the camera's rate",
            )
        return (
            ErrorCode.OBJECT_NOT_AT_REST,
            f"{name} was not at rest{within}; make sure that nothing moves it"
            + (", then send the goal again" if waited is not None else ""),
        )

    def _hidden_place(self, moved_aside: bool) -> str:
        """Return the end of a sentence: which part of the table the arm hides. Empty in a cell
        without an arm."""
        if not self.has_arm or self.arm is None:
            return ""
        if not self.arm.clear_of_camera:
            return "; the arm was not withdrawn and may cover it: home the arm"
        tip = self.tip
        if tip is None:
            return "; if the arm covers it, home the arm"
        moved = ", and was moved once more because the object was not seen," if moved_aside else ""
        return (
            f"; the arm has withdrawn{moved} and hides only what lies under it (its tool is at"
            f" x {1000 * tip[0]:.0f} mm, y {1000 * tip[1]:.0f} mm): if the object lies there, move"
            " it to a visible place, then send the goal again"
        )

    def _silence(self, name: str, now: Now) -> str:
        age = now.steady - self._received[name]
        node = NAMES[name]
        if math.isinf(age):
            return f"{node} has not sent a message yet; start it"
        return (
            f"{node} sent its last message {age:.1f} s ago (limit {self._silence_limit:.1f} s); "
            "check that it is running"
        )


def _implausible(seen: ObjectState) -> str:
    """Return why no tap can be planned from the covariance of an observation, or "" if it can."""
    covariance = covariance_from_message(seen.pose.covariance)
    if not np.isfinite(covariance).all():
        return "the covariance of its pose is not finite"
    try:
        noise_of(covariance)
    except PlanningError as error:
        return f"the covariance of its pose is out of range ({error})"
    return ""


def _away(seen: ObjectState | None, pose: Pose, distance: float, angle: float) -> bool:
    """Return whether an object is seen more than ``distance`` m or ``angle`` rad from a pose."""
    if seen is None or not seen.visible or seen.error_code:
        return False
    found = from_message(seen.pose.pose)
    return pose.distance_to(found) > distance or abs(pose.rotation_to(found)) > angle
