"""SVG drawing of a plan of the table, in mm with y upwards."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.report.palette import INK, LINE, MUTED, STRIKE, TABLE
from tapping_cell.se2 import Array, Pose, transform_points

MOUNT_MM = np.array(
    [[0.0, 3.0], [-4.0, 8.0], [-20.0, 8.0], [-20.0, -8.0], [-4.0, -8.0], [0.0, -3.0]]
)
"""Outline of a fixed tapper in its own frame, mm: a symbol, not a part."""
NAME_BEHIND_MM = 32.0
"""Distance from a fixed tapper's tip back to its name, mm."""
_ELLIPSE_95 = math.sqrt(-2.0 * math.log(0.05))
"""Radius of the 95 % region of a bivariate normal distribution, in standard deviations."""


@dataclass
class Plan:
    """A plan view of the table with opposite corners ``low`` and ``high`` in mm."""

    low: tuple[float, float]
    high: tuple[float, float]

    def __post_init__(self) -> None:
        self._parts: list[str] = []
        self._numbered: list[Array] = []
        """Places of the numbers of strikes, mm."""
        self.width = self.high[0] - self.low[0]
        self.height = self.high[1] - self.low[1]
        self.unit = max(self.width, self.height) / 100
        """A hundredth of the drawing's larger side, in mm. Line widths and font sizes are multiples
        of this length."""

    def table(self, half: ArrayLike) -> None:
        """Draw the table from its half lengths along x and y, in mm."""
        x, y = np.asarray(half)
        corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
        self.polygon(corners, f'fill="{TABLE}" stroke="{LINE}" stroke-width="1"')

    def polygon(self, points: ArrayLike, style: str, closed: bool = True) -> None:
        """Draw a polygon or, if not closed, a polyline through points in mm."""
        places = " ".join(f"{x:.2f},{-y:.2f}" for x, y in np.asarray(points).reshape(-1, 2))
        self._parts.append(f'<poly{"gon" if closed else "line"} points="{places}" {style}/>')

    def circle(self, x: float, y: float, radius: float, style: str) -> None:
        """Draw a circle; all values in mm."""
        self._parts.append(f'<circle cx="{x:.2f}" cy="{-y:.2f}" r="{radius:.3f}" {style}/>')

    def text(self, x: float, y: float, content: str, colour: str, size: float = 3.2) -> None:
        """Draw text centred at a point in mm. ``size`` is a multiple of ``unit``."""
        self._parts.append(
            f'<text x="{x:.2f}" y="{-y:.2f}" font-size="{size * self.unit:.2f}" fill="{colour}" '
            f'text-anchor="middle" dominant-baseline="central">{escape(content)}</text>'
        )

    def arrow(self, tail: ArrayLike, head: ArrayLike, colour: str, width: float = 0.7) -> None:
        """Draw an arrow between points in mm. ``width`` is a multiple of ``unit``."""
        start, end = np.asarray(tail, dtype=float), np.asarray(head, dtype=float)
        length = float(np.hypot(*(end - start)))
        if length < 1e-6:
            return
        along = (end - start) / length
        point = min(length, 5 * width * self.unit)
        aside = np.array([-along[1], along[0]]) * point * 0.45
        neck = end - along * point
        self.polygon([start, neck], stroke(colour, width * self.unit), closed=False)
        self.polygon([end, neck + aside, neck - aside], f'fill="{colour}"')

    def strike(self, strike: Pose, number: int, length: float, width: float) -> None:
        """Draw the arrow of a tap with its number behind it. ``length`` is in mm, and ``width`` is
        a multiple of ``unit``."""
        along = np.array([math.cos(strike.theta), math.sin(strike.theta)])
        tip = 1000 * np.array([strike.x, strike.y])
        self.arrow(tip - length * along, tip, STRIKE, width)
        place = tip - (length + 3 * self.unit) * along
        while any(np.hypot(*(place - other)) < 4 * self.unit for other in self._numbered):
            place = place - self.unit * along
        self._numbered.append(place)
        x, y = place.tolist()
        self.text(x, y, str(number), STRIKE, 3.6)

    def mount(self, name: str, tip: Pose) -> None:
        """Draw a fixed tapper, whose striker travels along the x axis of ``tip``, and its name."""
        body = transform_points(tip, MOUNT_MM / 1000)
        self.polygon(1000 * body, f'fill="{LINE}" stroke="{MUTED}" stroke-width="1"')
        x, y = (1000 * transform_points(tip, [[-NAME_BEHIND_MM / 1000, 0.0]])[0]).tolist()
        self.text(x, y, name, INK, 2.2)

    def outline(
        self, outline: Array, pose: Pose, colour: str, dashed: bool = False, fill: float = 0.0
    ) -> None:
        """Draw the object at a pose, with a line from its centre to the rim along its x axis."""
        if not len(outline):
            self.circle(1000 * pose.x, 1000 * pose.y, self.unit, f'fill="{colour}"')
            return
        points = 1000 * transform_points(pose, outline)
        reach = float(np.max(np.hypot(*outline.T)))
        style = stroke(colour, 0.55 * self.unit, dashed)
        if fill:
            self.polygon(points, f'fill="{colour}" fill-opacity="{fill}"')
        self.polygon(points, style)
        self.polygon(1000 * transform_points(pose, [[0.0, 0.0], [reach, 0.0]]), style, closed=False)

    def ellipse(self, covariance: ArrayLike, pose: Pose, colour: str) -> None:
        """Draw the 95 % ellipse of a covariance (2, 2) in m^2 about a pose's position."""
        values, axes = np.linalg.eigh(np.asarray(covariance, dtype=float))
        radii = 1000 * _ELLIPSE_95 * np.sqrt(np.maximum(values, 0.0))
        around = np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)
        circle = np.column_stack([radii[0] * np.cos(around), radii[1] * np.sin(around)])
        points = 1000 * np.array([pose.x, pose.y]) + circle @ axes.T
        self.polygon(points, f'fill="{colour}" fill-opacity="0.25"')
        self.polygon(points, stroke(colour, 0.35 * self.unit))

    def axes(self) -> None:
        """Draw tick marks of the table's x and y in mm, along the lower and the left edge."""
        step = round_length(max(self.width, self.height) / 5)
        mark, low = 1.4 * self.unit, np.asarray(self.low, dtype=float)
        line = stroke(MUTED, 0.25 * self.unit)
        for index in range(math.ceil(low[0] / step), math.floor(self.high[0] / step) + 1):
            x = step * index
            self.polygon([(x, low[1]), (x, low[1] + mark)], line, closed=False)
            if low[0] + 6 * self.unit < x < self.high[0] - 9 * self.unit:
                self.text(x, low[1] + 2.6 * self.unit, f"{x:g}", MUTED, 2.0)
        for index in range(math.ceil(low[1] / step), math.floor(self.high[1] / step) + 1):
            y = step * index
            self.polygon([(low[0], y), (low[0] + mark, y)], line, closed=False)
            if low[1] + 6 * self.unit < y < self.high[1] - 4 * self.unit:
                # Keep a distance from the tick mark, so that the mark does not look like a minus
                # sign.
                self.text(low[0] + 5.2 * self.unit, y, f"{y:g}", MUTED, 2.0)
        self.text(self.high[0] - 4 * self.unit, low[1] + 2.6 * self.unit, "x mm", MUTED, 2.0)
        self.text(low[0] + 5.2 * self.unit, self.high[1] - 2.2 * self.unit, "y mm", MUTED, 2.0)

    @contextmanager
    def group(self, attributes: str) -> Iterator[None]:
        """Put everything that is drawn in this context into one group."""
        self._parts.append(f"<g {attributes}>")
        yield
        self._parts.append("</g>")

    def scale_bar(self) -> None:
        """Draw a scale bar of a round length in the lower left corner."""
        length = round_length(self.width / 4)
        x, y = self.low[0] + 9 * self.unit, self.low[1] + 6 * self.unit
        self.polygon([(x, y), (x + length, y)], stroke(INK, 0.6 * self.unit), closed=False)
        self.text(x + length / 2, y + 2.6 * self.unit, f"{length:g} mm", INK, 2.8)

    def drawing(self, title: str) -> str:
        """Return the SVG element."""
        box = f"{self.low[0]:.2f} {-self.high[1]:.2f} {self.width:.2f} {self.height:.2f}"
        return (
            f'<svg class="plan" viewBox="{box}" role="img" aria-label="{escape(title)}">'
            f"<title>{escape(title)}</title>{''.join(self._parts)}</svg>"
        )


def stroke(colour: str, width: float, dashed: bool = False) -> str:
    """Return the SVG attributes of a line. ``width`` is in the units of the SVG's coordinates."""
    dash = f' stroke-dasharray="{3 * width:.2f} {2 * width:.2f}"' if dashed else ""
    return (
        f'fill="none" stroke="{colour}" stroke-width="{width:.3f}" stroke-linejoin="round"'
        f' stroke-linecap="round"{dash}'
    )


def window(points: ArrayLike, margin: float, least: float) -> tuple[Array, Array]:
    """Return two opposite corners of a square that encloses the points with a margin. Its side is
    at least ``least``; all lengths are in mm."""
    places = np.asarray(points, dtype=float).reshape(-1, 2)
    if not len(places):
        places = np.zeros((1, 2))
    low, high = places.min(axis=0), places.max(axis=0)
    half = max(float(np.max(high - low)) / 2 + margin, least / 2)
    middle = (low + high) / 2
    return middle - half, middle + half


def round_length(length: float) -> float:
    """Return the largest number of the form 1, 2 or 5 times a power of ten that is at most
    ``length``."""
    power = 10.0 ** math.floor(math.log10(max(length, 1e-9)))
    return next(factor * power for factor in (5.0, 2.0, 1.0) if factor * power <= length * 1.0001)
