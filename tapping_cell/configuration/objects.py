"""The object file: shape, support, impact, scatter of a tap and marker of one object."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

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
from tapping_cell.vision import ObjectMarker

GRAVITY = 9.81
"""Standard acceleration of gravity in m/s^2, to the digits that the friction is known."""


@dataclass(frozen=True, slots=True)
class ShapeSection:
    """Outline of the object in its own frame, whose origin is the centre of mass."""

    kind: str = choice("outline of the object", "disk", "ring", "polygon")
    radius: float | None = quantity("outer radius of a disk or ring", "m", 0.002, 0.5, default=None)
    vertices: tuple[tuple[float, float], ...] | None = quantity(
        "corners of a convex polygon, counter-clockwise", "m", -0.5, 0.5, default=None
    )

    def __post_init__(self) -> None:
        needed = "vertices" if self.kind == "polygon" else "radius"
        surplus = "radius" if needed == "vertices" else "vertices"
        if getattr(self, needed) is None:
            raise ValueError(f"a {self.kind} needs the key 'shape.{needed}'")
        if getattr(self, surplus) is not None:
            raise ValueError(f"a {self.kind} takes no key 'shape.{surplus}'")


@dataclass(frozen=True, slots=True)
class MarkerSection:
    """The marker on the object's top."""

    dictionary: str = text("OpenCV name of the marker dictionary, such as APRILTAG_36h11")
    id: int = quantity("number of the marker in its dictionary", "", 0, 1_000_000)
    size: float = quantity("side of the marker's black square", "m", 0.005, 0.5)
    offset: tuple[float, float, float] = quantity(
        "x and y in m and angle in rad of the marker in the object's frame",
        "",
        -7.0,
        7.0,
        default=(0.0, 0.0, 0.0),
    )


@dataclass(frozen=True, slots=True)
class ScatterSection:
    """One standard deviation of a tap's result, as the planner expects it."""

    distance: float = quantity("of the distance, relative to it", "", 0.0, 0.5, default=0.05)
    rotation: float = quantity("of the rotation, relative to it", "", 0.0, 1.0, default=0.15)
    direction: float = quantity("of the direction", "rad", 0.0, 0.5, default=math.radians(1.0))


@dataclass(frozen=True, slots=True)
class ObjectFile:
    """What the planner and the camera know about one object."""

    name: str = text("name of the object, for people")
    shape: ShapeSection = section("outline of the object")
    mass: float = quantity("mass", "kg", 0.001, 100.0)
    height: float = quantity("height of the top above the table", "m", 0.0005, 0.5)
    friction: float = quantity("coefficient of friction with the table", "", 0.01, 2.0)
    torque_factor: float = quantity(
        "factor of the friction torque (the paper's scaling factor)", "", 0.05, 20.0
    )
    restitution: float = quantity("coefficient of restitution with the striker", "", 0.0, 1.0)
    contact_friction: float = quantity("coefficient of friction with the striker", "", 0.001, 2.0)
    marker: MarkerSection = section("marker on the top")
    impact_scale: tuple[float, float, float] = quantity(
        "calibrated factors of the impact constants B1, B2, B3",
        "",
        0.01,
        100.0,
        default=(1.0, 1.0, 1.0),
    )
    smallest_tap: float = quantity(
        "smallest distance that the tapper makes reliably", "m", 0.0001, 0.1, default=0.0017
    )
    scatter: ScatterSection = section("scatter of a tap", default=ScatterSection())
    calibration: Provenance | None = section(
        "where fitted values come from (written by fit)", default=None
    )

    def body(self) -> Disk | Ring | Polygon:
        """The body of the mechanics."""
        shape = self.shape
        if shape.vertices is not None:
            return Polygon(shape.vertices, mass=self.mass, height=self.height)
        assert shape.radius is not None
        kind = Disk if shape.kind == "disk" else Ring
        return kind(radius=shape.radius, mass=self.mass, height=self.height)

    def tap(self, striker: Striker) -> Tap:
        """How this object answers a tap of that striker."""
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

    def object_marker(self) -> ObjectMarker:
        """The marker as the camera looks for it."""
        return ObjectMarker(
            dictionary=self.marker.dictionary,
            id=self.marker.id,
            size=self.marker.size,
            offset=self.marker.offset,
            height=self.height,
        )


def load_object(path: Path | str) -> ObjectFile:
    """An object file; its body is built once so that an impossible shape is refused here.

    Raises:
        ConfigurationError: names file, key, value and range.
    """
    content = load(ObjectFile, path)
    try:
        content.body()
    except ValueError as error:
        raise ConfigurationError(f"{path}: key 'shape': {error}") from error
    return content
