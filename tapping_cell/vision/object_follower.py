"""One object from frame to frame: what is the same whether a marker or its outline is seen.

A follower is asked once a frame, when the camera's pose over the table is known. Where the object
should be follows from its last pose and velocity; what it measures there goes through the track,
which tells rest from motion and fuses the frames at rest.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import Pose, transform_points, wrap_angle
from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.markers.edges import MarkerEdges
from tapping_cell.vision.markers.search import Detections
from tapping_cell.vision.observation import Observation, Problem
from tapping_cell.vision.rest_detection import Motion, RestSettings, Track
from tapping_cell.vision.table.tracker import CROSS, TableTracker, pose_changes

Trouble = tuple[Problem, str]
"""Why there is no pose, and the sentence that says so."""

Aim = tuple[Array, NDArray[np.bool_]]
"""A marker to be measured: its corners (4, 2) in the image, about, and its pattern."""

_INSTANT = 1.5e-4
"""Standard deviation (s) of the moment that a frame blurred by motion stands for: measured 0.05 to
0.13 ms in the middle of a slide, up to 0.6 ms where it begins or ends within an exposure."""
_JUDGED_AGAIN = 0.003, 0.03
"""Motion (m) of an object at rest and of a moving one after which the lens error is asked again."""
_UNSEEN = 0.1
"""Time (s) for which an object that is not seen is believed to go on moving."""
_LOST = 0.2
"""Time (s) of looks in vain after which the object is searched for thoroughly; a machine that takes
so long for a picture has not lost it."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A good frame, and the table as it is known with it."""

    image: Image
    stamp: float
    working: View
    """Frozen while nothing moves: the improving average of the table's pose is no motion of the
    object's."""
    newest: View
    """What is published is seen through this."""
    table: TableTracker
    references_seen: bool
    """Whether reference markers were seen in this very frame."""
    aimed: MarkerEdges | None
    """Edges of the marker that the follower aimed at; None where it is not there."""
    notice: str
    """What should be known of the table though it does not spoil the pose; empty for nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """What was found in a whole image: markers by dictionary."""

    stamp: float
    detections: Mapping[str, Detections]
    first: bool
    """Whether it is the first frame of all, which may be the only one."""
    slow: bool
    """Whether there is time to find out why the object is not there."""
    expected_ids: Mapping[str, frozenset[int]]
    """Ids of the reference markers, by dictionary."""


class ObjectFollower(ABC):
    """Follows one object whose seen face is at ``height`` (m) over the table.

    ``wants_search``: whether the next frame should be searched as a whole.
    """

    dictionary: str | None = None
    """Dictionary of the object's marker; None without one."""
    fixed: float = 0.0
    """Share of the variance of a frame's pose that further frames do not average out."""

    def __init__(self, height: float, rest: RestSettings) -> None:
        self.height = height
        self.wants_search = True
        self.trouble: Trouble | None = None
        self.track = Track(rest)
        self._last: tuple[float, Array, Array] | None = None
        self._vain_since: float | None = None
        self._judged: tuple[int, Array, Array, Array] | None = None

    # -- what differs

    @abstractmethod
    def outline(self, pose: Array) -> Array:
        """Points (N, 2) around what is seen of the object at a pose (3,), in ``table``."""

    @abstractmethod
    def detected(self, stamp: float) -> bool:
        """Whether the search of the frame of this time found the object."""

    @abstractmethod
    def aim(self, stamp: float, view: View | None) -> Aim | None:
        """Which marker to measure in the frame that comes next, together with those of the table:
        how the noise of neighbouring pixels hangs together is told the better from more of them."""

    @abstractmethod
    def complete(self, detections: Mapping[str, Detections]) -> bool:
        """Whether a search has found what this follower needs of it."""

    @abstractmethod
    def searched(self, image: Image, search: Search) -> None:
        """Take what was found in the whole image of the frame that comes next."""

    @abstractmethod
    def look(self, frame: Frame) -> tuple[Array, Array] | Trouble:
        """Pose (3,) and covariance (3, 3) through the working view, or why there is none."""

    @abstractmethod
    def doubt(self, frame: Frame) -> tuple[Array, str]:
        """What the last look found that all frames share: covariance (3, 3), and what to say."""

    # -- what is the same

    @property
    def found(self) -> bool:
        """Whether it is known where the object is, or was."""
        return self._last is not None

    def lost(self, stamp: float) -> bool:
        """Whether the object was looked for in vain for a while."""
        vain = self._vain_since is not None and stamp - self._vain_since > _LOST
        return self._last is None or vain

    def expected(self, stamp: float) -> Array | None:
        """Where the object (3,) should be, from its last pose and velocity."""
        if self._last is None:
            return None
        then, pose, velocity = self._last
        return np.asarray(pose + velocity * min(stamp - then, _UNSEEN))

    def step(self, stamp: float) -> Array:
        """How far (2,) the object moves from its last pose to this time, in m."""
        if self._last is None:
            return np.zeros(2)
        return np.asarray(self._last[2][:2] * min(stamp - self._last[0], _UNSEEN))

    def observe(self, frame: Frame) -> Observation:
        """Measure and judge the object in this frame."""
        answer = self.look(frame)
        if isinstance(answer[0], Problem):
            if self._vain_since is None:
                self._vain_since = frame.stamp
            return nothing(frame.stamp, frame.table, answer[0], str(answer[1]))
        pose, covariance = answer[0], np.asarray(answer[1])
        if not frame.references_seen and not self.track.stays(pose, covariance):
            return nothing(
                frame.stamp,
                frame.table,
                Problem.REFERENCES_HIDDEN,
                "no reference markers are seen in this frame and the object seems to have moved: "
                "it may be the camera that did",
            )
        self._vain_since = None
        motion = self.track.add(frame.stamp, pose, covariance)
        self._last = (frame.stamp, pose, self.track.heading(frame.stamp, pose, motion))
        return self._good(frame, motion)

    def forget(self) -> None:
        """It is no longer known where the object is."""
        self._last = None

    def stop(self, stamp: float, pose: Array | None = None) -> None:
        """Look for it where it is, or where it was last seen, and not where it was going."""
        if pose is not None:
            self._last = (stamp, pose, np.zeros(3))
        elif self._last is not None and stamp - self._last[0] > _UNSEEN:
            self._last = (self._last[0], self._last[1], np.zeros(3))

    def step_from_last(self, pose: Array) -> tuple[float, float] | None:
        """Way (m) and turn (rad) from the last pose to this one; None where there is none."""
        if self._last is None:
            return None
        step = pose - self._last[1]
        return math.hypot(step[0], step[1]), abs(float(wrap_angle(step[2])))

    def _good(self, frame: Frame, motion: Motion) -> Observation:
        pose = self._through_newest(frame, motion.pose)
        again = _JUDGED_AGAIN[int(motion.rest_since is None)]
        error, shared = self._calibration(frame.table, pose, again)
        pose = pose - error
        doubt, sentence = self.doubt(frame)
        # Of what a frame shows wrong, a share stays however many frames are fused.
        spread = motion.covariance * (1.0 + self.fixed * (motion.frames - 1))
        instant = _INSTANT * motion.velocity
        return Observation(
            stamp=frame.stamp,
            visible=True,
            pose=Pose(*pose.tolist()),
            covariance=spread + shared + doubt + np.outer(instant, instant),
            at_rest=motion.rest_since is not None,
            at_rest_since=motion.rest_since,
            frames_fused=motion.frames,
            velocity=motion.velocity,
            references_used=frame.table.used,
            sentence=sentence or frame.notice,
        )

    def _through_newest(self, frame: Frame, pose: Array) -> Array:
        """A pose measured through the working view, as the newest view of the table has it."""
        points = transform_points(pose, CROSS)
        seen = frame.working.pose.apply(np.column_stack([points, np.full(4, self.height)]))
        newest = frame.newest.rays_on_plane(seen[:, :2] / seen[:, 2:], self.height)
        moved = pose + pose_changes(points, newest - points)
        moved[2] = wrap_angle(moved[2])
        return moved

    def _calibration(self, table: TableTracker, pose: Array, again: float) -> tuple[Array, Array]:
        """What all frames share of table and lens: likely error (3,) and covariance (3, 3)."""
        key = table.field_number
        known = self._judged
        if known is None or known[0] != key or np.abs(known[1] - pose)[:2].max() > again:
            known = (key, pose, *table.judge(pose, self.height))
            self._judged = known
        return known[2], known[3]


def nothing(stamp: float, table: TableTracker, problem: Problem, sentence: str) -> Observation:
    """A frame without a pose."""
    return Observation(stamp, references_used=table.used, problem=problem, sentence=sentence)
