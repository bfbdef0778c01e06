"""Record of the poses of the last seconds, from which the track of a slide is taken."""

from __future__ import annotations

from collections import deque

import numpy as np

from tapping_cell.logic.clock import to_seconds
from tapping_cell.logic.poses import covariance_from_message, from_message
from tapping_cell.messages import ObjectState
from tapping_cell.planning.session import noise_of
from tapping_cell.planning.track import Track

KEPT = 480
"""Number of observations that are kept: 4 s at 120 Hz."""

LONGEST_S = 3.0
"""Longest slide, s."""


INSTANT_S = 1.5e-4
"""Standard deviation of the time to which an image of a moving object corresponds, s."""


class SlideRecord:
    """Keeps the last observations of one object and returns the poses of its last slide."""

    def __init__(self) -> None:
        self._seen: deque[ObjectState] = deque(maxlen=KEPT)

    def add(self, state: ObjectState) -> None:
        """Add an observation that shows the object. Of consecutive ones at rest, the last is kept,
        so that a long rest does not displace the slide."""
        last = self._seen[-1] if self._seen else None
        if last is not None and last.header.stamp == state.header.stamp:
            return
        if last is not None and last.at_rest and state.at_rest:
            self._seen.pop()
        self._seen.append(state)

    def begin(self) -> None:
        """Forget earlier slides: the next one is that of a tap planned for the last observation. A
        tap that misses the object then has no slide."""
        while len(self._seen) > 1:
            self._seen.popleft()

    def last_slide(self, rest: ObjectState) -> Track | None:
        """Return the poses of the slide before ``rest``, an observation of the object at rest:
        those of the images of the moving object, with their own stamps, and one of the rest before
        it. Return None if no image shows the object while it moves."""
        ended = to_seconds(rest.at_rest_since)
        slide: list[ObjectState] = []
        for state in reversed(self._seen):
            stamp = to_seconds(state.header.stamp)
            if stamp >= ended:
                continue
            slide.append(state)
            if state.at_rest or stamp < ended - LONGEST_S:
                break
        moving = [state for state in slide if not state.at_rest]
        if not moving:
            return None
        taken = slide[::-1]
        noise = [noise_of(covariance_from_message(state.pose.covariance)) for state in taken]
        track = Track(
            np.array([to_seconds(state.header.stamp) - ended for state in taken]),
            np.array([from_message(state.pose.pose) for state in taken]),
            np.array([(one.position, one.angle) for one in noise]),
        )
        if len(taken) > 1:
            # The stated covariance of the first images of a motion lacks the error of their time.
            poses = np.column_stack([track.poses[:, :2], np.unwrap(track.poses[:, 2])])
            speed = np.abs(np.gradient(poses, track.time, axis=0))
            speed[[state.at_rest for state in taken]] = 0.0
            pace = np.stack([np.hypot(speed[:, 0], speed[:, 1]), speed[:, 2]], axis=-1)
            track = track._replace(deviations=np.hypot(track.deviations, INSTANT_S * pace))
        known = np.all(np.isfinite(track.poses), axis=1) & np.all(track.deviations > 0.0, axis=1)
        return Track(*(part[known] for part in track))
