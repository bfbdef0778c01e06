"""Base class that tracks one object over frames, common to markers and outlines.

A follower runs once per frame, after the camera's pose over the table is known. The follower
predicts the object's pose from the last pose and velocity and measures the object there. The track
then decides between rest and motion, and fuses the frames at rest.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import Pose, transform_points, wrap_angle
from tapping_cell.vision.camera import Array, Image, View, at_height
from tapping_cell.vision.markers.edges import MarkerEdges
from tapping_cell.vision.markers.search import Detections
from tapping_cell.vision.observation import Observation, Problem
from tapping_cell.vision.rest_detection import Motion, RestSettings, Track
from tapping_cell.vision.table.tracker import TableTracker, pose_changes

Failure = tuple[Problem, str]
"""Reason for a missing pose, and the sentence that explains it."""

Aim = tuple[Array, NDArray[np.bool_]]
"""A marker to measure: its approximate corners (4, 2) in the image, and its pattern."""

_INSTANT = 1.5e-4
"""Standard deviation (s) of the time to which a motion-blurred frame corresponds. Measured: 0.05 to
0.13 ms in the middle of a slide, up to 0.6 ms if the slide begins or ends within the exposure."""
_RECHECK_LIMITS = 0.003, 0.03
"""Displacement (m) of an object at rest, and of a moving object, after which the systematic error
is computed again."""
_UNSEEN = 0.1
"""Time (s) for which an unseen object is assumed to continue its motion."""
_LOST = 0.2
"""Time (s) of failed measurements after which a thorough search is made. The time must exceed the
processing time of one frame on a slow computer."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A valid frame, and the state of the table in this frame."""

    image: Image
    stamp: float
    working: View
    """View used for measurements. This view is constant while nothing moves, so that refinements of
    the table's pose do not appear as motion of the object."""
    newest: View
    """View in which poses are published."""
    table: TableTracker
    references_seen: bool
    """True if reference markers were measured in this frame."""
    aimed: MarkerEdges | None
    """Edges of the marker that :meth:`ObjectFollower.aim` returned; None if this marker was not
    found."""
    notice: str
    """Warning about the table for a frame with a valid pose; empty if there is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Markers found in a whole image, by dictionary."""

    stamp: float
    detections: Mapping[str, Detections]
    slow: bool
    """True if this search may take the time of several frames, so that the follower can also
    diagnose why the object was not found."""
    expected_ids: Mapping[str, frozenset[int]]
    """Ids of the reference markers, by dictionary."""
    mirrored: Callable[[str], Detections]
    """Returns the markers of a dictionary in the mirrored image. All followers share the result."""


class ObjectFollower(ABC):
    """Follows one object whose visible face is at ``height`` (m) above the table, with the standard
    deviation ``height_tolerance``.

    ``reach`` is the root mean square distance (m) of the face's rim from its centre.
    ``wants_search`` requests a search of the whole next frame.
    """

    dictionary: str | None = None
    """Dictionary of the object's marker; None if it has no marker."""
    fixed: float = 0.0
    """Fraction of the variance of a frame's pose that averaging over more frames does not
    reduce."""

    def __init__(
        self, height: float, height_tolerance: float, reach: float, rest: RestSettings
    ) -> None:
        self.height = height
        self.height_tolerance = height_tolerance
        self.reach = reach
        self.wants_search = True
        self.failure: Failure | None = None
        self.track = Track(rest)
        # Stamp, pose and velocity of the last measurement.
        self._last: tuple[float, Array, Array] | None = None
        self._searching_since: float | None = None
        self._judged: tuple[int, Array, Array, Array] | None = None

    # -- implemented by subclasses; an object without a marker needs only the abstract methods

    @abstractmethod
    def outline(self, pose: Array) -> Array:
        """Return points (N, 2) around the object's visible part at a pose (3,), in ``table``."""

    def detected(self, stamp: float) -> bool:
        """Return whether the search of the frame with this stamp found the object's marker."""
        return False

    def aim(self, stamp: float, view: View | None) -> Aim | None:
        """Return the object's marker to measure in the next frame together with the reference
        markers.

        Measuring them together improves the estimate of the correlation between neighbouring
        pixels' noise.
        """
        return None

    def complete(self, detections: Mapping[str, Detections]) -> bool:
        """Return whether a search has found every marker that this follower needs."""
        return True

    @abstractmethod
    def searched(self, search: Search) -> None:
        """Receive the detections in the whole image, before :meth:`measure` is called for the same
        frame."""

    @abstractmethod
    def measure(self, frame: Frame) -> tuple[Array, Array] | Failure:
        """Return pose (3,) and covariance (3, 3) in the working view, or why there is no pose."""

    @abstractmethod
    def extra_uncertainty(self, frame: Frame) -> tuple[Array, str]:
        """Return the covariance (3, 3) of that part of the last measurement's error that is common
        to all frames, and a warning."""

    # -- common to all followers

    @property
    def found(self) -> bool:
        """True if the object has been located, even if it is not visible now."""
        return self._last is not None

    def lost(self, stamp: float) -> bool:
        """Return whether the object was never found or has been missing for a while."""
        expired = self._searching_since is not None and stamp - self._searching_since > _LOST
        return self._last is None or expired

    def expected(self, stamp: float) -> Array | None:
        """Predict the object's pose (3,) from its last pose and velocity."""
        if self._last is None:
            return None
        then, pose, velocity = self._last
        return np.asarray(pose + velocity * min(stamp - then, _UNSEEN))

    def step(self, stamp: float) -> Array:
        """Predict the object's displacement (2,), in m, from its last pose until the time ``stamp``
        (s)."""
        if self._last is None:
            return np.zeros(2)
        return np.asarray(self._last[2][:2] * min(stamp - self._last[0], _UNSEEN))

    def observe(self, frame: Frame) -> Observation:
        """Measure the object in this frame and evaluate the result."""
        answer = self.measure(frame)
        if isinstance(answer[0], Problem):
            if self._searching_since is None:
                self._searching_since = frame.stamp
            return nothing(frame.stamp, frame.table, answer[0], str(answer[1]))
        pose, covariance = answer[0], np.asarray(answer[1])
        if not frame.references_seen and not self.track.stays(pose, covariance):
            return nothing(
                frame.stamp,
                frame.table,
                Problem.REFERENCES_HIDDEN,
                "no reference markers are seen in this frame and the object seems to have "
                "moved: possibly the camera moved instead",
            )
        self._searching_since = None
        motion = self.track.add(frame.stamp, pose, covariance)
        self._last = (frame.stamp, pose, self.track.heading(frame.stamp, pose, motion))
        return self._good(frame, motion)

    def forget(self) -> None:
        """Discard the last known pose of the object."""
        self._last = None

    def stop(self, stamp: float, pose: Array | None = None) -> None:
        """Expect the object at ``pose``, with the velocity zero.

        If ``pose`` is None, the object is expected at its last pose, and the velocity is set to
        zero only if the last measurement is more than ``_UNSEEN`` s old.
        """
        if pose is not None:
            self._last = (stamp, pose, np.zeros(3))
        elif self._last is not None and stamp - self._last[0] > _UNSEEN:
            self._last = (self._last[0], self._last[1], np.zeros(3))

    def _good(self, frame: Frame, motion: Motion) -> Observation:
        pose = self._through_newest(frame, motion.pose)
        again = _RECHECK_LIMITS[int(motion.rest_since is None)]
        error, shared = self._calibration(frame.table, pose, again)
        pose = pose - error
        extra, sentence = self.extra_uncertainty(frame)
        # A fraction of the variance of a single frame remains, even after many frames are fused.
        spread = motion.covariance * (1.0 + self.fixed * (motion.frames - 1))
        instant = _INSTANT * motion.velocity
        return Observation(
            stamp=frame.stamp,
            visible=True,
            pose=Pose(*pose.tolist()),
            covariance=spread
            + shared
            + extra
            + self._lifted(frame.newest, pose)
            + np.outer(instant, instant),
            at_rest=motion.rest_since is not None,
            at_rest_since=motion.rest_since,
            frames_fused=motion.frames,
            velocity=motion.velocity,
            references_used=frame.table.used,
            sentence=sentence or frame.notice,
        )

    def _through_newest(self, frame: Frame, pose: Array) -> Array:
        """Convert a pose measured in the working view to the newest view of the table."""
        points = self._cross(pose)
        seen = frame.working.pose.apply(at_height(points, self.height))
        newest = frame.newest.rays_on_plane(seen[:, :2] / seen[:, 2:], self.height)
        moved = pose + pose_changes(points, newest - points)
        moved[2] = wrap_angle(moved[2])
        return moved

    def _lifted(self, view: View, pose: Array) -> Array:
        """Covariance (3, 3) of the pose due to the uncertain height of the visible face, which
        displaces the pose away from the point below the camera."""
        away = pose - np.append(view.pose.position[:2], pose[2])
        away *= self.height_tolerance / (view.pose.position[2] - self.height)
        return np.outer(away, away)

    def _cross(self, pose: Array) -> Array:
        """Points (4, 2) that represent the visible face at a pose.

        If the image is shifted, rotated or sheared, a pose fitted to these points changes as much
        as a pose fitted to the whole rim, also if the shift varies quadratically over the face.
        """
        cross = self.reach * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
        return np.asarray(transform_points(pose, cross))

    def _calibration(self, table: TableTracker, pose: Array, again: float) -> tuple[Array, Array]:
        """Return the expected error (3,) that is common to all frames and due to table and lens,
        and the covariance (3, 3) of this error."""
        key = table.field_number
        known = self._judged
        if known is None or known[0] != key or np.abs(known[1] - pose)[:2].max() > again:
            known = (key, pose, *table.judge(self._cross(pose), self.height))
            self._judged = known
        return known[2], known[3]


def nothing(stamp: float, table: TableTracker, problem: Problem, sentence: str) -> Observation:
    """Create the observation of a frame without a pose."""
    return Observation(stamp, references_used=table.used, problem=problem, sentence=sentence)
