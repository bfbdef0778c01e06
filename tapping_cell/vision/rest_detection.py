"""Decide from the measured poses and their covariances whether the object is at rest or moving.

The decision is a test of speed. A line fitted to the last few poses gives a velocity and its
standard deviation. The object is at rest only if even the upper confidence bound of the speed is
below the limit. The time until rest is detected therefore depends on the noise, not on a timer.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from tapping_cell.se2 import wrap_angle
from tapping_cell.vision.camera import Array
from tapping_cell.vision.fusion import fuse_information

_BEGINNING, _LARGEST_BEGINNING = 0.25, 0.002
"""Error of the first pose after a rest.

If the motion begins within the exposure, the blurred image does not correspond to the middle of the
exposure. The resulting error is at most the whole displacement from the rest pose. ``_BEGINNING``
is the standard deviation of this error, as a fraction of the displacement. It no longer grows if
the displacement exceeds ``_LARGEST_BEGINNING`` (m).
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
    longest: int = 6
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


class _Resting:
    """The last poses (3,) of an object at rest, with the inverses of their covariances (3, 3).

    The arrays have twice the required size, so that the poses to fuse are always one contiguous
    view.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._begin = self._end = 0
        self._poses = np.empty((2 * size, 3))
        self._information = np.empty((2 * size, 3, 3))

    def __len__(self) -> int:
        return self._end - self._begin

    def append(self, pose: Array, covariance: Array) -> None:
        """Add a pose, and drop the oldest one if there are too many."""
        if self._end == 2 * self._size:
            kept = slice(self._end - self._size + 1, self._end)
            self._poses[: self._size - 1] = self._poses[kept]
            self._information[: self._size - 1] = self._information[kept]
            self._begin, self._end = 0, self._size - 1
        self._poses[self._end] = pose
        self._information[self._end] = np.linalg.inv(covariance)
        self._end += 1
        self._begin = max(self._begin, self._end - self._size)

    def last(self, count: int) -> tuple[Array, Array]:
        """Return the newest ``count`` poses and inverse covariances, oldest first."""
        chosen = slice(max(self._begin, self._end - count), self._end)
        return self._poses[chosen], self._information[chosen]


class Track:
    """Poses of the object since its last motion, by which rest and motion are detected."""

    def __init__(self, settings: RestSettings | None = None) -> None:
        self.settings = settings or RestSettings()
        self.clear()

    def clear(self) -> None:
        """Clear all poses, so that the next pose begins a new track."""
        self._passed: tuple[float, Array, Array] | None = None
        self._begin()

    def _begin(self) -> None:
        self._recent: deque[tuple[float, Array, Array]] = deque(maxlen=self.settings.longest)
        self._resting = _Resting(self.settings.memory)
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
            self._resting.append(pose, covariance)
            fused, spread = self._fuse()
            return Motion(fused, spread, len(self._resting), np.zeros(3), self._rest_since)
        if self._rest_since is not None:
            # A single frame that deviates from the rest pose is not fused. Only a second
            # consecutive deviating frame ends the rest.
            self._outliers += 1
            if self._outliers == 1:
                velocity = self._step_velocity(stamp, pose)
                return Motion(pose, covariance + self._beginning(pose), 1, velocity, None)
            self._begin()
        self._recent.append((stamp, pose, covariance))
        window = self._resting_window()
        if window:
            chosen = list(self._recent)[-window:]
            self._rest_since = chosen[0][0]
            for _, chosen_pose, its_covariance in chosen:
                self._resting.append(chosen_pose, its_covariance)
            fused, spread = self._fuse()
            return Motion(fused, spread, window, np.zeros(3), self._rest_since)
        velocity, _ = self._velocity(min(3, len(self._recent)))
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
        step = pose - before[1]
        step[2] = wrap_angle(step[2])
        pace = step / (stamp - before[0])
        self._passed = (stamp, pose, pace)
        change = pace - before[2]
        steady = np.hypot(*change[:2]) < _STEADY * np.hypot(*pace[:2])
        return pace + change if steady else pace

    def _fuse(self) -> tuple[Array, Array]:
        self._fused = fuse_information(*self._resting.last(len(self._resting)))
        return self._fused

    def stays(self, pose: Array, covariance: Array) -> bool:
        """Return whether this pose agrees with the rest pose."""
        if self._rest_since is None:
            return False
        fused, spread = self._fused
        if _distance(pose, covariance, fused, spread) > self.settings.leave:
            return False
        # A motion may be too slow to exceed the noise of one frame. To detect it, compare the mean
        # of the last few frames with the mean of all frames of the rest.
        if len(self._resting) < 12:
            return True
        poses, information = self._resting.last(4)
        mean, error = fuse_information(
            np.concatenate([poses, pose[None]]),
            np.concatenate([information, np.linalg.inv(covariance)[None]]),
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

    def _velocity(self, window: int) -> tuple[Array, Array]:
        """Velocity (3,) of the last frames by least squares, and its standard deviations."""
        if window < 2:
            return np.zeros(3), np.full(3, np.inf)
        return _slope(*self._stacked(window))

    def _stacked(self, window: int) -> tuple[Array, Array, Array]:
        """Stamps (N,) of the last frames, their poses (N, 3) relative to the newest, variances (N,
        3)."""
        chosen = list(self._recent)[-window:]
        stamps = np.array([stamp for stamp, _, _ in chosen])
        poses = np.array([pose for _, pose, _ in chosen])
        relative = poses - poses[-1]
        relative[:, 2] = wrap_angle(relative[:, 2])
        variance = np.array([covariance.diagonal() for _, _, covariance in chosen])
        return stamps - stamps[-1], relative, variance

    def _step_velocity(self, stamp: float, pose: Array) -> Array:
        last_stamp, last_pose, _ = self._recent[-1]
        step = pose - last_pose
        step[2] = wrap_angle(step[2])
        return np.asarray(step / (stamp - last_stamp))

    def _beginning(self, pose: Array) -> Array:
        """Covariance (3, 3) of a pose just after a rest, due to the unknown start of the motion."""
        step = pose - self._fused[0]
        step[2] = wrap_angle(step[2])
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
    error = first - second
    error[2] = wrap_angle(error[2])
    return float(error @ np.linalg.solve(first_cov + second_cov, error))
