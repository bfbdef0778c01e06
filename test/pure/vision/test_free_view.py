"""The areas that bars hide from the camera, compared with rays from each point to the lens."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.vision.free_view import view_clearance

LENS = np.array([0.02, -0.015, 0.7])
place = st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4))


@given(place, place, st.floats(0.02, 0.4), st.floats(0.02, 0.4), place, st.floats(0.001, 0.05))
def test_an_area_hidden_by_a_bar_is_not_reported_as_free(
    first: tuple[float, float],
    second: tuple[float, float],
    low: float,
    high: float,
    seen: tuple[float, float],
    radius: float,
) -> None:
    start, end = np.array([*first, low]), np.array([*second, high])
    point = np.array([*seen, 0.012])
    clearance = float(view_clearance(LENS, [[start]], [[end]], [radius], [point])[0, 0])
    along = np.linspace(0.0, 1.0, 201)[:, None]
    bar = start + along * (end - start)
    share = ((bar[:, 2] - point[2]) / (LENS[2] - point[2]))[:, None]
    ray = point + share * (LENS - point)
    hidden = np.min(np.linalg.norm(ray[:, :2] - bar[:, :2], axis=1)) < radius
    if hidden:
        assert clearance < 0.0


@given(place, place, st.floats(0.02, 0.4), place, st.floats(0.001, 0.05))
def test_a_level_bar_hides_exactly_its_shadow(
    first: tuple[float, float],
    second: tuple[float, float],
    height: float,
    seen: tuple[float, float],
    radius: float,
) -> None:
    start, end = np.array([*first, height]), np.array([*second, height])
    point = np.array([*seen, 0.012])
    clearance = float(view_clearance(LENS, [[start]], [[end]], [radius], [point])[0, 0])
    share = (height - point[2]) / (LENS[2] - point[2])
    ray = (point + share * (LENS - point))[:2]
    bar = start + np.linspace(0.0, 1.0, 2001)[:, None] * (end - start)
    distance = np.min(np.linalg.norm(bar[:, :2] - ray, axis=1)) - radius
    # The clearance is measured in the plane of the point, where distances are larger than at the
    # bar's height.
    assert abs(clearance * (1.0 - share) - distance) < 1e-3


def test_a_bar_above_the_lens_hides_everything_around_its_position() -> None:
    start, end = [[[0.0, 0.0, 0.7]]], [[[0.1, 0.0, 0.7]]]
    assert view_clearance(LENS, start, end, [0.03], [[0.0, 0.0, 0.0]]) < 0
