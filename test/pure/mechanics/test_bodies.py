"""Bodies: moments compared with known values, and invalid shapes."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.mechanics import Disk, InvalidBodyError, Polygon, Ring

SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]


def test_a_disk_and_a_ring_have_correct_moments_of_inertia():
    disk, ring = Disk(0.048, 0.2455, 0.012), Ring(0.05, 0.1, 0.01)
    assert disk.inertia == pytest.approx(0.2455 * 0.048**2 / 2)
    assert disk.gamma == pytest.approx(2) and ring.gamma == pytest.approx(1)
    assert disk.radius_of_gyration == pytest.approx(0.048 / math.sqrt(2))
    assert ring.inertia == pytest.approx(0.1 * 0.05**2)


@given(st.floats(0.01, 1), st.floats(0.01, 1), st.floats(-5, 5), st.floats(-3, 3), st.booleans())
def test_a_rectangle_has_correct_moments_in_any_position_and_order(a, b, offset, angle, flip):
    corners = np.array([(0, 0), (a, 0), (a, b), (0, b)])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    points = corners @ turn.T + offset
    body = Polygon(points[::-1] if flip else points, 2.0, 0.01)
    assert body.inertia == pytest.approx(2.0 * (a * a + b * b) / 12, rel=1e-9)
    assert body.area == pytest.approx(a * b, rel=1e-9)
    assert body.bounding_radius == pytest.approx(math.hypot(a, b) / 2, rel=1e-9)
    assert np.abs(body.points.mean(axis=0)).max() < 1e-9


def test_a_polygon_with_many_sides_approximates_a_disk():
    angles = np.linspace(0, 2 * math.pi, 400, endpoint=False)
    body = Polygon(0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1), 1.0, 0.01)
    disk = Disk(0.1, 1.0, 0.01)
    assert body.inertia == pytest.approx(disk.inertia, rel=1e-4)
    assert body.support_radius == pytest.approx(0.1, rel=1e-4)
    assert np.abs(body.boundary(angles) - disk.boundary(angles)).max() < 1e-5


def test_the_boundary_of_a_square_lies_on_its_edges():
    square = Polygon(SQUARE, 1.0, 0.01)
    angle = np.linspace(-3, 3, 37)
    assert np.abs(square.boundary(angle)).max(axis=-1) == pytest.approx(0.5)
    assert square.normal([0.1, math.pi / 2, -3.0]) == pytest.approx(
        np.array([[1, 0], [0, 1], [-1, 0]])
    )


@pytest.mark.parametrize(
    "radius, mass, height",
    [(-1, 1, 1), (1, -0.2, 1), (1, 1, 0), (math.nan, 1, 1), (1, math.inf, 1), ("wide", 1, 1)],
)
@pytest.mark.parametrize("shape", [Disk, Ring])
def test_an_impossible_body_is_refused(shape, radius, mass, height):
    with pytest.raises(InvalidBodyError, match="above 0|must be a number"):
        shape(radius, mass, height)


def test_the_refusal_names_value_and_limit():
    with pytest.raises(InvalidBodyError, match=r"disk mass is -0\.2 kg.*above 0"):
        Disk(0.05, -0.2, 0.01)


PENTAGRAM = [(math.cos(0.8 * math.pi * k), math.sin(0.8 * math.pi * k)) for k in range(5)]


@pytest.mark.parametrize(
    "vertices, word",
    [
        ([(0, 0), (1, 0), (0.2, 0.2), (0, 1)], "convex"),
        ([(0, 0), (1, 1), (1, 0), (0, 1)], "turns"),
        (PENTAGRAM, "winds"),
        ([(0, 0), (1, 0)], "at least 3"),
        ([(0, 0), (1, 0), (2, 0)], "180"),
        ([(0, 0), (0, 0), (1, 0), (1, 1)], "twice"),
        ([(0, 0), (1, 0), (1, math.nan)], "finite"),
        ([(0, 0), (1, 0), (1, 2, 3)], "pairs"),
        (3, "pairs"),
    ],
)
def test_an_invalid_polygon_is_refused(vertices, word):
    with pytest.raises(InvalidBodyError, match=word):
        Polygon(vertices, 1.0, 0.01)


def test_bodies_compare_by_value():
    assert Polygon(SQUARE, 1, 0.1) == Polygon([(5, 5), (6, 5), (6, 6), (5, 6)], 1, 0.1)
    assert hash(Disk(1, 1, 1)) == hash(Disk(1, 1, 1))
    assert Disk(1, 1, 1) != Ring(1, 1, 1)
