import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.planning import CircleArea, PlanningError, PolygonArea, Workspace

L_SHAPE = ((0.0, 0.0), (0.10, 0.0), (0.10, 0.04), (0.04, 0.04), (0.04, 0.10), (0.0, 0.10))


def in_l_shape(x, y):
    return 0 <= x <= 0.10 and 0 <= y <= 0.10 and (x <= 0.04 or y <= 0.04)


def outline_points(vertices, count=4000):
    corners = np.asarray(vertices)
    sides = np.roll(corners, -1, axis=0) - corners
    share = np.linspace(0, 1, count // len(corners))[:, None]
    return np.concatenate([a + share * b for a, b in zip(corners, sides, strict=True)])


@given(st.floats(-0.2, 0.3), st.floats(-0.2, 0.3))
def test_distance_to_a_non_convex_polygon(x, y):
    found = float(PolygonArea(L_SHAPE).distance([x, y]))
    reference = np.min(np.hypot(*(outline_points(L_SHAPE) - [x, y]).T))
    assert abs(found) == pytest.approx(reference, abs=2e-4)
    if reference > 1e-3:
        assert (found < 0) == in_l_shape(x, y)


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_a_circle_and_a_polygon_of_many_corners_agree(x, y):
    angles = np.linspace(0, 2 * math.pi, 720, endpoint=False)
    polygon = PolygonArea(
        tuple((0.1 + 0.05 * math.cos(a), 0.05 * math.sin(a)) for a in angles.tolist())
    )
    circle = CircleArea(0.1, 0.0, 0.05)
    assert float(polygon.distance([x, y])) == pytest.approx(
        float(circle.distance([x, y])), abs=1e-6
    )


def test_clearance_is_limited_by_edges_and_keep_outs():
    table = Workspace(keep_outs=(CircleArea(0.1, 0.0, 0.02),))
    assert float(table.object_clearance([0.0, 0.0])) == pytest.approx(0.1 - 0.02 - 0.005)
    assert float(table.object_clearance([-0.25, 0.0])) == pytest.approx(0.05 - 0.005)
    assert float(table.striker_clearance([-0.4, 0.0])) == pytest.approx(0.15 - 0.1)


@pytest.mark.parametrize(
    "make",
    [
        lambda: CircleArea(0.0, math.nan, 0.1),
        lambda: CircleArea(0.0, 0.0, 0.0),
        lambda: PolygonArea(((0, 0), (1, 1))),
        lambda: Workspace(length=-1.0),
        lambda: Workspace(keep_out_margin=math.inf),
    ],
)
def test_impossible_areas_are_refused(make):
    with pytest.raises(PlanningError):
        make()
