"""Shape of the arm, to compute what the arm hides from the camera: round bars along links, quill
and tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.hardware.scara import ScaraGeometry
from tapping_cell.se2 import unit_vectors

Array = NDArray[np.float64]

QUILL_RADIUS = 0.012
"""Radius of the quill, m. Callers add a margin to all bars, so a slightly thicker quill is also
covered."""


@dataclass(frozen=True, slots=True)
class ArmShape:
    """Dimensions of the arm that its kinematics do not contain, m."""

    link_half_width: float = 0.03
    link_thickness: float = 0.04
    link_clearance: float = 0.03
    """Height of the links' undersides above the tip when the quill is at zero."""
    tool_half_width: float = 0.009
    tool_length: float = 0.12
    """Length of the tool from the tip backwards along the line of travel."""


@dataclass(frozen=True, slots=True, eq=False)
class Bars:
    """K round bars that represent the arm, at each of N arm poses: ``start`` and ``end`` (N, K, 3)
    and ``radius`` (K,), in m."""

    start: Array
    end: Array
    radius: Array


def arm_bars(geometry: ScaraGeometry, shape: ArmShape, joints: ArrayLike) -> Bars:
    """Return the bars, in ``arm_base``, that represent the arm at joint values (N, 4).

    Each link consists of several bars, stacked over its thickness.
    """
    given = np.asarray(joints, dtype=float)
    q = given + geometry.joint_offset
    reach = q[:, 0] + q[:, 1]
    shoulder = np.zeros((len(q), 2))
    elbow = geometry.upper_arm * unit_vectors(q[:, 0])
    wrist = elbow + geometry.forearm * unit_vectors(reach)
    tip = geometry.forward_many(given)
    back = tip[:, :2] - shape.tool_length * unit_vectors(tip[:, 3])
    low = geometry.tip_height + shape.link_clearance
    levels = np.linspace(low, low + shape.link_thickness, _levels(shape))
    bars = [
        (_at(first, level), _at(second, level), shape.link_half_width)
        for first, second in ((shoulder, elbow), (elbow, wrist))
        for level in levels
    ]
    bars.append((_at(wrist, tip[:, 2]), _at(wrist, low), QUILL_RADIUS))
    bars.append((_at(tip[:, :2], tip[:, 2]), _at(back, tip[:, 2]), shape.tool_half_width))
    starts, ends, radii = zip(*bars, strict=True)
    return Bars(np.stack(starts, axis=1), np.stack(ends, axis=1), np.array(radii))


def _levels(shape: ArmShape) -> int:
    """Return how many bars to stack over the thickness of a link, so that their spacing is at most
    half the link's width."""
    return 2 + int(shape.link_thickness / shape.link_half_width)


def _at(place: Array, height: ArrayLike) -> Array:
    """Return the points (N, 2) with ``height`` as third coordinate, (N, 3). ``height``: one value
    for all points, or (N,)."""
    z = np.broadcast_to(np.asarray(height, dtype=float), (len(place),))
    return np.concatenate([place, z[:, None]], axis=1)
