"""The Jacobian of a tap as printed in the paper, and the setup of the paper's experiments.

Section 5.1 of Huang and Mason gives the Jacobian of a tap of 10 mm and 3 degrees: the derivative of
the object's displacement (x along the travel, y across it, theta) with respect to the striker's
pose (i, j, beta), in mm and degrees. Its signs imply that i points along the contact normal out of
the object and that rotations are clockwise. The y row assumes that the direction of travel rotates
by the same angle as the striker.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.mechanics.bodies import Disk
from tapping_cell.mechanics.impact import Impact, Striker
from tapping_cell.mechanics.planar import Array
from tapping_cell.mechanics.sliding import Sliding
from tapping_cell.mechanics.tap import Tap

# Jacobian and error vector of section 5.1, in mm and degrees.
PAPER_JACOBIAN = np.array(
    [[-0.0689, 0.135, 0.126], [-4.7e-6, -0.000026, 0.176], [-0.0088, 0.0251, 0.0234]]
)
PAPER_STRIKER_ERROR = (7.5, 7.5, 5.0)

# Mass, in kg, of the steel shaft in figure 1 of the paper. The shaft appears to be 10 mm thick and
# 80 mm long. The Jacobian does not depend on this mass.
_STRIKER_MASS = 0.05
# Impact constants B1 and B3 (see impact.py), divided by B2, fitted to the x and theta rows of
# PAPER_JACOBIAN. The rms residual is 4.5 % of the largest element of each row (0.135 and 0.0251).
# B2 has the value of a free striker.
_FITTED_B1 = 2.650
_FITTED_B3 = -0.2686


class Sensitivity(NamedTuple):
    """A Jacobian in mm and degrees, with the paper's signs.

    ``printed`` (..., 3, 3) has the paper's y row, in which the direction of travel rotates with the
    striker; ``physical`` (..., 3, 3) has the y row of the impact model.
    """

    printed: Array
    physical: Array


def paper_tap(mirrored: bool = False) -> Tap:
    """Return the tap with the aluminium disk, table and striker of sections 3.1, 4 and 5.1 of the
    paper.

    The disk has a radius of 48 mm, a height of 12 mm and a mass of 245.5 g. The friction is 0.17,
    the torque factor 3.64 and the restitution 0.86. The contact friction of 0.20 is derived from
    the paper's statement that a rotation of 10 degrees over a distance of 10 mm is three times the
    largest rotation that one tap can cause over this distance. The ball's radius and two impact
    constants are fitted to the Jacobian. These constants hold for only one direction of rotation:
    the positive one or, with ``mirrored``, the negative one.
    """
    disk = Disk(radius=0.048, mass=0.2455, height=0.012)
    striker = Striker(mass=_STRIKER_MASS, tip_radius=0.0054, constraint="free")
    b2 = 1 / disk.mass + 1 / striker.mass
    b3 = -_FITTED_B3 * b2 if mirrored else _FITTED_B3 * b2
    return Tap(
        Sliding(disk, friction=0.17, torque_factor=3.64),
        Impact(
            disk,
            striker,
            restitution=0.86,
            friction=0.20,
            constants=(_FITTED_B1 * b2, None, b3),
        ),
    )


def sensitivity(tap: Tap, displacement: ArrayLike) -> Sensitivity:
    """Compute the Jacobians of taps for displacements (..., 3), m and rad, in the paper's form.

    Raises the same exceptions as :meth:`Tap.plan`.
    """
    wanted = np.asarray(displacement, dtype=float)
    degrees = np.array([1.0, 1.0, 180 / math.pi * 1e-3])
    signs = np.array([[-1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, -1.0, -1.0]])
    physical = signs * degrees[:, None] * tap.jacobian(wanted) / degrees
    printed = physical.copy()
    printed[..., 1, :2] = 0.0
    distance = np.hypot(wanted[..., 0], wanted[..., 1])
    printed[..., 1, 2] = 1e3 * distance * math.pi / 180
    return Sensitivity(printed, physical)


def norm(jacobian: ArrayLike) -> Array:
    """Compute the spectral norm (...,): the largest gain of an error vector, with mm and degrees as
    equivalent units."""
    return np.asarray(np.linalg.norm(np.asarray(jacobian), ord=2, axis=(-2, -1)))
