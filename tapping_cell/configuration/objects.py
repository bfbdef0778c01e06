"""The object file: shape, friction, impact, scatter of a tap and appearance of one object."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tapping_cell.configuration.provenance import Provenance
from tapping_cell.configuration.schema import (
    ConfigurationError,
    choice,
    load,
    quantity,
    section,
    text,
)
from tapping_cell.mechanics import Disk, Impact, Polygon, Ring, Sliding, Striker, Tap
from tapping_cell.vision import Dot, ObjectMarker, ObjectOutline
from tapping_cell.vision.outline.shape import centroid, signed_area

GRAVITY = 9.81
"""Standard acceleration of gravity in m/s^2, rounded because the coefficients of friction are less
accurate."""

ROUND_POINTS = 72
"""Number of points of a round outline."""


@dataclass(frozen=True, slots=True)
class ShapeSection:
    """Outline of the object in the object frame, whose origin is the centre of mass."""

    kind: str = choice(
        "type of the outline; a square or rectangle is a polygon", "disk", "ring", "polygon"
    )
    radius: float | None = quantity("outer radius of a disk or ring", "m", 0.002, 0.5, default=None)
    vertices: tuple[tuple[float, float], ...] | None = quantity(
        "corners of a convex polygon, in their order along the outline",
        "m",
        -0.5,
        0.5,
        default=None,
    )

    def __post_init__(self) -> None:
        needed = "vertices" if self.kind == "polygon" else "radius"
        surplus = "radius" if needed == "vertices" else "vertices"
        if getattr(self, needed) is None:
            raise ValueError(f"a {self.kind} needs the key 'shape.{needed}'")
        if getattr(self, surplus) is not None:
            raise ValueError(
                f"the key 'shape.{surplus}' does not apply to a {self.kind}; remove it"
            )
        if self.vertices and signed_area(np.array(self.vertices)) < 0.0:
            object.__setattr__(self, "vertices", self.vertices[::-1])

    def reach(self) -> float:
        """Return the largest distance of the outline from the object's origin, m."""
        if self.vertices is not None:
            return max(math.hypot(x, y) for x, y in self.vertices)
        assert self.radius is not None
        return self.radius

    def outline(self) -> tuple[tuple[float, float], ...]:
        """Return the outline in the object frame: points (x, y) in m, counter-clockwise."""
        if self.vertices is not None:
            return self.vertices
        assert self.radius is not None
        angles = [2.0 * math.pi * number / ROUND_POINTS for number in range(ROUND_POINTS)]
        return tuple((self.radius * math.cos(a), self.radius * math.sin(a)) for a in angles)


@dataclass(frozen=True, slots=True)
class MarkerSection:
    """The marker on the object's top."""

    dictionary: str = text(
        "OpenCV name of the marker dictionary, with or without the prefix DICT_, such as "
        "APRILTAG_36h11"
    )
    id: int = quantity("number of the marker in its dictionary", "", 0, 1_000_000)
    size: float = quantity("side of the marker's black square", "m", 0.005, 0.5)
    offset: tuple[float, float, float] = quantity(
        "pose of the marker in the object's frame: x and y in m, angle in rad",
        "m, m, rad",
        -7.0,
        7.0,
        default=(0.0, 0.0, 0.0),
    )


@dataclass(frozen=True, slots=True)
class DotSection:
    """A round dot on the top of an object without a marker."""

    radius: float = quantity("radius of the dot", "m", 0.002, 0.2)
    offset: tuple[float, float] = quantity(
        "centre of the dot in the object's frame: x, y", "m", -0.5, 0.5
    )
    shade: str = choice(
        "whether the dot is darker or brighter than the rest of the top", "darker", "brighter"
    )


@dataclass(frozen=True, slots=True)
class OutlineSection:
    """Appearance of an object without a marker, detected by its outline."""

    shade: str = choice(
        "whether the object's top is darker or brighter than the table", "darker", "brighter"
    )
    dot: DotSection | None = section(
        "dot that is not at the centre of the top; required if the outline does not "
        "determine the angle, as for a disk or a square",
        default=None,
    )


LIGHTEST, HEAVIEST = 200.0, 23_000.0
"""Limits of an object's density, kg/m^3: light wood, and more than tungsten or gold."""
MATERIALS = {
    "alumin": 2700.0,
    "steel": 7850.0,
    "brass": 8500.0,
    "copper": 8960.0,
    "plexiglas": 1190.0,
    "acrylic": 1190.0,
}
"""Density, kg/m^3, of materials by a part of their names."""
_SLIPS = {
    0.25: "the radius may be a diameter, or the corners twice too far from the centre",
    4.0: "the radius may be half the true one, or the corners twice too near to the centre",
    0.1: "mass or height may be wrong by a factor of 10",
    10.0: "mass or height may be wrong by a factor of 10",
}
"""Common mistakes, by the ratio of the resulting density to the true one."""


def area_of(shape: ShapeSection) -> float:
    """Return the area of the outline, m^2."""
    if shape.radius is not None:
        return math.pi * shape.radius**2
    points = shape.vertices or ()
    turned = (*points[1:], *points[:1])
    return 0.5 * abs(sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(points, turned, strict=True)))


MOST_OFF_CENTRE = 0.03
"""Maximum distance of a polygon's centre from the origin, as a fraction of the square root of its
area: the error of a measured outline."""
OVERLAP = 0.001
"""Distance, m, by which a corner of the marker may extend beyond the outline: the error of a
measured outline."""


def _check_marker(shape: ShapeSection, marker: MarkerSection) -> None:
    """Raise ValueError if the marker extends beyond the object's outline."""
    x, y, theta = marker.offset
    half = 0.5 * marker.size
    cos, sin = math.cos(theta), math.sin(theta)
    for a, b in ((half, half), (-half, half), (-half, -half), (half, -half)):
        corner = (x + cos * a - sin * b, y + sin * a + cos * b)
        beyond = _beyond(shape, corner)
        if beyond > OVERLAP:
            raise ValueError(
                f"the marker of {1e3 * marker.size:.1f} mm at {1e3 * math.hypot(x, y):.1f} mm from "
                f"the centre extends beyond the object's outline by {1e3 * beyond:.1f} mm; correct "
                "'marker.size' (m, side of the black square), 'marker.offset' or 'shape' (radius, "
                "not diameter), or use a smaller marker"
            )


def _check_centre(shape: ShapeSection) -> None:
    """Raise ValueError if the origin is not the centre of a polygon."""
    if shape.vertices is None:
        return
    x, y = centroid(np.array(shape.vertices)).tolist()
    if math.hypot(x, y) > MOST_OFF_CENTRE * math.sqrt(area_of(shape)):
        raise ValueError(
            f"the centre of the polygon is at ({1e3 * x:.1f} mm, {1e3 * y:.1f} mm), but must be "
            f"the origin; subtract [{x:.5g}, {y:.5g}] from each vertex"
        )


def _beyond(shape: ShapeSection, point: tuple[float, float]) -> float:
    """Return the distance, m, of a point from a convex outline; negative or 0 inside."""
    if shape.radius is not None:
        return math.hypot(*point) - shape.radius
    outline = np.array(shape.vertices, dtype=np.float32)
    if len(outline) < 3:
        return 0.0  # reported for the shape
    return -cv2.pointPolygonTest(outline, point, measureDist=True)


def seen_as(
    shape: ShapeSection,
    height: float,
    marker: MarkerSection | None,
    outline: OutlineSection | None,
    height_tolerance: float,
) -> ObjectMarker | ObjectOutline:
    """Return the feature that the camera detects: the marker or the outline.

    Raises:
        ValueError: both or neither of marker and outline are given, or the feature cannot be
            detected.
    """
    if (marker is None) == (outline is None):
        raise ValueError(
            "give either the key 'marker' (a printed marker on the top) or the key 'outline' (an "
            "object without a marker, detected by its shape)"
        )
    if marker is not None:
        _check_marker(shape, marker)
        return ObjectMarker(
            marker.dictionary, marker.id, marker.size, height, marker.offset, height_tolerance
        )
    assert outline is not None
    dot = None
    if outline.dot is not None:
        spot = outline.dot
        dot = Dot(spot.radius, spot.offset, spot.shade == "brighter")
    brighter = outline.shade == "brighter"
    return ObjectOutline(height, brighter, shape.radius, shape.vertices, dot, height_tolerance)


def height_tolerance_key() -> Any:
    """Declare the key ``height_tolerance`` of an object."""
    return quantity(
        "standard deviation of the height of the top above the table, as an object on a crumb or "
        "on an uneven table has; included in the covariance of the measured pose",
        "m",
        0.0,
        0.01,
        default=0.0,
    )


def position_floor_key() -> Any:
    """Declare the key ``position_floor`` of the scatter of a tap."""
    return quantity(
        "standard deviation of the object's final position, along and across the tap, for very "
        "small taps; added in quadrature to the part that grows with the size of the tap",
        "m",
        0.0,
        0.05,
        default=0.0,
    )


def angle_floor_key() -> Any:
    """Declare the key ``angle_floor`` of the scatter of a tap."""
    return quantity(
        "standard deviation of the rotation by a tap for very small rotations; added in "
        "quadrature to the part that grows with the rotation",
        "rad",
        0.0,
        0.5,
        default=0.0,
    )


@dataclass(frozen=True, slots=True)
class ScatterSection:
    """Standard deviations that the planner assumes for the result of a tap."""

    distance: float = quantity(
        "standard deviation of the tap distance, as a fraction of that distance",
        "",
        0.0,
        0.5,
        default=0.05,
    )
    rotation: float = quantity(
        "standard deviation of the rotation by a tap, as a fraction of that rotation",
        "",
        0.0,
        1.0,
        default=0.15,
    )
    direction: float = quantity(
        "standard deviation of the direction in which a tap moves the object",
        "rad",
        0.0,
        0.3,
        default=math.radians(1.0),
    )
    position_floor: float = position_floor_key()
    angle_floor: float = angle_floor_key()


@dataclass(frozen=True, slots=True)
class ObjectFile:
    """Contents of an object file: the properties of one object."""

    name: str = text("display name of the object", longest=100)
    shape: ShapeSection = section("outline of the object")
    mass: float = quantity("mass of the object", "kg", 0.001, 100.0)
    height: float = quantity("height of the top above the table", "m", 0.0005, 0.5)
    friction: float = quantity(
        "coefficient of friction with the table (tangent of the friction angle)", "", 0.01, 2.0
    )
    torque_factor: float = quantity(
        "factor by which the torque of the friction with the table is scaled (Huang and Mason)",
        "",
        0.05,
        20.0,
    )
    restitution: float = quantity(
        "coefficient of restitution of the impact between striker and object", "", 0.0, 1.0
    )
    contact_friction: float = quantity("coefficient of friction with the striker", "", 0.001, 2.0)
    marker: MarkerSection | None = section("marker on the top", default=None)
    outline: OutlineSection | None = section(
        "appearance of an object without a marker", default=None
    )
    impact_scale: tuple[float, float, float] = quantity(
        "calibrated factors by which the constants B1, B2 and B3 of the impact model are "
        "multiplied",
        "",
        0.01,
        100.0,
        default=(1.0, 1.0, 1.0),
    )
    height_tolerance: float = height_tolerance_key()
    smallest_tap: float = quantity(
        "shortest distance by which a tap moves this object reliably",
        "m",
        0.0001,
        0.1,
        default=0.0017,
    )
    scatter: ScatterSection = section("scatter of a tap", default=ScatterSection())
    calibration: Provenance | None = section(
        "record of the fit, written by `object fit`", default=None
    )

    def __post_init__(self) -> None:
        """Raise ValueError if mass and dimensions give an impossible density."""
        area = area_of(self.shape)
        if not area > 0.0:
            return  # reported for the shape
        density = self.mass / (area * self.height)
        lightest = 0.0 if self.shape.kind == "ring" else LIGHTEST
        figures = (
            f"mass {self.mass:g} kg, height {self.height:g} m and the area of the shape "
            f"({1e4 * area:.4g} cm2) give a density of {density:.0f} kg/m3"
        )
        if not lightest <= density <= HEAVIEST:
            raise ValueError(
                f"{figures}, outside {LIGHTEST:.0f} to {HEAVIEST:.0f} kg/m3; check their units "
                "(kg, m) and that 'radius' is not a diameter"
            )
        for word, usual in MATERIALS.items():
            for ratio, cause in _SLIPS.items():
                if word in self.name.lower() and abs(density / usual / ratio - 1.0) < 0.15:
                    named = re.findall(rf"\w*{word}\w*", self.name, re.IGNORECASE)[0]
                    raise ValueError(
                        f"{figures}, but the name says '{named}' ({usual:.0f} kg/m3): {cause}"
                    )

    def check_impact(self, striker: Striker) -> None:
        """Raise ValueError if a central impact would give the object more energy than the striker
        has."""
        impact = self.tap(striker).impact
        rim = impact.body.boundary(np.linspace(0.0, math.tau, 721))
        near = float(np.linalg.norm(rim, axis=-1).min())
        speed = impact.strike(1.0, 0.0, np.array([-near, 0.0])).velocity
        ratio = self.mass * float(np.sum(np.square(speed))) / striker.mass
        if ratio > 1.05:
            raise ValueError(
                f"'{self.name}': a central impact would give the object {ratio:.2f} times the "
                f"energy of the striker of {striker.mass:g} kg; check 'mass', 'restitution' and "
                "'impact_scale' of the object, and 'tapper.mass'"
            )

    def body(self) -> Disk | Ring | Polygon:
        """Return the body of the mechanical model."""
        shape = self.shape
        if shape.vertices is not None:
            return Polygon(shape.vertices, mass=self.mass, height=self.height)
        assert shape.radius is not None
        kind = Disk if shape.kind == "disk" else Ring
        return kind(radius=shape.radius, mass=self.mass, height=self.height)

    def tap(self, striker: Striker) -> Tap:
        """Return the model of taps on this object by the given striker."""
        body = self.body()
        return Tap(
            sliding=Sliding(
                body,
                friction=self.friction,
                torque_factor=self.torque_factor,
                gravity=GRAVITY,
            ),
            impact=Impact(
                body,
                striker,
                restitution=self.restitution,
                friction=self.contact_friction,
                scale=self.impact_scale,
            ),
            smallest_distance=self.smallest_tap,
        )

    def seen(self) -> ObjectMarker | ObjectOutline:
        """Return the feature that the camera detects: the marker or the outline.

        Raises:
            ValueError: both or neither of marker and outline are given, or the feature cannot be
            detected.
        """
        return seen_as(self.shape, self.height, self.marker, self.outline, self.height_tolerance)


def load_object(path: Path | str) -> ObjectFile:
    """Load an object file, and check that its body and its appearance can be constructed.

    Raises:
        ConfigurationError: the file is invalid; the message names file, key, value and range.
    """
    content = load(ObjectFile, path)
    try:
        content.body()
        _check_centre(content.shape)
    except ValueError as error:
        raise ConfigurationError(f"{path}: key 'shape': {error}") from error
    try:
        content.seen()
    except ValueError as error:
        raise ConfigurationError(f"{path}: {error}") from error
    return content
