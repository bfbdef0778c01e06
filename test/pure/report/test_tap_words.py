"""The report's description of a tap, and the animation of a run."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_parts import made_run, tap_row

from tapping_cell.report.animation import END_S, TAP_S, animation
from tapping_cell.report.run import TapRow
from tapping_cell.report.svg import Plan
from tapping_cell.report.tap_words import tap_sentence
from tapping_cell.se2 import Pose

OUTLINE = ((0.03, 0.0), (-0.02, 0.02), (-0.02, -0.02))
SPREAD = ((4e-6, 0.0, 0.0), (0.0, 1e-6, 0.0), (0.0, 0.0, 4e-4))


def tap(number: int = 1, **changed: Any) -> TapRow:
    return tap_row(number, **{"predicted_covariance": SPREAD, **changed})


def test_a_tap_of_a_cell_with_several_tappers_names_its_tapper() -> None:
    assert tap_sentence(tap(tapper="north"), None).startswith("Tapper 'north'. Expected")


def test_the_expected_effort_is_shown_if_the_planner_provides_it() -> None:
    text = tap_sentence(tap(expected_taps=2.23, expected_seconds=5.94), Pose(0.04, 0.0, 0.2))
    assert text.endswith(
        "Before this tap, the planner expected to reach the goal in 2.2 taps, 5.9 s."
    )
    assert "reach the goal in 1.0 taps." in tap_sentence(tap(expected_taps=1.0), None)
    assert "expected to reach" not in tap_sentence(tap(), None)


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        (Pose(0.04, 0.0, 0.2), "The tap is aimed straight at the goal."),
        (Pose(0.01, 0.0, 0.2), "The tap moves the object past the goal on purpose: a rotation"),
        (Pose(-0.01, 0.0, 0.2), "The tap moves the object away from the goal on purpose"),
        (Pose(0.09, 0.0, 0.2), "The tap stops 50.0 mm short of the goal on purpose"),
    ],
)
def test_the_purpose_of_a_tap_is_shown(goal: Pose, words: str) -> None:
    text = tap_sentence(tap(), goal)
    assert words in text
    assert "Expected to move the object by 40.0 mm and +11.5 deg" in text
    assert "measured 41.0 mm and +12.0 deg, within the scatter of a tap." in text


def test_a_reason_given_by_the_planner_is_shown_unchanged() -> None:
    text = tap_sentence(tap(reason="a tap in this direction was skipped"), Pose(0.01, 0.0, 0.2))
    assert "because a tap in this direction was skipped." in text and "on purpose" not in text


def test_an_unexpected_result_is_described_as_such() -> None:
    text = tap_sentence(tap(measured=Pose(0.02, 0.0, 0.1)), None)
    assert "outside the range of 95 % of taps" in text
    assert "within the scatter" not in text


def test_the_description_of_scatter_is_correct_for_95_of_100_taps() -> None:
    draws = np.random.default_rng(3).multivariate_normal([0.04, 0.0, 0.2], np.array(SPREAD), 1500)
    text = [tap_sentence(tap(measured=Pose(*draw)), None) for draw in draws]
    assert np.mean(["within the scatter" in each for each in text]) == pytest.approx(0.95, abs=0.02)


def test_a_tap_without_an_observation_is_not_judged() -> None:
    unseen = Pose(math.nan, math.nan, math.nan)
    text = tap_sentence(tap(measured=unseen), Pose(0.1, 0.0, 0.0))
    assert "the object was not seen afterwards" in text and "nan" not in text


angles = st.floats(-3.1, 3.1)
places = st.builds(Pose, st.floats(-0.2, 0.2), st.floats(-0.15, 0.15), angles)


@given(st.lists(places, min_size=2, max_size=6))
def test_the_animation_shows_every_pose_and_the_shortest_rotation(poses: list[Pose]) -> None:
    taps = tuple(
        tap(index + 1, before=before, measured=after)
        for index, (before, after) in enumerate(pairwise(poses))
    )
    run = made_run(taps, outline=OUTLINE)
    drawn = animation(run, Plan((-300.0, -220.0), (300.0, 220.0)))
    style, _, picture = drawn.partition("</style>")
    ElementTree.fromstring(picture)
    frames = [
        tuple(map(float, found))
        for found in re.findall(
            r"([\d.]+)%\{transform:translate\(([-\d.]+)px,([-\d.]+)px\) rotate\(([-\d.]+)deg", style
        )
    ]
    shares = [share for share, *_ in frames]
    assert shares == sorted(shares) and shares[-1] == 100.0
    for pose in poses:
        assert any(math.hypot(x - 1000 * pose.x, y + 1000 * pose.y) < 0.02 for _, x, y, _ in frames)
    turns = np.diff([angle for *_, angle in frames])
    assert np.all(np.abs(turns) <= 180.001)
    assert f"{TAP_S * len(taps) + END_S:.1f}s" in style
    assert len(drawn) < 20_000


def test_a_run_without_a_tap_has_no_animation() -> None:
    assert animation(made_run(outline=OUTLINE), Plan((-1.0, -1.0), (1.0, 1.0))) == ""
