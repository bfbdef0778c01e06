"""Appearance of the arm and of the strikers in the overhead camera's view.

The parts are flat polygons on rigid bodies: the silhouette of a solid in a dark level, and its top
face with a lit edge. All parts lie within the silhouettes of ``arm_picture``, so that the drawn arm
hides no more than those. The polygons are computed once; a picture only places the bodies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.configuration.cell import ArmSection, TapperSection
from tapping_cell.se2 import Pose, transform_points, unit_vectors
from tapping_cell.simulation.arm_picture import QUILL_RADIUS
from tapping_cell.simulation.rendered_camera import Drawing, Part

Array = NDArray[np.float64]

_TAPER = 0.72
"""Half width of a link at its far end, as a fraction of that at its near end."""
_EDGE = 0.0016
"""Width of a bevelled edge, m."""
_LIT = np.array([0.0007, -0.0007])
"""Displacement of a face inside its edge, in ``table``, m. It leaves more of the edge visible on
the side that faces the light."""
_SHADE = 0.3
"""Fraction of the light that the arm's shadow removes."""
_SIDE, _BRIGHT_EDGE, _PAINT, _DARK_EDGE, _RECESS = 62.0, 214.0, 172.0, 96.0, 150.0
_CAP, _RIM, _STEEL, _HOUSING, _BALL = 58.0, 128.0, 205.0, 44.0, 216.0
"""Grey levels."""


class _Body:
    """Polygons of one rigid body in its own frame: points (N, 2), their heights above the body's
    reference height, and their displacement in ``table`` in units of ``_LIT``."""

    def __init__(self) -> None:
        self._points: list[Array] = []
        self._heights: list[Array] = []
        self._lit: list[Array] = []
        self.parts: list[Part] = []

    def face(self, outline: ArrayLike, height: float, level: float, lit: float = 0.0) -> None:
        """Add a convex face at a height."""
        self._add(np.asarray(outline, dtype=float), (height,), lit, Part(level))

    def solid(self, outline: ArrayLike, low: float, high: float, level: float) -> None:
        """Add the silhouette of a prism, which casts a shadow."""
        self._add(np.asarray(outline, dtype=float), (low, high), 0.0, Part(level, True, _SHADE))

    def _add(self, outline: Array, heights: Sequence[float], lit: float, part: Part) -> None:
        for height in heights:
            self._points.append(outline)
            self._heights.append(np.full(len(outline), height))
            self._lit.append(np.full(len(outline), lit))
        self.parts.append(part.with_count(len(outline) * len(heights)))

    def frozen(self) -> tuple[Array, Array, Array]:
        """Return points (N, 2), heights (N,) and displacements (N, 2)."""
        lit = np.concatenate(self._lit)[:, None] * _LIT
        return np.concatenate(self._points), np.concatenate(self._heights), lit


def _placed(
    bodies: Sequence[_Body], frozen: Sequence[tuple[Array, Array, Array]], poses: Sequence[Array]
) -> Drawing:
    """Return the bodies at poses (x, y, height, theta) in ``table``."""
    points = np.empty((sum(len(each[0]) for each in frozen), 3))
    begin = 0
    for (flat, heights, lit), (x, y, height, theta) in zip(frozen, poses, strict=True):
        part = points[begin : begin + len(flat)]
        part[:, :2] = transform_points((x, y, theta), flat) + lit
        part[:, 2] = np.maximum(heights + height, 0.0)
        begin += len(flat)
    return Drawing(points, tuple(part for body in bodies for part in body.parts))


class StrikerDrawing:
    """Striker and housing of one tapper."""

    def __init__(self, tapper: TapperSection) -> None:
        self.bodies = [_striker(tapper), _housing(tapper)]
        self._frozen = [body.frozen() for body in self.bodies]

    def at(self, rest: Pose, height: float, out: float = 0.0) -> Drawing:
        """Return the drawing. ``rest``: pose of the retracted tip in ``table``; ``height`` of the
        tip and its extension ``out``, m."""
        return _placed(self.bodies, self._frozen, self.poses(rest, height, out))

    @staticmethod
    def poses(rest: Pose, height: float, out: float) -> list[Array]:
        """Return the poses of striker and housing."""
        ahead = rest @ Pose(out, 0.0, 0.0)
        return [np.array([each.x, each.y, height, each.theta]) for each in (ahead, rest)]


class ArmDrawing:
    """The arm at its true pose. ``base``: true pose of ``arm_base`` in ``table``."""

    def __init__(self, arm: ArmSection, tapper: TapperSection, base: Pose) -> None:
        self._geometry, self._base = arm.geometry(), base
        thick, self._low = arm.link_thickness, arm.tip_height + arm.link_clearance
        wide = arm.link_half_width
        self._bodies = [
            *StrikerDrawing(tapper).bodies,
            _quill(self._low),
            _link(self._geometry.forearm, wide, thick),
            _link(self._geometry.upper_arm, wide, thick),
            _caps(wide, thick, ((0.0, 0.62, _RIM), (self._geometry.forearm, 0.58, _STEEL))),
            _caps(wide, thick, ((0.0, 0.80, _RIM),)),
        ]
        self._frozen = [body.frozen() for body in self._bodies]

    def at(self, joints: ArrayLike, out: float = 0.0) -> Drawing:
        """Return the drawing at true joint values (rad, rad, m, rad), with the striker extended by
        ``out`` m."""
        q = np.asarray(joints, dtype=float)
        tip = self._geometry.forward(q)
        shoulder = self._base @ Pose(0.0, 0.0, float(q[0]))
        elbow = shoulder @ Pose(self._geometry.upper_arm, 0.0, float(q[1]))
        wrist = elbow @ Pose(self._geometry.forearm, 0.0, 0.0)
        upper, fore = (
            np.array([each.x, each.y, self._low, each.theta]) for each in (shoulder, elbow)
        )
        rod = np.array([wrist.x, wrist.y, tip.z, 0.0])
        rest = self._base @ Pose(tip.x, tip.y, tip.yaw)
        poses = [*StrikerDrawing.poses(rest, tip.z, out), rod, fore, upper, fore, upper]
        return _placed(self._bodies, self._frozen, poses)


def _link(length: float, wide: float, thick: float) -> _Body:
    """Return a tapered link along x with a recess along its middle."""
    narrow = _TAPER * wide

    def outline(inset: float) -> Array:
        angles = np.linspace(0.5 * math.pi, 1.5 * math.pi, 12)
        near = (wide - inset) * unit_vectors(angles)
        far = np.array([length, 0.0]) + (narrow - inset) * unit_vectors(angles + math.pi)
        return np.concatenate([near, far])

    def recess(inset: float) -> Array:
        a, b = 0.46 * wide - inset, 0.46 * narrow - inset
        first, last = wide + 0.022 + inset, length - narrow - 0.018 - inset
        return np.array([[first, a], [first, -a], [last, -b], [last, b]])

    body = _Body()
    body.solid(outline(0.0), 0.0, thick, _SIDE)
    body.face(outline(0.4 * _EDGE), thick, _BRIGHT_EDGE)
    body.face(outline(1.4 * _EDGE), thick, _PAINT, -1.0)
    body.face(recess(0.0), thick, _BRIGHT_EDGE, -1.5)
    body.face(recess(0.0), thick, _DARK_EDGE)
    body.face(recess(_EDGE), thick, _RECESS)
    return body


def _caps(wide: float, height: float, caps: Sequence[tuple[float, float, float]]) -> _Body:
    """Return joint covers with their screws on a link: place along the link, radius relative to the
    link's half width, and grey level of the rim."""
    body = _Body()
    for place, share, rim in caps:
        middle, radius = (place, 0.0), share * wide
        body.face(_disc(middle, 1.06 * radius), height, _DARK_EDGE, -2.0)
        body.face(_disc(middle, radius), height, rim)
        body.face(_disc(middle, 0.86 * radius), height, _CAP)
        for screw in unit_vectors(np.arange(6) * math.pi / 3.0) * 0.66 * radius + middle:
            body.face(_disc(screw, 0.09 * radius, 6), height, _RIM)
        body.face(_disc(middle, 0.30 * radius, 12), height, rim)
    return body


def _quill(low: float) -> _Body:
    """Return the quill, from the tool up to the links, whose undersides are at ``low``."""
    body = _Body()
    body.solid(_disc((0.0, 0.0), QUILL_RADIUS, 16), 0.0, 0.6 * low, _STEEL - 60.0)
    return body


def _striker(tapper: TapperSection) -> _Body:
    """Return the rod and the ball of the striker; the ball's centre is the tip."""
    radius = tapper.tip_radius
    body, ball = _Body(), (0.0, 0.0)
    body.solid(_bar(-tapper.tool_length, 0.0, 0.5 * radius), -0.5 * radius, 0.5 * radius, _STEEL)
    body.solid(_disc(ball, radius), -radius, 0.0, _BALL - 70.0)
    body.face(_disc(ball, 0.86 * radius), radius, _BALL, 0.6)
    body.face(_disc(ball, 0.35 * radius, 10), radius, 255.0, 2.0)
    return body


def _housing(tapper: TapperSection) -> _Body:
    """Return the housing behind the striker."""
    start, end, half = -tapper.tool_length, -tapper.tool_start, tapper.tool_radius
    length = end - start
    body = _Body()
    body.solid(_bar(start, end, half), -half, half, _HOUSING)
    body.face(_bar(start, end, 0.62 * half), half, 84.0)
    body.face(_bar(start, end, 0.22 * half), half, 122.0)
    for first, last in ((0.08, 0.12), (0.80, 0.86), (0.92, 0.96)):
        body.face(_bar(start + first * length, start + last * length, half), half, 30.0)
    return body


def _bar(start: float, end: float, half: float) -> Array:
    return np.array([[start, -half], [end, -half], [end, half], [start, half]])


def _disc(middle: ArrayLike, radius: float, corners: int = 20) -> Array:
    angles = np.linspace(0.0, 2.0 * math.pi, corners, endpoint=False)
    return np.asarray(np.asarray(middle, dtype=float) + radius * unit_vectors(angles))
