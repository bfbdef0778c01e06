"""Decide from the measured poses and their covariances whether the object is at rest or moving.

The decision is a test of speed. A line fitted to the last few poses gives a velocity and its
standard deviation. The object is at rest only if even the upper confidence bound of the speed is
below the limit. The time until rest is detected therefore depends on the noise, not on a timer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tapping_cell.vision.camera import Array
from tapping_cell.vision.fusion import fuse_information, pose_difference

_BEGINNING, _LARGEST_BEGINNING = 0.25, 0.002
"""Error of the first pose after a rest.

If the motion begins within the exposure, the blurred image does not correspond to the middle of the
exposure. The resulting error is at most the whole displacement from the rest pose. ``_BEGINNING``
is the standard deviation of this error, as a fraction of the displacement. The standard deviation
is constant for displacements above ``_LARGEST_BEGINNING`` (m).
"""


_STEADY = 0.3
"""Maximum relative change of a sliding object's velocity from frame to frame; an impact or a stop
changes the velocity by more."""


@dataclass(frozen=True, slots=True)
class RestSettings:
    """Settings of the rest detection.

    The object counts as moving above ``speed`` (m/s) or ``turn`` (rad/s), tested with
    ``confidence`` standard deviations over windows of ``shortest`` to ``longest`` frames. At most
    ``memory`` frames are fused. ``leave`` is the squared Mahalanobis distance (3 degrees of
    freedom) at which a pose no longer agrees with the rest pose. The track is cleared after ``gap``
    (s) without a pose.
    """

    speed: float = 0.0005
    turn: float = 0.02
    confidence: float = 5.0
    shortest: int = 3
    longest: int = 60
    memory: int = 120
    leave: float = 30.0
    gap: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """State of the track.

    ``pose`` (3,) and ``covariance`` (3, 3) come from ``frames`` measurements. ``velocity`` (3,) is
    in m/s and rad/s. ``rest_since`` is the time (s) since which the object is at rest, None while
    it moves.
    """

    pose: Array
    covariance: Array
    frames: int
    velocity: Array
    rest_since: float | None


class Track:
    """Poses of the object since its last motion, from which rest and motion are detected."""

    def __init__(self, settings: RestSettings | None = None) -> None:
        self.settings = settings or RestSettings()
        self.clear()

    def clear(self) -> None:
        """Clear all poses, so that the next pose begins a new track."""
        self._passed: tuple[float, Array, Array] | None = None
        self._begin()

    def _begin(self) -> None:
        self._recent: deque[tuple[float, Array, Array]] = deque(maxlen=self.settings.longest)
        # The last poses at rest, and the inverses of their covariances.
        self._poses: Array = np.empty((0, 3))
        self._information: Array = np.empty((0, 3, 3))
        self._rest_since: float | None = None
        self._outliers = 0
        self._fused: tuple[Array, Array] = (np.zeros(3), np.zeros((3, 3)))

    def add(self, stamp: float, pose: Array, covariance: Array) -> Motion:
        """Add the pose of a frame captured at ``stamp`` (s, increasing) and return the state."""
        s = self.settings
        if self._recent and stamp - self._recent[-1][0] > s.gap:
            self.clear()
        if self.stays(pose, covariance):
            self._outliers = 0
            self._recent.append((stamp, pose, covariance))
            return self._fuse([(pose, covariance)])
        if self._rest_since is not None:
            # A single frame that deviates from the rest pose is not fused. Only a second
            # consecutive deviating frame ends the rest.
            self._outliers += 1
            if self._outliers == 1:
                last_stamp, last_pose, _ = self._recent[-1]
                velocity = pose_difference(pose, last_pose) / (stamp - last_stamp)
                return Motion(pose, covariance + self._beginning(pose), 1, velocity, None)
            self._begin()
        self._recent.append((stamp, pose, covariance))
        window = self._resting_window()
        if window:
            chosen = list(self._recent)[-window:]
            self._rest_since = chosen[0][0]
            return self._fuse([measured for _, *measured in chosen])
        velocity = np.zeros(3)
        if len(self._recent) > 1:
            velocity, _ = _slope(*self._stacked(3))
        return Motion(pose, covariance, 1, velocity, None)

    def heading(self, stamp: float, pose: Array, motion: Motion) -> Array:
        """Velocity (3,) with which to predict the pose in the next frame from the pose just added.

        This is the velocity of the last step, plus the last change of velocity if the velocity
        changes steadily. ``motion.velocity``, the slope over several frames, is less noisy but lags
        by one frame.
        """
        before, self._passed = self._passed, (stamp, pose, np.zeros(3))
        if before is None or motion.rest_since is not None:
            return motion.velocity
        pace = pose_difference(pose, before[1]) / (stamp - before[0])
        self._passed = (stamp, pose, pace)
        change = pace - before[2]
        steady = np.hypot(*change[:2]) < _STEADY * np.hypot(*pace[:2])
        return pace + change if steady else pace

    def _fuse(self, measured: Sequence[Sequence[Array]]) -> Motion:
        """Add poses and covariances of the object at rest, and fuse all that are kept."""
        poses, covariances = zip(*measured, strict=True)
        kept = self.settings.memory
        self._poses = np.concatenate([self._poses, poses])[-kept:]
        self._information = np.concatenate([self._information, np.linalg.inv(covariances)])[-kept:]
        self._fused = fuse_information(self._poses, self._information)
        return Motion(*self._fused, len(self._poses), np.zeros(3), self._rest_since)

    def stays(self, pose: Array, covariance: Array) -> bool:
        """Return whether this pose agrees with the rest pose."""
        if self._rest_since is None:
            return False
        fused, spread = self._fused
        if _distance(pose, covariance, fused, spread) > self.settings.leave:
            return False
        # A motion may be too slow to exceed the noise of one frame. To detect such a motion,
        # compare the mean of the last few frames with the mean of all frames of the rest.
        if len(self._poses) < 12:
            return True
        mean, error = fuse_information(
            np.concatenate([self._poses[-4:], pose[None]]),
            np.concatenate([self._information[-4:], np.linalg.inv(covariance)[None]]),
        )
        return _distance(mean, error, fused, spread) <= self.settings.leave

    def _resting_window(self) -> int:
        """Length of the shortest window that proves rest; 0 if none does."""
        s = self.settings
        if len(self._recent) < s.shortest:
            return 0
        track = self._stacked(len(self._recent))
        for window in range(s.shortest, len(self._recent) + 1):
            velocity, spread = _slope(*(column[-window:] for column in track))
            bound = np.abs(velocity) + s.confidence * spread
            if np.hypot(bound[0], bound[1]) < s.speed and bound[2] < s.turn:
                return window
        return 0

    def _stacked(self, window: int) -> tuple[Array, Array, Array]:
        """Stamps (N,) of the last frames, the poses (N, 3) relative to the newest pose, and the
        variances (N, 3) of the poses."""
        chosen = list(self._recent)[-window:]
        stamps = np.array([stamp for stamp, _, _ in chosen])
        poses = np.array([pose for _, pose, _ in chosen])
        variance = np.array([covariance.diagonal() for _, _, covariance in chosen])
        return stamps - stamps[-1], pose_difference(poses, poses[-1]), variance

    def _beginning(self, pose: Array) -> Array:
        """Covariance (3, 3) of a pose just after a rest, due to the unknown start of the motion."""
        step = pose_difference(pose, self._fused[0])
        way = float(np.hypot(step[0], step[1]))
        step *= _BEGINNING * min(1.0, _LARGEST_BEGINNING / max(way, 1e-9))
        return np.asarray(np.outer(step, step), dtype=float)


def _slope(stamps: Array, poses: Array, variances: Array) -> tuple[Array, Array]:
    """Slope (3,) of the line through poses (N, 3) by least squares, and its standard deviations."""
    t = stamps - stamps.sum() / len(stamps)
    weight = t / (t @ t)
    return weight @ poses, np.sqrt((weight * weight) @ variances)


def _distance(first: Array, first_cov: Array, second: Array, second_cov: Array) -> float:
    """Squared Mahalanobis distance of two poses with independent errors."""
    error = pose_difference(first, second)
    return float(error @ np.linalg.solve(first_cov + second_cov, error))
