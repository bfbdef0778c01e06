"""A body sliding on the table, integrated in time from the friction under each point of it.

Independent of the closed forms of the mechanics room on purpose: the support pressure may be uneven
and the table tilted, which those cannot express. The support surface is sampled at points r_i with
weights w_i; each point drags with mu w_i N against its own velocity v + omega x r_i (Coulomb), and
the torque of it all is multiplied by the torque factor, the paper's empirical finding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics import Disk, Polygon, Ring

Array = NDArray[np.float64]

STEP_S = 0.0005
"""Step of the integration. At 2 m/s^2 of friction a step changes the speed by 1 mm/s."""
LARGEST_LOSS = 0.2
"""A step ends where friction would take this share of the speed: near rest the direction of the
friction turns fast, and a longer step would swing to and fro across rest."""
STOP_SPEED = 0.0005
"""Below this speed, m/s, of the body's rim the rest of the slide is under 0.1 micrometre: stop."""


@dataclass(frozen=True, slots=True)
class Support:
    """What the body rests on.

    points: shape (n, 2), m, in the object's frame; weights: shape (n,), sum 1; friction: the
    coefficient; torque_factor: multiplies the friction torque; gravity in m/s^2; slope: tilt of the
    table, rad, downhill along +x and +y.
    """

    points: Array
    weights: Array
    friction: float
    torque_factor: float
    gravity: float
    slope: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Motion:
    """State of the body in the table frame: x, y, theta and their rates; m, rad, s."""

    pose: tuple[float, float, float]
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def at_rest(self) -> bool:
        """True when nothing moves."""
        return self.twist == (0.0, 0.0, 0.0)


def sample_support(
    body: Disk | Ring | Polygon, edge_weight: float = 0.0, lean: tuple[float, float] = (0.0, 0.0)
) -> tuple[Array, Array]:
    """Points (n, 2) in m and weights (n,) that stand for the pressure under a body.

    edge_weight > 0 presses more at the rim (weight 1 + edge_weight (r / R)^2), lean presses more
    towards one side (weight 1 + lean . r / R), R the largest radius.
    """
    if isinstance(body, Ring):
        angles = (np.arange(180) + 0.5) * (2 * math.pi / 180)
        points = body.radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    elif isinstance(body, Disk):
        # Ten rings that stand for equal areas, forty points on each.
        radius = body.radius * np.sqrt((np.arange(10) + 0.5) / 10)
        angles = (np.arange(40) + 0.5) * (2 * math.pi / 40)
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        points = (radius[:, None, None] * circle).reshape(-1, 2)
    else:
        points = _grid_inside(np.asarray(body.vertices, dtype=float))
    # Exactly balanced about the centre of mass: pure translation must not begin to turn.
    points = points - points.mean(axis=0)
    largest = float(np.max(np.hypot(points[:, 0], points[:, 1])))
    relative = points / largest
    weights = 1 + edge_weight * np.sum(relative**2, axis=1) + relative @ np.asarray(lean)
    weights = np.maximum(weights, 0.0)
    return points, weights / weights.sum()


def _grid_inside(vertices: Array, per_side: int = 24) -> Array:
    """Centres of a square grid's cells that lie inside a convex, counter-clockwise polygon."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    pitch = float(np.max(high - low)) / per_side
    axes = [np.arange(a + pitch / 2, b, pitch) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    edges = np.roll(vertices, -1, axis=0) - vertices
    offsets = grid[:, None, :] - vertices[None, :, :]
    inside = np.all(edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= 0, axis=1)
    return np.asarray(grid[inside])


def advance(motion: Motion, support: Support, mass: float, inertia: float, until: float) -> Motion:
    """The motion ``until`` seconds later (fourth-order Runge-Kutta, steps of STEP_S at most)."""
    if motion.at_rest:
        return motion
    rim = float(np.max(np.hypot(support.points[:, 0], support.points[:, 1])))
    state = np.array([*motion.pose, *motion.twist])
    left = until
    while left > 0:
        first = _rates(state, support, mass, inertia)
        speed = math.hypot(state[3], state[4]) + rim * abs(state[5])
        braking = math.hypot(first[3], first[4]) + rim * abs(first[5])
        step = min(STEP_S, left, LARGEST_LOSS * speed / braking if braking > 0 else STEP_S)
        second = _rates(state + step / 2 * first, support, mass, inertia)
        third = _rates(state + step / 2 * second, support, mass, inertia)
        fourth = _rates(state + step * third, support, mass, inertia)
        state = state + step / 6 * (first + 2 * second + 2 * third + fourth)
        left -= step
        if math.hypot(state[3], state[4]) + rim * abs(state[5]) < STOP_SPEED:
            return Motion((float(state[0]), float(state[1]), float(state[2])))
    x, y, theta, vx, vy, omega = (float(value) for value in state)
    return Motion((x, y, theta), (vx, vy, omega))


def _rates(state: Array, support: Support, mass: float, inertia: float) -> Array:
    """Time derivative of (x, y, theta, vx, vy, omega)."""
    theta, vx, vy, omega = state[2], state[3], state[4], state[5]
    cos, sin = math.cos(theta), math.sin(theta)
    x = cos * support.points[:, 0] - sin * support.points[:, 1]
    y = sin * support.points[:, 0] + cos * support.points[:, 1]
    point_vx = vx - omega * y
    point_vy = vy + omega * x
    # The tiny floor only avoids a division by zero at a point that does not move.
    scale = support.weights / np.maximum(np.hypot(point_vx, point_vy), 1e-9)
    drag_x, drag_y = point_vx * scale, point_vy * scale
    push = support.friction * support.gravity
    slope_x, slope_y = support.slope
    torque = support.torque_factor * mass * push * float(np.sum(x * drag_y - y * drag_x))
    return np.array(
        [
            vx,
            vy,
            omega,
            support.gravity * math.sin(slope_x) - push * float(np.sum(drag_x)),
            support.gravity * math.sin(slope_y) - push * float(np.sum(drag_y)),
            -torque / inertia,
        ]
    )
