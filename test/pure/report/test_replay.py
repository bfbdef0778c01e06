"""The replay of a run in the report and as a video."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from report_parts import made_run, tap_row

from tapping_cell.report.rendering import TEMPLATES
from tapping_cell.report.replay import NEGLIGIBLE, Track, player
from tapping_cell.report.run import TIP, Run
from tapping_cell.report.run_page import page
from tapping_cell.report.run_reader import IllustratedRun
from tapping_cell.report.svg import Plan
from tapping_cell.report.video import VideoError, write_video
from tapping_cell.se2 import Pose

OUTLINE = ((0.03, 0.0), (-0.02, 0.02), (-0.02, -0.02))
angles = st.floats(-3.1, 3.1)
places = st.builds(Pose, st.floats(-0.2, 0.2), st.floats(-0.15, 0.15), angles)


def run_through(poses: list[Pose]) -> Run:
    taps = tuple(
        tap_row(index + 1, before=before, measured=after, fired_at=2.0 * index + 1.0)
        for index, (before, after) in enumerate(pairwise(poses))
    )
    return made_run(taps, outline=OUTLINE, wall_time=2.0 * len(poses))


@given(st.lists(places, min_size=2, max_size=6))
def test_a_replay_without_a_bag_shows_every_pose_and_the_shortest_rotation(
    poses: list[Pose],
) -> None:
    found = player(run_through(poses), {}, Plan((-300.0, -220.0), (300.0, 220.0)))
    assert found is not None
    drawing, text = found
    ElementTree.fromstring(drawing)
    content = json.loads(text)
    rows = content["objects"][0]["track"]
    assert [row[0] for row in rows] == sorted(row[0] for row in rows)
    for pose in poses:
        assert any(math.hypot(x - 1e3 * pose.x, y - 1e3 * pose.y) < 0.1 for _, x, y, _ in rows)
    assert np.all(np.abs(np.diff([row[3] for row in rows])) <= 180.03)
    assert [tap["number"] for tap in content["taps"]] == list(range(1, len(poses)))


@given(st.lists(places, min_size=2, max_size=6), st.integers(2, 30))
def test_a_track_keeps_every_recorded_pose_within_the_stated_deviation(
    poses: list[Pose], rests: int
) -> None:
    recorded = [(0.05 * n, poses[n // rests]) for n in range(rests * len(poses))]
    track = Track.of([*recorded[1::2], *recorded[::2]])
    for at, pose in recorded:
        shown = track.at(at)
        assert shown.distance_to(pose) <= NEGLIGIBLE[0] * rests + 1e-9
        assert abs(shown.rotation_to(pose)) <= NEGLIGIBLE[1] * rests + 1e-9
    assert len(track.rows) <= 4 * len(poses)


def test_a_run_without_a_tap_has_no_replay() -> None:
    run = made_run(outline=OUTLINE)
    assert player(run, {}, Plan((-1.0, -1.0), (1.0, 1.0))) is None
    assert 'id="replay"' not in page(IllustratedRun(run, ()))


def test_the_page_embeds_the_recorded_poses_and_the_player() -> None:
    run = run_through([Pose(0.0, 0.0, 0.0), Pose(0.05, 0.0, 0.3)])
    tracks = {"": [(0.0, Pose(0.01, 0.0, 0.0))], TIP: [(0.0, Pose(0.2, 0.1, 0.0))]}
    text = page(IllustratedRun(run, (), tracks))
    data = text.partition('type="application/json">')[2].partition("</script>")[0]
    content = json.loads(data)
    assert content["objects"][0]["track"] == [[0.0, 10.0, 0.0, 0.0]]
    assert content["tip"] == [[0.0, 200.0, 100.0, 0.0]]
    script = text.rpartition("<script>")[2].partition("</script>")[0]
    assert "requestAnimationFrame" in script
    # The operator's page allows a report only this script, by its hash.
    assert script.encode() == (TEMPLATES / "replay.js").read_bytes()


@pytest.mark.parametrize("kind", [".mp4", ".gif"])
def test_a_video_shows_the_object_move(tmp_path: Path, kind: str) -> None:
    run = run_through([Pose(-0.2, 0.0, 0.0), Pose(0.2, 0.0, 0.0)])
    path = tmp_path / f"run{kind}"
    length = write_video(path, IllustratedRun(run, ()))
    assert length == pytest.approx(4.0)
    assert path.stat().st_size < 3e6 * length / 10
    if kind == ".gif":
        with Image.open(path) as film:
            count, shown = film.n_frames, []
            for number in (0, count - 1):
                film.seek(number)
                shown.append(np.asarray(film.convert("RGB")))
    else:
        video = cv2.VideoCapture(str(path))
        frames = []
        while (read := video.read())[0]:
            frames.append(np.asarray(read[1])[:, :, ::-1])
        count, shown = len(frames), [frames[0], frames[-1]]
    assert count / (10.0 if kind == ".gif" else 12.5) == pytest.approx(length, abs=0.3)

    def blue(image: np.ndarray) -> float:
        """Return the mean column of the object's colour."""
        part = image[:380, :480].astype(int)
        return float(np.mean(np.nonzero(part[:, :, 2] - part[:, :, 0] > 60)[1]))

    assert blue(shown[0]) < 200 < 280 < blue(shown[1])


def test_an_unknown_kind_of_video_and_a_run_without_a_pose_are_refused(tmp_path: Path) -> None:
    run = run_through([Pose(0.0, 0.0, 0.0), Pose(0.05, 0.0, 0.3)])
    with pytest.raises(VideoError, match=r"ends with \.mp4 or \.gif"):
        write_video(tmp_path / "run.avi", IllustratedRun(run, ()))
    with pytest.raises(VideoError, match="no recorded pose"):
        write_video(tmp_path / "run.gif", IllustratedRun(made_run(start=None), ()))
    long = made_run(run.taps, outline=OUTLINE, wall_time=600.0)
    with pytest.raises(VideoError, match=r"takes 600 s, .*write .*run\.mp4"):
        write_video(tmp_path / "new" / "run.gif", IllustratedRun(long, ()))
    assert not (tmp_path / "new").exists()
