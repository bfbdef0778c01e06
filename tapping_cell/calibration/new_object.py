"""Initial object file if only shape, height and appearance of the object are known."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.configuration.objects import (
    MarkerSection,
    ObjectFile,
    OutlineSection,
    ShapeSection,
)
from tapping_cell.vision.outline.shape import signed_area
from tapping_cell.vision.outline.tracing import TracedObject

FRICTION = 0.17
"""Initial friction with the table: the geometric mean of 0.05 (plastic on glass) and 0.6 (rubber
feet)."""
TORQUE_FACTOR = 1.8
"""Initial torque factor: the geometric mean of 0.8 (weight near the centre) and 4.0 (weight at the
rim). The largest value in the paper is 3.64."""
RESTITUTION, CONTACT_FRICTION = 0.6, 0.2
"""Initial values, for a hard tip on plastic or soft metal. When the object is learnt from taps, the
fitted friction compensates for errors of these values."""
DENSITY = 1500.0
"""Density in kg/m^3, between wood and aluminium, for objects of unknown mass. A wrong mass gives a
wrong launch speed. When the object is learnt from taps, the fitted friction also compensates for
this error."""


def new_object(
    name: str,
    shape: ShapeSection,
    height: float,
    marker: MarkerSection | None,
    outline: OutlineSection | None,
    mass: float | None = None,
) -> ObjectFile:
    """Create an object file with typical values; lengths in m, mass in kg.

    Raises:
        ValueError: the body is impossible, or its pose cannot be detected.
    """
    weight = mass if mass is not None else max(0.001, DENSITY * height * _area(shape))
    made = ObjectFile(
        name=name,
        shape=shape,
        mass=float(f"{weight:.3g}"),
        height=height,
        friction=FRICTION,
        torque_factor=TORQUE_FACTOR,
        restitution=RESTITUTION,
        contact_friction=CONTACT_FRICTION,
        marker=marker,
        outline=outline,
    )
    made.body()
    made.seen()
    return made


def traced_shape(traced: TracedObject) -> ShapeSection:
    """Return the shape traced in an image, rounded to a hundredth of a millimetre."""
    if traced.radius is not None:
        return ShapeSection("disk", radius=_rounded(traced.radius))
    assert traced.vertices is not None
    corners = tuple((_rounded(x), _rounded(y)) for x, y in traced.vertices)
    return ShapeSection("polygon", vertices=corners)


def traced_marker(traced: TracedObject) -> MarkerSection | None:
    """Return the marker detected on the traced object; None if there is none."""
    marker = traced.marker
    if marker is None:
        return None
    x, y, angle = marker.offset
    offset = (_rounded(x), _rounded(y), angle)
    return MarkerSection(marker.dictionary, marker.id, _rounded(marker.size), offset)


def traced_outline(traced: TracedObject) -> OutlineSection | None:
    """Return the appearance of a traced object without a marker; None if it has a marker."""
    if traced.marker is not None:
        return None
    return OutlineSection("brighter" if traced.brighter else "darker")


def _area(shape: ShapeSection) -> float:
    """Compute the area of the top in m^2."""
    if shape.vertices is None:
        assert shape.radius is not None
        return math.pi * shape.radius**2
    return abs(signed_area(np.array(shape.vertices)))


def _rounded(length: float) -> float:
    return round(length, 5)
