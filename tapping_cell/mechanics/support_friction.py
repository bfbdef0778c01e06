"""Coulomb friction under a sliding and spinning body: closed forms for a disk and a ring.

With v the speed, omega the spin and R the radius of the support, ``tau`` in [0, 1] is the smaller
of v and R omega divided by the larger. There are two regimes, and in both ``tau`` is the modulus of
the elliptic integrals:

- *translating*, v >= R omega: tau = R omega / v;
- *spinning*, R omega > v: tau = v / (R omega).

F is the friction force divided by mu m g, and T the friction torque divided by mu m g R. The
formulas are those of Voyenli and Eriksen (Am. J. Phys. 53, 1985) and of Farkas, Bartels, Unger and
Wolf (Phys. Rev. Lett. 90, 2003), rewritten in the integrals

    B = int cos^2 / Delta,   D = int sin^2 / Delta,   C = (D - B) / k^2,   Delta^2 = 1 - k^2 sin^2

over a quarter turn (Bulirsch 1965). The usual sums of the complete elliptic integrals K and E
suffer from cancellation if the modulus is small. With B, C and D there is no cancellation, so that
one formula is accurate from pure sliding to pure spinning.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics.planar import Array

# The arithmetic-geometric mean converges quadratically. From a complementary modulus of 1e-12 it
# takes eight steps. The first step is made before the loop, so the nine steps of the loop include
# two extra steps for safety.
_AGM_STEPS = 9
_SMALLEST_COMPLEMENT = 1e-12


class SupportFriction(NamedTuple):
    """Friction factors F and T of one regime, in a form that stays accurate for small tau.

    In the translating regime, F = leading and T = tau * trailing. In the spinning regime, T =
    leading and F = tau * trailing.
    """

    leading: Array
    trailing: Array


def disk_friction(tau: Array, complement: Array, spinning: NDArray[np.bool_]) -> SupportFriction:
    """Compute the friction factors for uniform pressure on a disk.

    ``complement`` is 1 - tau^2. It is a separate argument because computing it from tau would lose
    accuracy.
    """
    b, c, d = _elliptic_bcd(tau, complement)
    shared = 4 / (3 * math.pi) * (2 * b + complement * d)
    modulus2 = tau * tau
    torque = 4 / (9 * math.pi) * ((3 - modulus2) * b + complement * (3 - 2 * modulus2) * d)
    trailing_torque = 4 / (9 * math.pi) * (c + 3 * b - d)
    return SupportFriction(
        np.where(spinning, torque, shared), np.where(spinning, shared, trailing_torque)
    )


def ring_friction(tau: Array, complement: Array, spinning: NDArray[np.bool_]) -> SupportFriction:
    """Compute the friction factors for uniform pressure on a thin ring. The formulas of the
    spinning regime are those of the translating regime with force and torque exchanged."""
    del spinning
    b, _, d = _elliptic_bcd(tau, complement)
    return SupportFriction(2 / math.pi * (b + complement * d), 2 / math.pi * b)


def _elliptic_bcd(modulus: Array, complement: Array) -> tuple[Array, Array, Array]:
    """Compute B, C and D by the arithmetic-geometric mean, without cancellation.

    With c_0 = k and c_(n+1) = c_n^2 / (4 a_(n+1)), K - E = (K / 2) sum 2^n c_n^2. All c_n with n >=
    1 contain the factor k^2, which is factored out.
    """
    a = np.ones_like(modulus)
    b = np.maximum(np.sqrt(complement), _SMALLEST_COMPLEMENT)
    mean = (a + b) / 2
    reduced = 1 / (4 * mean)
    modulus2 = modulus * modulus
    total = np.zeros_like(modulus)
    weight = 2.0
    a, b = mean, np.sqrt(a * b)
    for _ in range(_AGM_STEPS):
        total += weight * reduced * reduced
        weight *= 2
        mean = (a + b) / 2
        reduced = modulus2 * reduced * reduced / (4 * mean)
        a, b = mean, np.sqrt(a * b)
    quarter_period = math.pi / (2 * a)
    share = modulus2 * total
    return (
        quarter_period * (1 - share) / 2,
        quarter_period * total,
        quarter_period * (1 + share) / 2,
    )
