"""Pose tracker: validates camera frames, locates the table, and measures the object's pose."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np

from tapping_cell.vision.camera import Array, CameraModel, Image, View
from tapping_cell.vision.frame_validation import FrameValidator
from tapping_cell.vision.markers.detection import ObjectMarker, ReferenceMap
from tapping_cell.vision.markers.edges import MarkerEdges
from tapping_cell.vision.markers.marker_follower import MarkerFollower
from tapping_cell.vision.markers.search import Detections, detect, efforts
from tapping_cell.vision.object_follower import Frame, ObjectFollower, Search, nothing
from tapping_cell.vision.observation import Observation, Problem
from tapping_cell.vision.outline.outline_follower import OutlineFollower
from tapping_cell.vision.outline.shape import ObjectOutline
from tapping_cell.vision.rest_detection import RestSettings
from tapping_cell.vision.scene_change import SceneChange
from tapping_cell.vision.table.fit import TableSettings
from tapping_cell.vision.table.problems import table_notice, table_refusal
from tapping_cell.vision.table.reference_markers import ReferenceMarkers, Rows
from tapping_cell.vision.table.tracker import TableState, TableTracker

_WARNED = 2.0
"""Time (s) for which the warning that the camera or the table moved is published."""


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """Settings of the pose tracker.

    ``audit_period`` is the time (s) between full-image searches in normal operation,
    ``lost_period`` the time between them while the object or the table is not seen.
    ``references_each`` reference markers are measured in each frame; the table may be unseen for
    ``references_timeout`` (s). ``size_tolerance`` is the relative deviation allowed between the
    marker's apparent and configured side. ``dark`` and ``bright`` are grey levels. ``other_ids``
    are the markers of other objects that use the object's dictionary. Once ``settled_frames`` are
    fused, an unchanged frame is measured only every ``settled_period`` (s) and otherwise gets the
    last pose. If the period is 0, every frame is measured. Any other object that was found is
    measured at least every ``others_period`` (s), and in every frame until ``settled_frames`` are
    fused. ``others_period`` plus the time between frames must be less than ``rest.gap``.
    """

    audit_period: float = 1.0
    lost_period: float = 0.1
    references_each: int = 4
    references_timeout: float = 2.0
    size_tolerance: float = 0.03
    dark: float = 12.0
    bright: float = 250.0
    other_ids: frozenset[int] = frozenset()
    settled_frames: int = 30
    settled_period: float = 0.2
    others_period: float = 0.4
    table: TableSettings = field(default_factory=TableSettings)
    rest: RestSettings = field(default_factory=RestSettings)


class PoseTracker:
    """Tracks one object on the table, and measures other objects on request.

    ``camera`` is the calibrated camera and ``table`` the map of reference markers. ``seen`` is the
    object's marker or its outline, and ``others`` are the markers or outlines of the other objects.
    ``hidden`` returns the ids of the reference markers that are known to be hidden now, about which
    no warning is needed. Other missing or displaced reference markers are reported after
    ``patience`` (s), because an arm that moves hides a marker before its position is known. Pass
    frames to :meth:`update` in the order in which they were captured.
    """

    def __init__(
        self,
        camera: CameraModel,
        table: ReferenceMap,
        seen: ObjectMarker | ObjectOutline,
        settings: TrackerSettings | None = None,
        others: Sequence[ObjectMarker | ObjectOutline] = (),
        hidden: Callable[[], Collection[int]] = tuple,
        patience: float = 0.0,
    ) -> None:
        s = settings or TrackerSettings()
        self._hidden = hidden
        self._patience = patience
        self._amiss_since: dict[int, float] = {}
        self.camera = camera
        self.settings = s
        self.table = TableTracker(camera, table, s.table)
        self._object = _follower(seen, table, s)
        self._others = [_follower(one, table, s) for one in others]
        self._references = ReferenceMarkers(table, s.references_each)
        self._validator = FrameValidator(camera, s.dark, s.bright)
        self._last_search = -math.inf
        self._last_thorough = -math.inf
        self._search_next = True
        self._references_seen = -math.inf
        self._working: View | None = None
        self._warning: tuple[float, str] = (-math.inf, "")
        self._change = SceneChange()
        self._last: Observation | None = None
        self._measured_at = -math.inf
        self._resting_since: tuple[float | None, ...] = ()
        self._seen: dict[int, Observation] = {}
        self._others_measured_at: dict[int, float] = {}

    @property
    def view(self) -> View | None:
        """The camera with its current pose over the table; None before reference markers were
        measured for the first time."""
        return None if self.table.pose is None else View(self.camera, self.table.pose)

    def update(self, image: Image, stamp: float) -> Observation:
        """Process one frame: a mono8 image (height, width) and the time of its exposure in s.

        Never raises for any image that a camera may deliver: every failure is returned as a problem
        with an explanation.
        """
        return self.update_several(image, stamp, ())[0]

    def update_several(
        self,
        image: Image,
        stamp: float,
        others: Collection[int],
        *,
        every_frame: bool = False,
    ) -> tuple[Observation, dict[int, Observation]]:
        """Process one frame as :meth:`update` does, and measure some of the other objects in it.

        ``others`` are the indices of these objects, from 0. The result also includes any object
        that was lost and is found again in this frame, and the objects that must be measured now
        according to ``others_period``. ``every_frame``: measure the frame even if it is unchanged,
        because a longer observation was requested.
        """
        refusal = self._validator.refuse(image, stamp)
        if refusal is not None:
            empty = nothing(stamp, self.table, *refusal)
            return empty, dict.fromkeys(others, empty)
        others = {*others, *self._moving_others()}
        last = None if every_frame else self._last
        if last is not None and self._settled(stamp, others) and self._change.unchanged(image):
            known = {number: replace(self._seen[number], stamp=stamp) for number in others}
            return replace(last, stamp=stamp), known
        observation, found = self._judge(image, stamp, others)
        self._seen.update(found)
        self._others_measured_at.update(dict.fromkeys(found, stamp))
        self._watch_settled(image, observation)
        return observation, found

    def _moving_others(self) -> list[int]:
        """Return the other objects that are visible but have not been at rest for
        ``settled_frames`` frames."""
        enough = self.settings.settled_frames
        return [n for n, seen in self._seen.items() if seen.visible and seen.frames_fused < enough]

    def _overdue(self, number: int, stamp: float) -> bool:
        """Return whether another object was found and has not been measured for at least
        ``others_period``."""
        age = stamp - self._others_measured_at.get(number, -math.inf)
        return self._others[number].found and age >= self.settings.others_period

    def _settled(self, stamp: float, others: Collection[int]) -> bool:
        """Return whether an unchanged frame need not be measured for the object and ``others``."""
        enough = self.settings.settled_frames
        return (
            stamp - self._measured_at < self.settings.settled_period
            and not self._search_due(stamp, others)
            and not self._wants_search
            and all(
                number in self._seen
                and (not self._others[number].found or self._seen[number].frames_fused >= enough)
                for number in others
            )
        )

    def _watch_settled(self, image: Image, observation: Observation) -> None:
        """Keep this frame for comparison with the next frame.

        The frame is not kept if the object has not been at rest long enough, or if a reference
        marker may be occluded.
        """
        self._measured_at = observation.stamp
        view = self.view
        settled = observation.frames_fused >= self.settings.settled_frames
        self._last = observation if settled and not self._references.suspect else None
        tracked = [(self._object, observation)]
        tracked += [(self._others[n], seen) for n, seen in self._seen.items() if seen.visible]
        since = tuple(seen.at_rest_since for _, seen in tracked)
        if view is None or observation.pose is None or None in since:
            self._resting_since = ()
        elif since == self._resting_since:
            self._change.learn(image)
        else:
            self._resting_since = since
            regions = [*view.project(self.table.points)]
            for follower, seen in tracked:
                assert seen.pose is not None, "an object that is observed at rest must have a pose"
                outline = follower.outline(np.array(seen.pose))
                regions.append(view.project(outline, follower.height))
            self._change.watch(image, regions)

    def _judge(
        self, image: Image, stamp: float, others: Collection[int]
    ) -> tuple[Observation, dict[int, Observation]]:
        """Locate the table in a valid frame, then measure the objects."""
        searched = self._search_due(stamp, others)
        quads = self._search(image, stamp, others) if searched else self._references.next_group()
        numbers = [
            number
            for number, follower in enumerate(self._others)
            if number in others
            or self._overdue(number, stamp)
            or (not follower.found and follower.detected(stamp))
        ]
        followers = [self._object, *(self._others[number] for number in numbers)]
        aims = [follower.aim(stamp, self._working) for follower in followers]
        edges, rows, aimed = self._references.measure(image, quads, searched, aims)
        self._references.count_missed(quads, rows)
        state = self._update_table(image, edges, rows, stamp)
        unseen = stamp - self._references_seen
        refused = table_refusal(state, self.table, unseen, self.settings.references_timeout)
        failure = self._object.failure
        if state is TableState.UNKNOWN and failure and failure[0] is Problem.MIRRORED_MARKER:
            refused = failure
        if refused is not None:
            if state in (TableState.SUSPECT, TableState.TOO_FAR, TableState.CONTRADICTED):
                self._clear_tracks()
            empty = nothing(stamp, self.table, *refused)
            return empty, dict.fromkeys(numbers, empty)
        view, working = self.view, self._working
        assert view is not None and working is not None, (
            "a table in an accepted state must have a camera pose"
        )
        seen = self._references_seen == stamp
        notice = self._notice(stamp)
        observations = [
            follower.observe(Frame(image, stamp, working, view, self.table, seen, marker, notice))
            for follower, marker in zip(followers, aimed, strict=True)
        ]
        return observations[0], dict(zip(numbers, observations[1:], strict=True))

    def _clear_tracks(self) -> None:
        self._seen.clear()
        for follower in (self._object, *self._others):
            follower.track.clear()

    # -- search of the whole image

    @property
    def _wants_search(self) -> bool:
        return self._search_next or self._object.wants_search

    def _search_due(self, stamp: float, others: Collection[int]) -> bool:
        lost = not self._object.found or self.view is None or self._wants_search
        # Search soon for an object that disappeared. For an object that was never found, the next
        # regular search is sufficient.
        lost |= any(self._others[n].found and self._others[n].wants_search for n in others)
        period = self.settings.lost_period if lost else self.settings.audit_period
        return stamp - self._last_search >= period

    def _search(self, image: Image, stamp: float, others: Collection[int]) -> dict[int, Array]:
        """Search for all markers; return the corners of the reference markers, by row of the
        map."""
        first = self._last_search == -math.inf
        self._last_search = stamp
        self._search_next = False
        # The thorough search and its diagnosis take the time of several frames. Both are applied to
        # the first frame if needed, because this frame may be the only one. They are applied to
        # later frames only occasionally.
        since = stamp - self._last_thorough
        slow = self._object.lost(stamp) and since >= self.settings.audit_period
        of_table = self._references.dictionary
        followers = (self._object, *self._others)
        wanted = (self._object, *(self._others[number] for number in others))
        found = {of_table: Detections({}, ())}
        found |= {f.dictionary: Detections({}, ()) for f in followers if f.dictionary is not None}
        least = self.settings.table.least_references
        for effort in efforts(first, slow):
            if effort:
                self._last_thorough = stamp
            found = {d: f.and_more(detect(image, d, effort)) for d, f in found.items()}
            enough = len(self._references.ids & found[of_table].single.keys()) >= least
            if enough and all(follower.complete(found) for follower in wanted):
                break
        expected = {of_table: self._references.ids}
        whole = image if first else image[::2, ::2]
        mirrored = cache(partial(detect, np.ascontiguousarray(whole[:, ::-1])))
        for follower in followers:
            asked = slow and follower in wanted
            follower.searched(Search(stamp, found, asked, expected, mirrored))
        return self._references.found(found[of_table])

    # -- the table

    def _update_table(
        self, image: Image, edges: MarkerEdges, rows: Rows, stamp: float
    ) -> TableState:
        first = self.view is None
        state = self.table.update(edges, rows)
        if first and state is TableState.STEADY:
            state = self._add_references(image, rows)
        if state in (TableState.STEADY, TableState.MOVED, TableState.TOO_FAR):
            self._references_seen = stamp
        if len(rows) < self.settings.table.least_references or state is TableState.SUSPECT:
            # Search the whole next frame, because the markers may have moved by more than a few
            # pixels.
            self._search_next = True
        view = self.view
        if view is not None and state in (TableState.STEADY, TableState.MOVED):
            self._references.place(view.project(self.table.points))
        if state is TableState.CONTRADICTED:
            self._working = None
        elif self._working is None:
            self._working = view
        if state is TableState.MOVED:
            self._clear_tracks()
            self._working = view
            self._warning = (
                stamp,
                f"the camera or the table moved by {self.table.move * 1e3:.1f} mm; the camera "
                "pose was updated",
            )
        return state

    def _add_references(self, image: Image, known: Rows) -> TableState:
        """Measure reference markers that the first search missed, at their predicted positions."""
        assert self.view is not None
        quads = self.view.project(self.table.points)
        missing = set(range(len(quads))) - set(known.tolist())
        edges, rows, _ = self._references.measure(image, {r: quads[r] for r in missing}, True)
        return self.table.add(edges, rows) if len(rows) else TableState.STEADY

    def _notice(self, stamp: float) -> str:
        """Warning about the table for this frame; empty if there is none."""
        since, sentence = self._warning
        warned = stamp - since <= _WARNED
        missed = [] if warned else [int(self.table.ids[row]) for row in self._references.missed]
        if missed:
            expected = set(self._hidden())
            missed = [marker for marker in missed if marker not in expected]
        amiss = {*self.table.displaced, *missed}
        self._amiss_since = {each: self._amiss_since.get(each, stamp) for each in amiss}
        lasting = {e for e, at in self._amiss_since.items() if stamp - at >= self._patience}
        displaced = [marker for marker in self.table.displaced if marker in lasting]
        if warned and not displaced:
            return sentence
        repeated = [] if warned else self._references.repeated
        return table_notice(displaced, repeated, [each for each in missed if each in lasting])


def _follower(
    seen: ObjectMarker | ObjectOutline, table: ReferenceMap, settings: TrackerSettings
) -> ObjectFollower:
    if isinstance(seen, ObjectOutline):
        return OutlineFollower(seen, table, settings.rest)
    return MarkerFollower(seen, settings.rest, settings.size_tolerance, settings.other_ids)
