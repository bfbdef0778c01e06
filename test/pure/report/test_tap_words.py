"""The report's description of a tap."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from report_parts import tap_row

from tapping_cell.report.run import TapRow
from tapping_cell.report.tap_words import tap_sentence
from tapping_cell.se2 import Pose

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
