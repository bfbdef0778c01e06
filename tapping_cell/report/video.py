"""Video of a run from its recorded poses and camera images: MP4 (VP9) or GIF, in real time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from tapping_cell.report.palette import CARD, GOAL, INK, LINE, MUTED, PREDICTED, REST, SERIES, TABLE
from tapping_cell.report.replay import LEAD_S, Track, duration, slides, tracks_of
from tapping_cell.report.run import TIP, RunObject
from tapping_cell.report.run_reader import IllustratedRun
from tapping_cell.se2 import Array, Pose, transform_points

HEIGHT, WIDTH, FOOT = 384, 480, 32
"""Height and width of the drawing, of the camera image beside it, and height of the caption."""
RATES = {".mp4": 12.5, ".gif": 10.0}
"""Images per second of each kind of file."""
LONGEST_GIF_S = 60.0
"""Maximum length of a GIF: all its images are in memory until it is written, 4 MB per second."""
CODECS = ("vp09", "avc1", "mp4v")
"""Codecs in the order in which they are tried. Browsers do not play the last one."""
_FINE = 4
_MARGIN = 0.02
Pixels = NDArray[np.uint8]


class VideoError(ValueError):
    """Raised if a video cannot be written; the message says why."""


def write_video(path: Path, illustrated: IllustratedRun) -> float:
    """Write the video of a run and return its length in s.

    Raises:
        VideoError: the kind of file is unknown, there is nothing to show, the run is too long for a
            GIF, or OpenCV has no codec.
        OSError: the file cannot be written.
    """
    if path.suffix not in RATES:
        raise VideoError(f"{path}: a video ends with {' or '.join(RATES)}")
    film = _Film(illustrated)
    if not film.tracks:
        raise VideoError("the run has no recorded pose of an object, so there is no video")
    rate = RATES[path.suffix]
    if path.suffix == ".gif":
        if film.length > LONGEST_GIF_S:
            raise VideoError(
                f"the run takes {film.length:.0f} s, and a GIF at most {LONGEST_GIF_S:.0f} s; "
                f"write {path.with_suffix('.mp4')}"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_gif(path, film, rate)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_mp4(path, film.frames(rate), rate)
    return film.length


def _write_mp4(path: Path, frames: Iterator[Pixels], rate: float) -> None:
    size = (2 * WIDTH, HEIGHT + FOOT)
    for codec in CODECS:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate, size)
        if writer.isOpened():
            break
    else:
        raise VideoError(f"{path} cannot be written, or OpenCV has none of {', '.join(CODECS)}")
    for frame in frames:
        writer.write(frame)
    writer.release()


def _write_gif(path: Path, film: _Film, rate: float) -> None:
    # One palette for all images: only what moves differs from image to image.
    palette = Image.fromarray(film.frame(film.length / 2)[:, :, ::-1]).quantize(64)
    coded = (
        Image.fromarray(frame[:, :, ::-1]).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in film.frames(rate)
    )
    next(coded).save(path, save_all=True, append_images=coded, duration=1000 / rate, loop=0)


class _Film:
    """The images of a run: a plan of the table, the camera's last image, and a caption."""

    def __init__(self, illustrated: IllustratedRun) -> None:
        self._run, self._pictures = illustrated.run, illustrated.pictures
        self.tracks = tracks_of(self._run, illustrated.tracks)
        self.length = duration(self._run)
        half = np.maximum(np.asarray(self._run.table_size) / 2, 0.1) + _MARGIN
        self._scale = float(min(WIDTH / 2 / half[0], HEIGHT / 2 / half[1]))
        self._ground = np.full((HEIGHT, WIDTH, 3), _bgr(CARD), dtype=np.uint8)
        x, y = half - _MARGIN
        corners = self._pixels([(-x, -y), (x, -y), (x, y), (-x, y)])
        cv2.fillPoly(self._ground, [corners], _bgr(TABLE), cv2.LINE_AA, _FINE)
        cv2.polylines(self._ground, [corners], True, _bgr(LINE), 1, cv2.LINE_AA, _FINE)
        for number, one in enumerate(self._run.objects):
            if one.goal is not None:
                colour = self._colour(number) if len(self._run.objects) > 1 else GOAL
                self._dashed(self._ground, one, one.goal, colour)
        self._shown = -1
        self._photo = np.full_like(self._ground, _bgr(CARD))

    def frames(self, rate: float) -> Iterator[Pixels]:
        """Return the images at a rate in Hz, BGR."""
        for number in range(math.ceil(self.length * rate) + 1):
            yield self.frame(number / rate)

    def frame(self, time: float) -> Pixels:
        """Return the image at a time in s, BGR."""
        plan = self._ground.copy()
        started = [slide for slide in slides(self._run) if slide[1] - LEAD_S <= time]
        if started:
            tap, fired, rest = started[-1]
            objects = {one.name: one for one in self._run.objects}
            one = objects.get(tap.object_name, self._run.first)
            self._dashed(plan, one, tap.predicted, PREDICTED)
            if one.name in self.tracks and time > fired:
                path = self._pixels(self.tracks[one.name].between(fired, min(time, rest)))
                cv2.polylines(plan, [path], False, _bgr(INK), 2, cv2.LINE_AA, _FINE)
        for number, one in enumerate(self._run.objects):
            if one.name in self.tracks:
                self._object(plan, one, self.tracks[one.name].at(time), self._colour(number))
        if TIP in self.tracks:
            self._striker(plan, self.tracks[TIP], time)
        foot = np.full((FOOT, 2 * WIDTH, 3), _bgr(CARD), dtype=np.uint8)
        words = f"{self._run.name}   {time:.1f} s"
        if started:
            words += f"   tap {started[-1][0].number} of {self._run.taps[-1].number}"
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(foot, words, (10, 22), font, 0.55, _bgr(INK), 1, cv2.LINE_AA)
        return np.vstack([np.hstack([plan, self._camera(time)]), foot])

    def _camera(self, time: float) -> Pixels:
        """Return the last camera image before a time."""
        index = max(sum(each.at <= time for each in self._pictures) - 1, 0)
        if self._pictures and index != self._shown:
            data = np.frombuffer(self._pictures[index].jpeg, dtype=np.uint8)
            image = cv2.imdecode(data, cv2.IMREAD_COLOR)
            if image is not None:
                scale = min(WIDTH / image.shape[1], HEIGHT / image.shape[0])
                small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                self._photo[: small.shape[0], : small.shape[1]] = small[:HEIGHT, :WIDTH]
            self._shown = index
        return self._photo

    def _colour(self, number: int) -> str:
        return SERIES[number % len(SERIES)] if len(self._run.objects) > 1 else REST

    def _object(self, plan: Pixels, one: RunObject, pose: Pose, colour: str) -> None:
        corners = self._corners(one, pose)
        shade = plan.copy()
        cv2.fillPoly(shade, [corners], _bgr(colour), cv2.LINE_AA, _FINE)
        cv2.addWeighted(shade, 0.35, plan, 0.65, 0.0, plan)
        line = self._pixels(transform_points(pose, [[0.0, 0.0], _outline(one)[0]]))
        for points, closed in ((corners, True), (line, False)):
            cv2.polylines(plan, [points], closed, _bgr(colour), 2, cv2.LINE_AA, _FINE)

    def _dashed(self, plan: Pixels, one: RunObject, pose: Pose, colour: str) -> None:
        corners = self._corners(one, pose).reshape(-1, 2)
        ends = np.vstack([corners, corners[:1]]).astype(float)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ends, axis=0).T))])
        for start in np.arange(0.0, along[-1], 12 * 2**_FINE):
            spots = np.linspace(start, min(start + 7 * 2**_FINE, along[-1]), 4)
            dash = np.column_stack([np.interp(spots, along, ends[:, n]) for n in (0, 1)])
            points = np.round(dash).astype(np.int32)
            cv2.polylines(plan, [points], False, _bgr(colour), 2, cv2.LINE_AA, _FINE)

    def _striker(self, plan: Pixels, track: Track, time: float) -> None:
        tip = track.at(time)
        body = self._pixels(transform_points(tip, [[-0.09, 0.0], [0.0, 0.0]]))
        cv2.polylines(plan, [body], False, _bgr(MUTED), 6, cv2.LINE_AA, _FINE)
        centre = tuple(int(each) for each in body[-1])
        cv2.circle(plan, centre, 4 * 2**_FINE, _bgr(INK), -1, cv2.LINE_AA, _FINE)

    def _corners(self, one: RunObject, pose: Pose) -> NDArray[np.int32]:
        return self._pixels(transform_points(pose, _outline(one)))

    def _pixels(self, points: ArrayLike) -> NDArray[np.int32]:
        middle = np.array([WIDTH / 2, HEIGHT / 2])
        places = np.asarray(points, dtype=float) * self._scale * [1.0, -1.0] + middle
        return np.asarray(np.round(places * 2**_FINE), dtype=np.int32)


def _outline(one: RunObject) -> Array:
    around = np.linspace(0.0, 2 * math.pi, 24, endpoint=False)
    unknown = 0.01 * np.column_stack([np.cos(around), np.sin(around)])
    return np.asarray(one.outline, dtype=float).reshape(-1, 2) if one.outline else unknown


def _bgr(colour: str) -> tuple[int, int, int]:
    red, green, blue = (int(colour[n : n + 2], 16) for n in (1, 3, 5))
    return blue, green, red
