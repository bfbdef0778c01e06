"""The run folder says what happened, in mm and degrees, and can be read by a program."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.report.run import Failure, Run, TapRow
from tapping_cell.report.run_folder import inside, residual, summary, write_failure, write_run
from tapping_cell.se2 import Pose

START, GOAL, END = Pose(0.0, 0.0, 0.1), Pose(0.01, 0.0, 0.3), Pose(0.0102, 0.0001, 0.301)
TAP = TapRow(
    number=1,
    tap_id=7,
    method="exact",
    before=START,
    commanded=Pose(0.01, 0.0, 0.2),
    predicted=GOAL,
    measured=END,
    true_pose=END,
    strike=Pose(-0.07, 0.0, 0.02),
    striker_speed=0.2,
    contact_angle=3.1,
    outcome="fired",
)
RUN = Run(
    goal=GOAL,
    start=START,
    tolerance=(0.001, math.radians(1.0)),
    taps=(TAP, replace(TAP, number=2, true_pose=None)),
    final_measured=END,
    final_true=END,
    reached=True,
    wall_time=12.5,
    seed=3,
    versions={"python": "3"},
    error_code=0,
    error_msg="",
    outline=((0.05, 0.0), (0.0, 0.05), (-0.05, 0.0), (0.0, -0.05)),
    table_size=(0.6, 0.44),
)


def test_the_folder_holds_three_files_that_agree(tmp_path: Path) -> None:
    write_run(tmp_path, RUN)
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content["reached"] is True and content["taps"] == 2 and content["seed"] == 3
    assert content["goal"] == {"x_mm": 10.0, "y_mm": 0.0, "theta_deg": math.degrees(0.3)}
    assert content["true_residual"]["distance_mm"] == pytest.approx(math.hypot(0.2, 0.1))
    with (tmp_path / "taps.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["tap"] for row in rows] == ["1", "2"]
    assert float(rows[0]["measured_x_mm"]) == pytest.approx(10.2)
    assert float(rows[0]["commanded_dtheta_deg"]) == pytest.approx(math.degrees(0.2), abs=1e-4)
    assert math.isnan(float(rows[1]["true_x_mm"]))
    picture = cv2.imread(str(tmp_path / "cell.png"))
    assert picture.shape[0] > 400 and picture.std() > 5


def test_a_run_without_a_tap_is_written_too(tmp_path: Path) -> None:
    write_run(tmp_path, replace(RUN, taps=(), final_measured=None, final_true=None, reached=False))
    assert json.loads((tmp_path / "summary.json").read_text())["true_residual"] is None
    header = (tmp_path / "taps.csv").read_text().splitlines()
    assert len(header) == 1 and "predicted_x_mm" in header[0]


def test_a_failed_run_has_its_code_and_sentence(tmp_path: Path) -> None:
    write_failure(tmp_path, Failure(3.0, 1, {}, 902, "the cell was not ready"))
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content["error_code"] == 902 and content["reached"] is False
    assert content["error_msg"] == "the cell was not ready"
    assert set(summary(RUN)) - {"start", "tolerance"} <= set(content)


poses = st.builds(Pose, st.floats(-1, 1), st.floats(-1, 1), st.floats(-10, 10))


@given(goal=poses, pose=poses)
def test_residuals_are_short_ways_round_and_decide_what_is_inside(goal: Pose, pose: Pose) -> None:
    left = residual(goal, pose)
    assert left is not None
    assert 0 <= left["rotation_deg"] <= 180 + 1e-9
    assert left["distance_mm"] == pytest.approx(math.hypot(left["x_mm"], left["y_mm"]))
    expected = left["distance_mm"] <= 1.0 and left["rotation_deg"] <= 1.0
    assert inside(goal, pose, (0.001, math.radians(1.0))) == expected
    assert not inside(goal, None, (1.0, 4.0))
