"""Replay of a run from its recorded poses, for the report's player and for videos.

The poses are those that the camera measured. Without a bag, they are made from the table of taps.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tapping_cell.report.palette import GOAL, INK, MUTED, PREDICTED, REST, SERIES
from tapping_cell.report.run import TIP, Poses, Run, TapRow
from tapping_cell.report.svg import Plan, stroke
from tapping_cell.se2 import Array, Pose, transform_points

SLIDE_S = 0.3
"""Duration of a slide whose poses were not recorded, s."""
LEAD_S = 0.6
"""Time that is shown before a tap and after it, s."""
NEGLIGIBLE = (2e-5, 3e-4)
"""Deviation (m, rad) up to which a recorded pose is left out, because its neighbours imply it."""
ARROW_MM = 42.0


@dataclass(frozen=True, slots=True)
class Track:
    """Poses over time: ``rows`` (N, 4) of time in s since run start, x, y in m, and the angle in
    rad without jumps."""

    rows: Array

    @classmethod
    def of(cls, poses: Poses) -> Track:
        """Return the track of poses, without those that their neighbours imply. The poses may be in
        another order than their times: a bag is in order of reception."""
        rows = np.array([(at, *pose) for at, pose in poses if math.isfinite(pose.x)])
        rows = rows.reshape(-1, 4)
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        rows = rows[np.diff(rows[:, 0], prepend=-np.inf) > 0]
        rows[:, 3] = np.unwrap(rows[:, 3])
        if len(rows) > 2:
            before, after = rows[:-2], rows[2:]
            share = ((rows[1:-1, 0] - before[:, 0]) / (after[:, 0] - before[:, 0]))[:, None]
            off = np.abs(before + share * (after - before) - rows[1:-1])
            needed = (np.hypot(off[:, 1], off[:, 2]) > NEGLIGIBLE[0]) | (off[:, 3] > NEGLIGIBLE[1])
            moves = np.concatenate([[True], needed, [True]])
            # The neighbours of a moving pose stay, so that rest does not become a slow motion.
            moves[:-1] |= moves[1:].copy()
            moves[1:] |= moves[:-1].copy()
            rows = rows[moves]
        return cls(rows)

    def at(self, time: float) -> Pose:
        """Return the pose at a time, between the recorded ones."""
        x, y, angle = (float(np.interp(time, self.rows[:, 0], self.rows[:, n])) for n in (1, 2, 3))
        return Pose(x, y, angle)

    def between(self, start: float, end: float) -> Array:
        """Return the positions (N, 2) from ``start`` to ``end``, in m."""
        times = self.rows[:, 0]
        inner = self.rows[(times > start) & (times < end), 1:3]
        return np.vstack([[*self.at(start)][:2], inner, [*self.at(end)][:2]])


def tracks_of(run: Run, recorded: Mapping[str, Poses]) -> dict[str, Track]:
    """Return the tracks of the objects and, if it was recorded, of the striker's tip."""
    tracks = {}
    for one in run.objects:
        poses = list(recorded.get(one.name, ()))
        if not poses and one.start is not None:
            poses = [(0.0, one.start)]
            for tap in run.taps:
                if tap.seen and tap.object_name in ("", one.name):
                    fired = _fired(tap)
                    poses += [(fired, tap.before), (fired + SLIDE_S, tap.measured)]
        if poses:
            tracks[one.name] = Track.of(poses)
    if recorded.get(TIP):
        tracks[TIP] = Track.of(recorded[TIP])
    return tracks


def _fired(tap: TapRow) -> float:
    return tap.fired_at if math.isfinite(tap.fired_at) else 2.0 * tap.number


def slides(run: Run) -> list[tuple[TapRow, float, float]]:
    """Return each tap with the times of the release and of the rest after it, s."""
    return [
        (tap, (at := _fired(tap)), tap.at_rest_at if tap.at_rest_at > at else at + 2 * SLIDE_S)
        for tap in run.taps
    ]


def duration(run: Run) -> float:
    """Return the length of the replay, s."""
    return max([run.wall_time, *(rest + LEAD_S for _, _, rest in slides(run))])


def player(run: Run, recorded: Mapping[str, Poses], plan: Plan) -> tuple[str, str] | None:
    """Draw the replay into a plan of the table, at its end. Return the drawing and the content
    (JSON) for ``replay.js``; None if there is no tap to show."""
    tracks = tracks_of(run, recorded)
    if not run.taps or not any(one.name in tracks for one in run.objects):
        return None
    several, origin = len(run.objects) > 1, Pose(0.0, 0.0, 0.0)
    shown = []
    for number, one in enumerate(run.objects):
        outline = np.asarray(one.outline, dtype=float).reshape(-1, 2)
        colour = SERIES[number % len(SERIES)] if several else REST
        if one.goal is not None:
            plan.outline(outline, one.goal, colour if several else GOAL, dashed=True, fill=0.08)
        if one.name not in tracks:
            continue
        with plan.group(f'data-object="{number}"'):
            if len(outline):
                corners = 1000 * transform_points(origin, outline)
                plan.polygon(corners, f'fill="{colour}" fill-opacity="0.35"')
            plan.outline(outline, origin, colour)
        shown.append({"number": number, "name": one.name, "track": _rows(tracks[one.name])})
    taps = [_tap_drawing(run, tracks, plan, *slide) for slide in slides(run)]
    with plan.group('data-tip=""' + ("" if TIP in tracks else ' hidden=""')):
        plan.polygon([(-90, 5), (0, 3), (0, -3), (-90, -5)], f'fill="{MUTED}" fill-opacity="0.6"')
        plan.circle(0, 0, 4, f'fill="{INK}"')
    plan.scale_bar()
    plan.axes()
    tip = _rows(tracks[TIP]) if TIP in tracks else []
    content = {"end": round(duration(run), 2), "objects": shown, "tip": tip, "taps": taps}
    return plan.drawing("the run, replayed"), json.dumps(content, separators=(",", ":"))


def _tap_drawing(
    run: Run, tracks: Mapping[str, Track], plan: Plan, tap: TapRow, fired: float, rest: float
) -> dict[str, object]:
    """Draw the strike, the prediction and the measured path of a tap; return its times."""
    name = tap.object_name if tap.object_name in tracks else run.first.name
    one = next((one for one in run.objects if one.name == name), run.first)
    outline = np.asarray(one.outline, dtype=float).reshape(-1, 2)
    with plan.group(f'data-tap="{tap.number}"'):
        plan.outline(outline, tap.predicted, PREDICTED, dashed=True)
        way = [(1000 * tap.before.x, 1000 * tap.before.y)]
        way.append((1000 * tap.predicted.x, 1000 * tap.predicted.y))
        plan.polygon(way, stroke(PREDICTED, 0.4 * plan.unit, True), closed=False)
        if name in tracks:
            path = 1000 * tracks[name].between(fired, rest)
            plan.polygon(path, stroke(INK, 0.5 * plan.unit), closed=False)
        plan.strike(tap.strike, tap.number, ARROW_MM, 0.6)
    return {"number": tap.number, "object": name, "fired": round(fired, 3), "rest": round(rest, 3)}


def _rows(track: Track) -> list[list[float]]:
    """Return a track in s, mm and degrees."""
    scale = np.array([1.0, 1e3, 1e3, 180.0 / math.pi])
    return [[round(v, 3 if n == 0 else 2) for n, v in enumerate(row)] for row in track.rows * scale]
