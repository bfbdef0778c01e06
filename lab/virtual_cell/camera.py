"""Model of the camera and its node in virtual time; publishes ``object_states`` for each frame.

The pose in each frame is the ground truth with noise. Rest, fusion and covariance are computed by
the tracker of the product (``vision.rest_detection``). No images are rendered.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lab.virtual_cell.scheduler import Scheduler
from tapping_cell.logic.clock import to_nanoseconds, to_stamp
from tapping_cell.logic.poses import covariance_to_message, to_message
from tapping_cell.messages import ErrorCode, ObjectState, ObjectStates, PoseWithCovariance
from tapping_cell.se2 import Pose
from tapping_cell.vision.rest_detection import RestSettings, Track

PERIOD_S = 1 / 15
"""Frame period, s. The frame rate is half that of the real camera, so that a run needs only half of
the processor time."""
LATENCY_S = 0.02
"""Time from the exposure to the publication of the pose."""
SILENCE_LIMIT_S = 0.4
"""Time without a frame after which the node reports that the camera sends no images."""


@dataclass(slots=True)
class CameraFaults:
    """Active faults of the camera. Times are in s from the start of the run."""

    lost_until: float = -math.inf
    late_until: float = -math.inf
    late_by: float = 0.0
    repeated_until: float = -math.inf
    hidden_until: float = -math.inf
    unusable_until: float = -math.inf
    unusable_code: int = 0
    """Error code of the frames that the node cannot use."""
    wrong_until: float = -math.inf
    wrong_by: Pose = field(default_factory=lambda: Pose(0.0, 0.0, 0.0))


class Camera:
    """Publishes ``object_states`` through ``publish`` while the process of the camera's node runs.

    ``observe`` returns the true pose of the object at a time, or None while the arm covers it.
    ``ros_now`` returns the ROS time (ns) of the camera's computer. ``sigma``: standard deviation of
    the pose in one frame: m, m, rad.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        rng: np.random.Generator,
        observe: Callable[[float], Pose | None],
        ros_now: Callable[[], int],
        publish: Callable[[ObjectStates], None],
        object_id: str,
        sigma: tuple[float, float, float],
    ) -> None:
        self.faults = CameraFaults()
        self.frozen_until = -math.inf
        self.alive = True
        self.exposed: dict[int, float] = {}
        """Time of the exposure of each frame, by its stamp in ns."""
        self._scheduler = scheduler
        self._rng = rng
        self._true_pose = observe
        self._ros_now = ros_now
        self._publish = publish
        self._object_id = object_id
        self._sigma = np.array(sigma)
        self._covariance = np.diag(self._sigma**2)
        self._track = Track(RestSettings())
        self._last: ObjectState | None = None
        self._sent_at = 0.0
        self._silence_reported_at = -math.inf
        scheduler.after(float(rng.uniform(0, PERIOD_S)), self._expose)

    def restart(self) -> None:
        """Restart the process with an empty state."""
        self.alive = True
        self._track = Track(RestSettings())
        self._last = None

    def _expose(self) -> None:
        now = self._scheduler.now
        self._scheduler.after(PERIOD_S, self._expose)
        if not self.alive:
            return
        faults = self.faults
        if now < faults.lost_until:
            if now - self._sent_at > SILENCE_LIMIT_S and now - self._silence_reported_at > 0.4:
                self._silence_reported_at = now
                self._send(self._state(self._ros_now(), ErrorCode.CAMERA_SILENT))
            return
        self._sent_at = now
        delay = LATENCY_S + (faults.late_by if now < faults.late_until else 0.0)
        due = max(now + delay, self.frozen_until)
        if now < faults.repeated_until and self._last is not None:
            repeated = self._last
            self._scheduler.at(due, lambda: self._send(repeated))
            return
        true = None if now < faults.hidden_until else self._true_pose(now)
        if now < faults.unusable_until:
            self._last = state = self._state(self._ros_now(), faults.unusable_code)
        else:
            self._last = state = self._observe(true, now)
        self._scheduler.at(due, lambda: self._send(state))

    def _send(self, state: ObjectState) -> None:
        if self.alive:
            self._publish(self._states_with(state))

    def _states_with(self, own: ObjectState) -> ObjectStates:
        """Return the message with the state of the cell's own object."""
        return ObjectStates(header=own.header, objects=[own])

    def _state(self, stamp: int, code: int = 0) -> ObjectState:
        state = ObjectState(object_id=self._object_id, error_code=code)
        state.header.stamp = to_stamp(stamp)
        state.header.frame_id = "table"
        if code:
            state.error_msg = "no image, or an image that cannot be used; check the camera"
        return state

    def _observe(self, true: Pose | None, now: float) -> ObjectState:
        state = self._state(self._ros_now())
        self.exposed[to_nanoseconds(state.header.stamp)] = now
        if true is not None:
            off = np.array(self.faults.wrong_by) if now < self.faults.wrong_until else np.zeros(3)
            self._measure(state, self._track, np.array(true) + off, now)
        elif now < self.faults.hidden_until:
            state.error_code = ErrorCode.OBJECT_NOT_SEEN
            state.error_msg = "the object is not seen; uncover it"
        else:
            state.hidden_by_arm = True
        return state

    def _measure(
        self, state: ObjectState, track: Track, pose: NDArray[np.float64], now: float
    ) -> None:
        """Add the measurement of an object at a pose (x, y, theta) to its track and enter it in its
        state."""
        stamp = to_nanoseconds(state.header.stamp)
        measured = pose + self._sigma * self._rng.standard_normal(3)
        motion = track.add(now, measured, self._covariance)
        state.visible = True
        state.at_rest = motion.rest_since is not None
        state.frames_fused = motion.frames
        if motion.rest_since is not None:
            state.at_rest_since = to_stamp(stamp - round(1e9 * (now - motion.rest_since)))
        state.pose = PoseWithCovariance(
            pose=to_message(Pose(*map(float, motion.pose))),
            covariance=covariance_to_message(motion.covariance),
        )
        vx, vy, omega = map(float, motion.velocity)
        state.velocity.linear.x, state.velocity.linear.y = vx, vy
        state.velocity.angular.z = omega
