"""The run folder describes a run in mm and degrees, and can be rebuilt from the bag alone."""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import struct
from dataclasses import astuple, replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_bags import BEGAN, GOAL, STOPS, MadeRun

from tapping_cell.report.bag import bag_file, read_bag
from tapping_cell.report.cell_view import draw_cell
from tapping_cell.report.recorded import BagError
from tapping_cell.report.run import RunObject
from tapping_cell.report.run_folder import (
    RunError,
    read_run,
    residual,
    summary,
    write_failure,
    write_folder,
)
from tapping_cell.report.run_page import page
from tapping_cell.report.run_reader import (
    IllustratedRun,
    inside,
    note_of,
    read_illustrated_run,
)
from tapping_cell.se2 import Pose

VOID = {"meta", "img", "br", "input"}


class Page(HTMLParser):
    """Collects a page's words and resources; each element must be closed in the right order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.resources: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attributes]
        assert len(names) == len(set(names)), (tag, names)
        self.resources += [value or "" for name, value in attributes if name in ("src", "href")]
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attributes]
        assert len(names) == len(set(names)), (tag, names)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def make(folder: Path, made: MadeRun) -> Path:
    folder.mkdir()
    return made.write(folder)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = make(tmp_path_factory.mktemp("original") / "run", MadeRun(STOPS))
    write_folder(folder, pictures=False)
    return folder


@pytest.fixture
def written(original, tmp_path):
    return Path(shutil.copytree(original, tmp_path / "run"))


def test_the_folder_contains_its_files_and_they_agree(tmp_path: Path) -> None:
    folder = make(tmp_path / "run", MadeRun(STOPS, errors=[(3.0, 512, "busy <b>")]))
    run = write_folder(folder)
    content = json.loads((folder / "summary.json").read_text())
    assert run.reached and content["reached"] is True and content["outcome"] == "reached"
    assert content["taps"] == 2 and content["seed"] == 5 and content["error_code"] == 0
    assert content["goal"]["x_mm"] == pytest.approx(30) and content["began"] == BEGAN
    assert content["wall_time"] == pytest.approx(21.0)
    left = content["measured_residual"]["distance_mm"]
    assert left == pytest.approx(math.hypot(0.5, 0.3))
    assert content["true_residual"]["distance_mm"] == pytest.approx(math.hypot(0.6, 0.3))
    with (folder / "taps.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["tap"] for row in rows] == ["1", "2"]
    assert float(rows[0]["measured_x_mm"]) == pytest.approx(10.0)
    assert float(rows[0]["true_x_mm"]) == pytest.approx(10.1)
    assert [float(row["fired_at_s"]) for row in rows] == [4.5, 14.5]
    assert [float(row["commanded_at_s"]) for row in rows] == [2.0, 12.0]
    assert {row["outcome"] for row in rows} == {"fired"}
    assert [float(row["learnt_distance"]) for row in rows] == [1.25, 1.25]
    assert float(rows[0]["learnt_direction_deg"]) == pytest.approx(2.0)
    picture = cv2.imread(str(folder / "cell.png"))
    assert picture.shape[0] > 400 and picture.std() > 5
    report = Page((folder / "report.html").read_text())
    assert all(name.startswith("data:image/jpeg") for name in report.resources)
    assert len(report.resources) == 3
    for words in ("Goal reached in 2 taps", "Tap 2", "ARM_BUSY", "busy <b>", "<made> & cell"):
        assert words in report.text
    assert "distance 1.25 \u00b1 0.04" in report.text


def test_figure_and_page_are_regenerated_from_summary_and_taps_alone(tmp_path: Path) -> None:
    folder = make(tmp_path / "run", MadeRun(STOPS, errors=[(3.0, 512, "busy")]))
    first = write_folder(folder, pictures=False)
    again = read_run(folder)
    assert set(summary(again)) == set(summary(first))
    for name in ("outcome", "planner", "seed", "files", "versions", "began", "error_code"):
        assert summary(again)[name] == summary(first)[name]
    assert page(IllustratedRun(again, ())).replace("data:", "").count('role="img"') == 7
    assert again.phases == first.phases and again.errors == first.errors
    assert again.activities == first.activities
    for one, other in zip(first.taps, again.taps, strict=True):
        assert one.measured.distance_to(other.measured) < 1e-7
        assert one.true_pose is not None and other.true_pose is not None
        assert one.fired_at == pytest.approx(other.fired_at, abs=1e-3)
        assert one.reason == other.reason == "a detour, with a comma"
        assert one.predicted_covariance is not None and other.predicted_covariance is not None
        for before, after in zip(one.predicted_covariance, other.predicted_covariance, strict=True):
            assert before == pytest.approx(after, rel=1e-5)
        assert astuple(one.learnt) == pytest.approx(astuple(other.learnt), abs=1e-6)


def test_the_table_of_an_earlier_version_is_read_without_learnt_values(written: Path) -> None:
    folder = written
    with (folder / "taps.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    kept = [name for name in rows[0] if not name.startswith("learnt")]
    with (folder / "taps.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, kept, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    tap = read_run(folder).taps[0]
    assert math.isnan(tap.learnt.distance)
    assert "off centre" not in page(IllustratedRun(read_run(folder), ()))


def test_a_run_of_version_0_1_is_read(tmp_path: Path) -> None:
    """Version 0.1 recorded the own object's states on a topic of their own."""
    now, before = (
        read_illustrated_run(
            MadeRun(STOPS, old_topic=old).write(tmp_path / str(old)) / "bag", "run"
        )
        for old in (False, True)
    )
    assert before.run.objects == now.run.objects and before.tracks == now.tracks
    assert before.run.activities == now.run.activities


@pytest.mark.parametrize(
    ("made", "outcome", "words"),
    [
        (MadeRun(STOPS, truth_off=0.002), "not truly reached", "true pose is outside"),
        (MadeRun(STOPS, truth=False), "reached", "Goal reached in 2 taps"),
        (MadeRun(STOPS, state=8, code=503, sentence="alarm 2"), "failed", "ARM_ALARM"),
        (MadeRun(STOPS[:2], state=9, code=111, sentence="canceled"), "canceled", "Goal canceled"),
        (
            MadeRun(
                STOPS[:1], refused=True, state=8, code=103, sentence="off", goal=Pose(0.9, 0, 0)
            ),
            "refused",
            "Send a goal closer to the middle",
        ),
        (
            MadeRun(
                STOPS[:1],
                refused=True,
                state=8,
                code=101,
                sentence="NaN",
                goal=Pose(math.nan, 0, 0),
                tolerance=(math.nan, 0.0),
            ),
            "refused",
            "GOAL_NOT_FINITE",
        ),
        (MadeRun(STOPS[:2], end_reported=False), "unfinished", "the recording ended"),
        (MadeRun(STOPS[:1]), "not truly reached", "true pose is outside"),
        (MadeRun(STOPS, namespace="/left/cell"), "reached", "Goal reached in 2 taps"),
    ],
    ids=[
        "not true",
        "hardware",
        "failed",
        "canceled",
        "refused",
        "NaN",
        "unfinished",
        "no tap",
        "namespace",
    ],
)
def test_every_result_is_reported_correctly(made, outcome, words, tmp_path):
    folder = make(tmp_path / "run", made)
    run = write_folder(folder, pictures=False)
    content = json.loads((folder / "summary.json").read_text())
    assert run.outcome == content["outcome"] == outcome
    assert content["reached"] is (outcome == "reached")
    assert (content["error_code"] == 0) == (outcome in ("reached", "not truly reached"))
    assert words in Page(page(read_illustrated_run(folder / "bag"))).text


def test_a_run_without_start_or_goal_is_plotted(tmp_path: Path) -> None:
    refused = MadeRun(STOPS[:1], refused=True, state=8, code=101, goal=Pose(math.nan, 0, 0))
    illustrated = read_illustrated_run(make(tmp_path / "run", refused) / "bag")
    for name, run in (
        ("no_goal", illustrated.run),
        ("nothing", replace(illustrated.run, objects=(RunObject(),), table_size=(0.0, 0.0))),
    ):
        draw_cell(run, tmp_path / f"{name}.png")
        assert cv2.imread(str(tmp_path / f"{name}.png")).std() > 5
        assert "Goal refused" in Page(page(IllustratedRun(run, ()))).text


@pytest.mark.parametrize("seen", [0, 1])
def test_a_goal_that_ended_during_a_tap_is_plotted(seen: int, tmp_path: Path) -> None:
    """The object was not seen after the last tap."""
    made = MadeRun(STOPS[: seen + 2], state=9, code=111, sentence="canceled", truth=False)
    run = read_illustrated_run(make(tmp_path / "run", made) / "bag").run
    lost = replace(run.taps[-1], measured=Pose(math.nan, math.nan, math.nan), at_rest_at=math.nan)
    run = replace(run, taps=(*run.taps[:-1], lost))
    draw_cell(run, tmp_path / "cell.png")
    text = page(IllustratedRun(run, ()))
    assert "the object was not seen afterwards" in text and not re.search(r"\bnan\b", text)


def test_the_bag_of_a_killed_recorder_gives_a_report_up_to_its_end(tmp_path: Path) -> None:
    folder = make(tmp_path / "run", MadeRun(STOPS))
    file = bag_file(folder / "bag")
    whole = read_bag(file)
    made = MadeRun(STOPS, end_reported=False)
    shutil.rmtree(folder)
    folder.mkdir()
    made.write(folder)
    data = file.read_bytes()
    file.write_bytes(data[:-40])
    (folder / "bag" / "metadata.yaml").unlink()
    assert whole.whole and not read_bag(file).whole
    run = write_folder(folder, pictures=False)
    assert (run.outcome, len(run.taps), run.error_code) == ("unfinished", 2, 906)


def test_a_recorder_that_saw_the_object_only_after_a_tap_knows_the_start(tmp_path: Path) -> None:
    made = MadeRun(STOPS, seen_before=False)
    run = read_illustrated_run(made.write(tmp_path / "run") / "bag").run
    assert run.first.start == pytest.approx(STOPS[0])


def test_a_bag_without_a_goal_is_refused_with_a_message(tmp_path: Path) -> None:
    folder = make(tmp_path / "run", MadeRun(STOPS[:1], end_reported=False, refused=True))
    with pytest.raises(BagError, match="contains no goal"):
        read_illustrated_run(folder / "bag")


def test_a_failure_before_any_goal_has_its_code_and_message(tmp_path: Path) -> None:
    write_failure(tmp_path, 902, "the cell was not ready", 1, 3.0)
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content["error_code"] == 902 and content["reached"] is False
    assert content["error_msg"] == "the cell was not ready" and content["seed"] == 1
    assert len((tmp_path / "taps.csv").read_text().splitlines()) == 1
    assert "NOT_READY" in Page((tmp_path / "report.html").read_text()).text


def test_a_failure_completes_an_unfinished_run_and_no_other(tmp_path: Path) -> None:
    folder = make(tmp_path / "cut", MadeRun(STOPS[:2], end_reported=False))
    write_folder(folder, pictures=False)
    write_failure(folder, 904, "the node camera_pose ended", 5, 9.0)
    for run in (read_run(folder), write_folder(folder, pictures=False)):
        assert (run.outcome, run.error_code, len(run.taps)) == ("failed", 904, 1)
        assert "camera_pose" in run.error_msg
    folder = make(tmp_path / "ended", MadeRun(STOPS))
    write_folder(folder, pictures=False)
    write_failure(folder, 111, "interrupted", 5, 9.0)
    assert read_run(folder).reached


@pytest.mark.parametrize(
    ("name", "content"), [("summary.json", "{"), ("summary.json", "{}"), ("taps.csv", "tap\nx\n")]
)
def test_a_damaged_folder_is_refused_with_a_message(name: str, content: str, written: Path) -> None:
    (written / name).write_text(content)
    with pytest.raises(RunError, match="damaged or of another version"):
        read_run(written)


def test_a_missing_folder_is_refused_with_a_message(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="cannot be read"):
        read_run(tmp_path)


poses = st.builds(Pose, st.floats(-1, 1), st.floats(-1, 1), st.floats(-10, 10))


@given(goal=poses, pose=poses)
def test_residuals_use_the_shortest_rotation_and_decide_what_is_inside(goal, pose):
    left = residual(goal, pose)
    assert left is not None
    assert 0 <= left["rotation_deg"] <= 180 + 1e-9
    assert left["distance_mm"] == pytest.approx(math.hypot(left["x_mm"], left["y_mm"]))
    expected = left["distance_mm"] <= 1.0 and left["rotation_deg"] <= 1.0
    assert inside(goal, pose, (0.001, math.radians(1.0))) == expected
    assert not inside(goal, None, (1.0, 4.0))


@settings(max_examples=settings.default.max_examples // 5)
@given(
    stops=st.lists(
        st.builds(Pose, st.floats(-0.2, 0.2), st.floats(-0.15, 0.15), st.floats(-3, 3)),
        min_size=1,
        max_size=5,
    )
)
def test_a_run_with_any_taps_is_read_back_unchanged(stops, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    run = read_illustrated_run(MadeRun(stops).write(folder) / "bag").run
    assert len(run.taps) == len(stops) - 1
    one = run.first
    assert one.goal is not None and one.goal.distance_to(GOAL) < 1e-12
    assert one.start is not None and one.start.distance_to(stops[0]) < 1e-12
    for tap, stop in zip(run.taps, stops[1:], strict=True):
        assert tap.measured.distance_to(stop) < 1e-12
        assert abs(tap.measured.rotation_to(stop)) < 1e-9
    assert re.fullmatch("reached|not truly reached", run.outcome)


def test_the_time_is_divided_by_device_activity(tmp_path: Path) -> None:
    run = write_folder(make(tmp_path / "run", MadeRun(STOPS)), pictures=False)
    assert [step.name for step in run.activities[:5]] == [
        "the arm travels",
        "the arm lowers the striker",
        "the tapper charges and fires",
        "the arm withdraws",
        "the planner waits or plans",
    ]
    began = [step.began for step in run.activities[:5]]
    assert began == pytest.approx([2.0, 3.2, 4.0, 5.6, 6.5], abs=1e-3)


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Return begin and end of each record with messages in an MCAP file."""
    found, place = [], 8
    while place + 9 <= len(data):
        kind, length = struct.unpack_from("<BQ", data, place)
        if kind in (5, 6):
            found.append((place, place + 9 + length))
        place += 9 + length
    return found


@settings(deadline=None, max_examples=40)
@given(share=st.floats(0.0, 1.0), damage=st.sampled_from(["cut", "gap", "flip"]))
def test_a_damaged_bag_never_replaces_a_better_summary(
    share: float, damage: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = make(tmp_path_factory.mktemp("runs") / "run", MadeRun(STOPS))
    write_folder(folder, pictures=False)
    before = {name: (folder / name).read_bytes() for name in ("summary.json", "taps.csv")}
    file = folder / "bag" / "bag.mcap"
    data = bytearray(file.read_bytes())
    begin, end = chunks(data)[int(share * (len(chunks(data)) - 1))]
    if damage == "cut":
        del data[int(share * (len(data) - 1)) :]
    elif damage == "gap":
        del data[begin:end]
    else:
        data[int(begin + share * (end - begin - 1))] ^= 0x55
    file.write_bytes(data)
    try:
        run = write_folder(folder, pictures=False)
    except BagError:
        run = None
    assert {name: (folder / name).read_bytes() for name in before} == before
    if run is not None and (damage != "flip" or run.note):
        assert run.note.startswith("summary.json and taps.csv are kept, because")
        assert (run.outcome, len(run.taps)) == ("reached", 2)


def test_a_report_of_a_cut_bag_says_so_in_its_first_line(tmp_path: Path) -> None:
    folder = make(tmp_path / "run", MadeRun(STOPS))
    file = folder / "bag" / "bag.mcap"
    file.write_bytes(file.read_bytes()[:-40])
    run = write_folder(folder)
    assert "cut off or still being written" in run.note
    assert (folder / "summary.json").read_text().splitlines()[1].startswith('  "note": "the end of')
    text = Page((folder / "report.html").read_text()).text
    words = [text.index(word) for word in ("Incomplete:", "from goal to end")]
    assert words == sorted(words)
    assert read_run(folder).note == run.note


def test_a_run_of_a_newer_version_is_named(tmp_path: Path) -> None:
    folder = make(tmp_path / "run", MadeRun(STOPS))
    bag = read_bag(folder / "bag")
    assert note_of(bag, {"versions": {"tapping_cell": "99.1"}}).startswith(
        "the run was recorded by tapping_cell 99.1, which is newer"
    )
    assert note_of(bag, {"versions": {"tapping_cell": "0.0.9"}}) == note_of(bag, {}) == ""
