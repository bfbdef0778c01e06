"""From one frame after another to the object's pose: finding, measuring, judging, fusing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import Pose, transform_points, wrap_angle
from tapping_cell.vision.camera import Array, CameraModel, Image, View
from tapping_cell.vision.frame_validation import FrameValidator
from tapping_cell.vision.markers.detection import (
    UNIT_CORNERS,
    ObjectMarker,
    ReferenceMap,
    marker_pattern,
)
from tapping_cell.vision.markers.edges import MarkerEdges, join, no_edges, take
from tapping_cell.vision.markers.measurement import measure
from tapping_cell.vision.markers.object_pose import PoseFit, fit_marker, marker_pose, object_pose
from tapping_cell.vision.markers.search import Detections, detect, efforts, near
from tapping_cell.vision.markers.shape_consistency import Form, Suspicion, judge_form
from tapping_cell.vision.markers.stationary_marker import RestingMarker
from tapping_cell.vision.observation import Observation, Problem
from tapping_cell.vision.outline.finder import OutlineFinder
from tapping_cell.vision.outline.fit import OutlineFit
from tapping_cell.vision.outline.shape import ObjectOutline
from tapping_cell.vision.rest_detection import Motion, RestSettings, Track
from tapping_cell.vision.scene_change import SceneChange
from tapping_cell.vision.table.fit import TableSettings
from tapping_cell.vision.table.problems import table_notice, table_refusal
from tapping_cell.vision.table.tracker import (
    CROSS,
    TableState,
    TableTracker,
    pose_changes,
)

_SLOW = 0.0001
_SLOW_TURN = 0.002
"""Motion between frames (m, rad) below which the photometric alignment is worth its time."""
_INSTANT = 1.5e-4
"""Standard deviation (s) of the moment that a frame blurred by motion stands for: measured 0.05 to
0.13 ms in the middle of a slide, up to 0.6 ms where it begins or ends within an exposure."""
_JUDGED_AGAIN = 0.003, 0.03
"""Motion (m) of an object at rest and of a moving one after which the lens error is asked again."""


_MISSED = 3
"""Consecutive misses before a reference marker is reported as occluded."""


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """``audit_period`` (s) between full searches while all is well; ``lost_period`` (s) between
    them while the object or the table is not seen; ``references_each`` reference markers measured
    in a frame; ``references_timeout`` (s) that the table may go unseen; ``size_tolerance``: share
    that the marker's apparent side may differ from the configured one; ``dark`` and ``bright`` grey
    levels; ``other_ids`` markers of other objects, of the object's dictionary, that may be there;
    ``settled_frames`` fused from which a frame without change is measured only every
    ``settled_period`` (s): in between the last pose holds for it, 0 measures every frame.
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
    table: TableSettings = field(default_factory=TableSettings)
    rest: RestSettings = field(default_factory=RestSettings)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """The markers measured in a frame; ``rows`` of the reference map, then perhaps the object's."""

    edges: MarkerEdges
    rows: NDArray[np.intp]
    object_row: int | None


class PoseTracker:
    """Follows one object on the table.

    ``camera`` is the calibrated camera, ``table`` the map of reference markers, ``seen`` what to
    look for: the object's marker, or its outline. Frames go to :meth:`update` in the order in
    which they were taken.
    """

    def __init__(
        self,
        camera: CameraModel,
        table: ReferenceMap,
        seen: ObjectMarker | ObjectOutline,
        settings: TrackerSettings | None = None,
    ) -> None:
        self.camera = camera
        self.height = seen.height
        self._seen = seen
        self.settings = settings or TrackerSettings()
        self.table = TableTracker(camera, table, self.settings.table)
        self._map = table
        self._patterns = [marker_pattern(table.dictionary, m.id) for m in table.markers]
        self._finder: OutlineFinder | None = None
        rest = self.settings.rest
        if isinstance(seen, ObjectOutline):
            self._finder = OutlineFinder(seen, table)
            # A plain outline is not as sharp as a marker: rest may take more frames to prove.
            rest = replace(rest, longest=max(rest.longest, 18))
        else:
            # Only there where the object has a marker.
            self.marker = seen
            self._pattern = marker_pattern(seen.dictionary, seen.id)
            self._resting = RestingMarker(seen)
            self._suspicion = Suspicion(seen)
        self._form: Form | None = None
        self._track = Track(rest)
        self._gate = FrameValidator(camera, self.settings.dark, self.settings.bright)
        self._group = 0
        self._last_search = -math.inf
        self._last_thorough = -math.inf
        self._trouble: tuple[Problem, str] | None = None
        self._search_next = True
        self._references_seen = -math.inf
        self._object: tuple[float, Array, Array] | None = None
        self._judged: tuple[int, Array, Array, Array] | None = None
        # Objects are followed through one frozen view, so that the improving average of the table's
        # pose does not look like motion; what is published is seen through the newest one.
        self._working: View | None = None
        self._reference_quads: Array | None = None
        self._warning: tuple[float, str] = (-math.inf, "")
        self._missed: dict[int, int] = {}
        self._doubled: list[int] = []
        self._change = SceneChange()
        self._last: Observation | None = None
        self._measured_at = -math.inf
        self._resting_since: float | None = None

    @property
    def view(self) -> View | None:
        """The camera over the table as now known, None before the reference markers were seen."""
        return None if self.table.pose is None else View(self.camera, self.table.pose)

    def reset(self) -> None:
        """Forget the table and the object, e.g. after a refused move of the camera."""
        self.__init__(self.camera, self._map, self._seen, self.settings)  # type: ignore[misc]

    def update(self, image: Image, stamp: float) -> Observation:
        """Judge one frame: mono8 image (height, width), time of its exposure in s.

        Never raises for what a camera may deliver: every trouble is a problem and a sentence.
        """
        refusal = self._gate.refuse(image, stamp)
        if refusal is not None:
            return self._nothing(stamp, *refusal)
        last, period = self._last, self.settings.settled_period
        if (
            last is not None
            and stamp - self._measured_at < period
            and not self._search_next
            and stamp - self._last_search < self.settings.audit_period
            and self._change.unchanged(image)
        ):
            return replace(last, stamp=stamp)
        observation = self._judge(image, stamp)
        self._watch_settled(image, observation)
        return observation

    def _watch_settled(self, image: Image, observation: Observation) -> None:
        """Keep what the next frame is compared with; nothing while the object is not long at rest,
        or while it is being found out whether a reference marker is covered."""
        self._measured_at = observation.stamp
        view, since = self.view, observation.at_rest_since
        doubtful = any(0 < looks < _MISSED for looks in self._missed.values())
        settled = observation.frames_fused >= self.settings.settled_frames
        self._last = observation if settled and not doubtful else None
        if since is None or observation.pose is None or view is None:
            self._resting_since = None
        elif since == self._resting_since:
            self._change.learn(image)
        else:
            self._resting_since = since
            quads = view.project(self.table.points)
            outline = view.project(self._outline(np.array(observation.pose)), self.height)
            self._change.watch(image, [outline, *quads])

    def _outline(self, pose: Array) -> Array:
        """Points (N, 2) around what is seen of the object at a pose (3,), in ``table``."""
        if isinstance(self._seen, ObjectOutline):
            return transform_points(pose, self._seen.points())
        return _square(marker_pose(pose, self._seen), self._seen.size)

    def _judge(self, image: Image, stamp: float) -> Observation:
        """Look at a good frame, measure and judge."""
        seen, object_quad, trouble = self._look(image, stamp)
        found = self._measure(image, seen, object_quad, stamp == self._last_search)
        self._count_missed(seen, found)
        marked = self._finder is None
        if marked and found.object_row is None and trouble is None and self.view is not None:
            found = self._search_object(image, stamp, found)
        state = self._update_table(image, found, stamp)
        unseen = stamp - self._references_seen
        refused = table_refusal(state, self.table, unseen, self.settings.references_timeout)
        if state is TableState.UNKNOWN and trouble and trouble[0] is Problem.MIRRORED_MARKER:
            refused = trouble
        if refused is not None:
            if state in (TableState.SUSPECT, TableState.TOO_FAR, TableState.CONTRADICTED):
                self._track.clear()
            return self._nothing(stamp, *refused)
        if trouble is not None:
            return self._nothing(stamp, *trouble)
        return self._observe(image, found, stamp)

    # -- where to look

    def _look(
        self, image: Image, stamp: float
    ) -> tuple[dict[int, Array], Array | None, tuple[Problem, str] | None]:
        """Quads of the reference markers to measure by row of the map, of the object, and
        trouble."""
        s = self.settings
        lost = self._object is None or self.view is None or self._search_next
        period = s.lost_period if lost else s.audit_period
        if stamp - self._last_search >= period:
            return self._search_all(image, stamp)
        if self._reference_quads is None:
            return {}, self._object_quad(stamp), None
        count = len(self._reference_quads)
        groups = max(1, math.ceil(count / s.references_each))
        self._group = (self._group + 1) % groups
        rows = range(self._group, count, groups)
        return {r: self._reference_quads[r] for r in rows}, self._object_quad(stamp), None

    def _object_quad(self, stamp: float) -> Array | None:
        """Where the object's marker should be in the image, from its last pose and velocity."""
        view, ahead = self._working, self._expected(stamp)
        if ahead is None or view is None or self._finder is not None:
            return None
        corners = _square(marker_pose(ahead, self.marker), self.marker.size)
        return view.project(corners, self.marker.height)

    def _expected(self, stamp: float) -> Array | None:
        """Where the object (3,) should be, from its last pose and velocity."""
        if self._object is None:
            return None
        then, pose, velocity = self._object
        return np.asarray(pose + velocity * min(stamp - then, 0.1))

    def _search_all(
        self, image: Image, stamp: float
    ) -> tuple[dict[int, Array], Array | None, tuple[Problem, str] | None]:
        first = self._last_search == -math.inf
        self._last_search = stamp
        self._search_next = False
        marked = self._finder is None
        same = not marked or self._map.dictionary == self.marker.dictionary
        rows = {int(i): row for row, i in enumerate(self.table.ids)}
        # The thorough search and its explanations take several frames' time: all of it for the
        # first frame, which may be the only one; later once in a while, and only if it is needed.
        lost = self._object is None or stamp - self._object[0] > 0.2
        slow = lost and stamp - self._last_thorough >= self.settings.audit_period
        table = objects = Detections({}, ())
        for effort in efforts(first, slow):
            if effort:
                self._last_thorough = stamp
            table = table.and_more(detect(image, self._map.dictionary, effort))
            if same:
                objects = table
            else:
                objects = objects.and_more(detect(image, self.marker.dictionary, effort))
            enough = len(rows.keys() & table.single) >= self.settings.table.least_references
            if enough and (not marked or self.marker.id in {*objects.single, *objects.repeated}):
                break
        quads = {rows[i]: quad for i, quad in table.single.items() if i in rows}
        self._doubled = [i for i in table.repeated if i in rows]
        if self._reference_quads is not None:
            # Whatever the table's pose was: the next frames look where the markers are now.
            for row, quad in quads.items():
                self._reference_quads[row] = quad
        if self._finder is not None:
            self._finder.search()
            return quads, None, None
        if self.marker.id in objects.repeated:
            self._object = None
            self._trouble = (
                Problem.DUPLICATE_MARKER,
                f"marker {self.marker.id} of the object is seen more than once; cover others",
            )
            return quads, None, self._trouble
        found = objects.single.get(self.marker.id)
        if found is not None:
            self._trouble = None
            return quads, found, None
        if slow:
            half = image if first else image[::2, ::2]
            self._trouble = self._explain(half, objects, set(rows) if same else set())
        return quads, None, self._trouble

    def _explain(
        self, image: Image, objects: Detections, expected: set[int]
    ) -> tuple[Problem, str] | None:
        """Why the object's marker may not be there."""
        mirrored = detect(np.ascontiguousarray(image[:, ::-1]), self.marker.dictionary)
        if self.marker.id in mirrored.single:
            return (
                Problem.MIRRORED_MARKER,
                f"marker {self.marker.id} is seen mirrored; turn off mirroring or print "
                "the marker again",
            )
        known = expected | self.settings.other_ids | {self.marker.id}
        others = sorted(set(objects.single) - known)
        if others:
            return (
                Problem.WRONG_MARKER,
                f"the object's marker {self.marker.id} is not seen but marker "
                f"{', '.join(map(str, others))} is; check the object file",
            )
        return None

    # -- measuring

    def _measure(
        self, image: Image, quads: dict[int, Array], object_quad: Array | None, searched: bool
    ) -> _Found:
        rows = list(quads)
        stack = [quads[r] for r in rows] + ([] if object_quad is None else [object_quad])
        if not stack:
            return _Found(no_edges(), np.array([], dtype=np.intp), None)
        patterns = [self._patterns[r] for r in rows]
        if object_quad is not None:
            patterns.append(self._pattern)
        edges, right = measure(image, np.stack(stack), patterns, searched)
        kept = np.flatnonzero(right[: len(rows)])
        chosen = np.array(rows, dtype=np.intp)[kept]
        if object_quad is None or not right[-1]:
            return _Found(take(edges, kept), chosen, None)
        return _Found(take(edges, np.append(kept, len(rows))), chosen, len(kept))

    def _count_missed(self, looked_for: dict[int, Array], found: _Found) -> None:
        """How often in a row each reference marker that was once seen is not."""
        met = set(found.rows.tolist())
        self._missed |= dict.fromkeys(met, 0)
        for row in looked_for.keys() - met:
            if row in self._missed:
                self._missed[row] += 1

    def _search_object(self, image: Image, stamp: float, found: _Found) -> _Found:
        """The object is not where it was expected: search around, then everywhere."""
        expected = self._object_quad(stamp)
        quad = None
        if expected is not None:
            quad = near(image, self.marker.dictionary, self.marker.id, expected)
        if quad is None:
            self._search_next = True
            return found
        fresh = self._measure(image, {}, quad, True)
        if fresh.object_row is None:
            self._search_next = True
            return found
        return _Found(join(found.edges, fresh.edges), found.rows, len(found.rows))

    # -- the table

    def _add_references(self, image: Image, known: NDArray[np.intp]) -> TableState:
        """Those that the first search did not find, now that it is known where they must be."""
        assert self.view is not None
        quads = self.view.project(self.table.points)
        missing = set(range(len(quads))) - set(known.tolist())
        more = self._measure(image, {row: quads[row] for row in missing}, None, True)
        return self.table.add(more.edges, more.rows) if len(more.rows) else TableState.STEADY

    def _update_table(self, image: Image, found: _Found, stamp: float) -> TableState:
        references = take(found.edges, np.arange(len(found.rows)))
        first = self.view is None
        state = self.table.update(references, found.rows)
        if first and state is TableState.STEADY:
            state = self._add_references(image, found.rows)
        if state in (TableState.STEADY, TableState.MOVED, TableState.TOO_FAR):
            self._references_seen = stamp
        if len(found.rows) < self.settings.table.least_references or state is TableState.SUSPECT:
            # The next frame looks everywhere: they may have gone further than a few pixels.
            self._search_next = True
        view = self.view
        if view is not None and state in (TableState.STEADY, TableState.MOVED):
            self._reference_quads = view.project(self.table.points)
        if state is TableState.CONTRADICTED:
            self._working = None
        elif self._working is None:
            self._working = view
        if state is TableState.MOVED:
            self._track.clear()
            self._working = view
            self._warning = (
                stamp,
                f"the camera or the table moved by {self.table.move * 1e3:.1f} mm; corrected",
            )
        return state

    # -- the object

    def _observe(self, image: Image, found: _Found, stamp: float) -> Observation:
        view = self._working
        if self._finder is not None and view is not None:
            return self._observe_outline(self._finder, image, view, stamp)
        fit = None
        if found.object_row is not None and view is not None:
            fit = fit_marker(view, found.edges, found.object_row, self.marker)
        if fit is None or view is None:
            self._stand_still(stamp)
            hidden = (
                Problem.OBJECT_HIDDEN,
                f"the object's marker {self.marker.id} is not seen, or not the whole of it, or "
                "from too far aside (tilted?)",
            )
            # What the last search found in its place holds until the next.
            return self._nothing(stamp, *(self._trouble or hidden))
        row = found.object_row
        assert row is not None
        form = judge_form(view, found.edges, row, self.marker, fit, self.table.bloom)
        limit = self.settings.size_tolerance
        if max(abs(form.stretch), form.strain) > limit:
            where, _ = object_pose(fit.pose, fit.covariance, self.marker)
            self._object = (stamp, where, np.zeros(3))
            self._track.clear()
            return self._nothing(
                stamp, Problem.MISSHAPEN_MARKER, self._suspicion.refusal(form, limit)
            )
        self._form, self._trouble = form, None
        return self._follow(stamp, *self._measured(image, view, fit))

    def _observe_outline(
        self, finder: OutlineFinder, image: Image, view: View, stamp: float
    ) -> Observation:
        """The same for an object without a marker."""
        step: Array = np.zeros(2)
        if self._object is not None:
            step = self._object[2][:2] * min(stamp - self._object[0], 0.1)
        answer = finder.look(image, view, self._expected(stamp), step)
        if isinstance(answer, OutlineFit):
            pose = answer.pose.copy()
            pose[2] = wrap_angle(pose[2])
            return self._follow(stamp, pose, answer.covariance)
        self._stand_still(stamp)
        self._search_next = True
        if answer[0] is Problem.DUPLICATE_OBJECT:
            self._object = None
        return self._nothing(stamp, *answer)

    def _stand_still(self, stamp: float) -> None:
        """An object not seen for a while is looked for where it was, not where it was going."""
        if self._object is not None and stamp - self._object[0] > 0.1:
            self._object = (self._object[0], self._object[1], np.zeros(3))

    def _follow(self, stamp: float, pose: Array, covariance: Array) -> Observation:
        """A pose measured in this frame, as the track takes it."""
        if self._references_seen < stamp and not self._track.stays(pose, covariance):
            return self._nothing(
                stamp,
                Problem.REFERENCES_HIDDEN,
                "no reference markers are seen in this frame and the object seems to have moved: "
                "it may be the camera that did",
            )
        motion = self._track.add(stamp, pose, covariance)
        self._object = (stamp, pose, self._track.heading(stamp, pose, motion))
        return self._good(motion, stamp)

    def _measured(self, image: Image, view: View, fit: PoseFit) -> tuple[Array, Array]:
        """Pose and covariance of the object: by edges, and by all pixels when it hardly moves."""
        pose, covariance = object_pose(fit.pose, fit.covariance, self.marker)
        if self._object is not None:
            step = pose - self._object[1]
            if math.hypot(step[0], step[1]) > _SLOW or abs(wrap_angle(step[2])) > _SLOW_TURN:
                return pose, covariance
        return self._resting.measure(image, view, fit)

    def _good(self, motion: Motion, stamp: float) -> Observation:
        pose = self._through_newest(motion.pose)
        error, shared = self._calibration(pose, _JUDGED_AGAIN[int(motion.rest_since is None)])
        pose = pose - error
        # Of what a frame shows wrong, a share stays however many frames are fused.
        fixed = self._resting.fixed if self._finder is None else 0.0
        spread = motion.covariance * (1.0 + fixed * (motion.frames - 1))
        instant = _INSTANT * motion.velocity
        since, sentence = self._warning
        if stamp - since > 2.0:
            missed = [row for row, looks in self._missed.items() if looks >= _MISSED]
            sentence = table_notice(self.table, self._doubled, missed)
        elif self.table.displaced:
            sentence = table_notice(self.table, [], [])
        if self._form is not None:
            shared = shared + self._form.covariance
            height = self.table.camera_height
            sentence = self._suspicion.sentence(self._form, height) or sentence
        return Observation(
            stamp=stamp,
            visible=True,
            pose=Pose(*pose.tolist()),
            covariance=spread + shared + np.outer(instant, instant),
            at_rest=motion.rest_since is not None,
            at_rest_since=motion.rest_since,
            frames_fused=motion.frames,
            velocity=motion.velocity,
            references_used=self.table.used,
            sentence=sentence,
        )

    def _through_newest(self, pose: Array) -> Array:
        """A pose measured through the working view, as the newest view of the table has it."""
        view, working = self.view, self._working
        assert view is not None and working is not None
        points = transform_points(pose, CROSS)
        seen = working.pose.apply(np.column_stack([points, np.full(4, self.height)]))
        newest = view.rays_on_plane(seen[:, :2] / seen[:, 2:], self.height)
        moved = pose + pose_changes(points, newest - points)
        moved[2] = wrap_angle(moved[2])
        return moved

    def _calibration(self, pose: Array, again: float) -> tuple[Array, Array]:
        """What all frames share: likely error (3,) and covariance (3, 3) of table, lens and
        printing."""
        key = self.table.field_number
        known = self._judged
        if known is None or known[0] != key or np.abs(known[1] - pose)[:2].max() > again:
            error, shared = self.table.judge(pose, self.height)
            if self._finder is not None:
                shared = shared + self._finder.shared()
            known = (key, pose, error, shared)
            self._judged = known
        return known[2], known[3]

    def _nothing(self, stamp: float, problem: Problem, sentence: str) -> Observation:
        return Observation(
            stamp, references_used=self.table.used, problem=problem, sentence=sentence
        )


def _square(pose: Array, size: float) -> Array:
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array([[cos, sin], [-sin, cos]])
    return np.asarray(UNIT_CORNERS * size @ turn + pose[:2])
