"""The table of a polygon's slides compared with their integration."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tapping_cell.mechanics import Disk, MechanicsError, Polygon, Sliding, polygon_table
from tapping_cell.mechanics.polygon_sliding import invert
from tapping_cell.mechanics.polygon_table import LARGEST_SIZE, symmetry

SQUARE = Polygon([(0, 0), (0.08, 0), (0.08, 0.08), (0, 0.08)], 0.2, 0.01)
PLANK = Polygon([(0, 0), (0.16, 0), (0.16, 0.02), (0, 0.02)], 0.2, 0.01)
TRIANGLE = Polygon([(0, 0), (0.1, 0), (0, 0.07)], 0.2, 0.01)
MU, G = 0.2, 9.81
each_body = pytest.mark.parametrize(
    ("body", "factor"),
    [(SQUARE, 1.0), (PLANK, 3.64), (TRIANGLE, 2.0)],
    ids=["square", "plank", "triangle"],
)


def launches(body: Polygon, count: int, largest: float) -> np.ndarray:
    """Return initial motions in all directions, with all ratios of spin to speed (including pure
    translation and pure rotation), and with all sizes of slides up to ``largest``."""
    random = np.random.default_rng(4)
    rho = body.radius_of_gyration
    major = np.sqrt(largest * random.uniform(0, 1, count) ** 2 * MU * G * rho)
    ratio = random.uniform(-math.pi / 2, math.pi / 2, count)
    ratio[:4] = 0.0, math.pi / 2, -math.pi / 2, 1e-9
    direction = random.uniform(-math.pi, math.pi, count)
    v = major * np.cos(ratio)
    return np.stack(
        [v * np.cos(direction), v * np.sin(direction), major * np.sin(ratio) / rho], axis=-1
    )


@each_body
def test_the_table_agrees_with_the_integration(body: Polygon, factor: float) -> None:
    exact = Sliding(body, MU, factor, G)
    twist = launches(body, 100, LARGEST_SIZE)
    true, tabulated = exact.displace(twist), exact.tabulated().displace(twist)
    scale = np.array([1.0, 1.0, body.radius_of_gyration])
    size = np.linalg.norm(true * scale, axis=1)
    error = np.linalg.norm((tabulated - true) * scale, axis=1) / size
    assert error.max() < 1.5e-3 and np.percentile(error, 95) < 1e-3
    direction = np.arctan2(twist[:, 1], twist[:, 0])
    speed = np.hypot(twist[:, 0], twist[:, 1])
    # Each component relative to itself, for launches that a tap can cause.
    tapped = np.abs(twist[:, 2]) * body.support_radius <= speed
    place = np.linalg.norm((tabulated - true)[:, :2], axis=1) / np.hypot(true[:, 0], true[:, 1])
    turns = tapped & (np.abs(true[:, 2]) * scale[2] > 0.05 * np.hypot(true[:, 0], true[:, 1]))
    turned = np.abs(tabulated[turns, 2] / true[turns, 2] - 1.0)
    for component in (place[tapped], turned):
        assert np.median(component) < 1e-3 and component.max() < 1e-2
    rest = exact.rest(speed, twist[:, 2], direction)
    assert exact.tabulated().rest(speed, twist[:, 2], direction).duration == pytest.approx(
        rest.duration, rel=1e-2
    )


def test_the_inverse_is_exact_and_nothing_moves_without_a_launch() -> None:
    table = Sliding(TRIANGLE, MU, 2.0, G).tabulated()
    twist = launches(TRIANGLE, 200, 2.0)[4:]
    assert table.twist_for(table.displace(twist)) == pytest.approx(twist, rel=1e-7, abs=1e-9)
    assert np.all(table.displace(np.zeros((2, 3))) == 0.0)


def test_a_discontinuity_of_the_slide_does_not_stop_the_inverse() -> None:
    """Slides outside the table are integrated. The number of integration steps changes with the
    initial motion, and the computed slide may jump at each change."""

    def jumping(z: np.ndarray, _: np.ndarray) -> np.ndarray:
        return z * (1.0 + 1e-4 * (z > 0.5))

    target, scale = np.full((3, 1), 0.50002), np.ones((3, 1))
    assert invert(jumping, target, scale, 1e-7, 1e-3) == pytest.approx(target, rel=2e-4)
    with pytest.raises(MechanicsError, match="was not found"):
        invert(jumping, target, scale, 1e-7, 1e-7)


@each_body
def test_a_launch_beyond_the_tabulated_range_slides_into_it(body: Polygon, factor: float) -> None:
    exact = Sliding(body, MU, factor, G)
    twist = launches(body, 100, 2 * LARGEST_SIZE)
    rho = body.radius_of_gyration
    size = (twist[:, :2] ** 2).sum(axis=1) + (rho * twist[:, 2]) ** 2
    beyond = size > LARGEST_SIZE * MU * G * rho
    assert 10 < beyond.sum() < 90
    true, tabulated = exact.displace(twist), exact.tabulated().displace(twist)
    scale = np.array([1.0, 1.0, rho])
    error = np.linalg.norm((tabulated - true) * scale, axis=1) / np.linalg.norm(
        true * scale, axis=1
    )
    assert error.max() < 1.5e-3
    # The result is continuous at the limit of the tabulated range.
    edge = math.sqrt(LARGEST_SIZE * MU * G * rho) * np.array([[0.8, 0.0, 0.6 / rho]])
    below, above = (exact.tabulated().displace(edge * (1.0 + e)) for e in (-1e-9, 1e-9))
    assert above == pytest.approx(below, rel=1e-6)


def test_one_shape_has_one_table_at_every_scale_and_friction(monkeypatch):
    Sliding(SQUARE, MU, 1.0, G).tabulated()
    larger = replace(SQUARE, vertices=tuple((2 * x, 2 * y) for x, y in SQUARE.vertices))
    monkeypatch.setattr(polygon_table, "PolygonTable", lambda *_: pytest.fail("a second table"))
    slow = Sliding(larger, 3 * MU, 1.0, G).tabulated()
    launch = [0.2, 0.1, 1.0]
    assert slow.displace(launch) == pytest.approx(
        Sliding(larger, 3 * MU, 1.0, G).displace(launch), rel=2e-3
    )


def test_a_round_body_needs_no_additional_table() -> None:
    disk = Sliding(Disk(0.04, 0.2, 0.01), MU)
    assert disk.tabulated() is disk


def test_symmetries_are_found() -> None:
    angles = np.arange(6) * math.pi / 3
    hexagon = Polygon(np.stack([np.cos(angles), np.sin(angles)], axis=1), 1.0, 1.0)
    assert [symmetry(body) for body in (SQUARE, PLANK, TRIANGLE, hexagon)] == [4, 2, 1, 6]
