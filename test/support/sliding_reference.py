"""Independent references for the sliding tests: the textbook formulas and an accurate integration.

Nothing is imported from the package. The friction factors are computed with the published formulas,
which contain the complete elliptic integrals K and E (the argument of SciPy's functions is k^2).
Where terms of these formulas cancel, a series is used. The motion is integrated with DOP853. The
integration variable is chosen such that the velocities decrease about exponentially with this
variable.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.special import ellipe, ellipk


def disk_force_and_torque(eps: float) -> tuple[float, float]:
    """Return F and T of a disk at eps = v / (R omega)."""
    if eps > 20:
        q = 1 / eps
        return (
            1 - q**2 / 8 - q**4 / 64 - 5 * q**6 / 1024,
            q * (1 / 4 + q**2 / 48 + 3 * q**4 / 512 + 25 * q**6 / 10240),
        )
    if eps < 2e-3:
        return eps * (1 - eps**2 / 8), 2 / 3 - eps**2 / 2
    e2 = eps * eps
    if eps <= 1:
        big_k, big_e = (float(ellipk(e2)) if eps < 1 else 0.0), float(ellipe(e2))
        return (
            4 / (3 * math.pi) * ((e2 + 1) * big_e + (e2 - 1) * big_k) / eps,
            4 / (9 * math.pi) * ((4 - 2 * e2) * big_e + (e2 - 1) * big_k),
        )
    big_k, big_e = float(ellipk(1 / e2)), float(ellipe(1 / e2))
    return (
        4 / (3 * math.pi) * ((e2 + 1) * big_e - (e2 - 1) * big_k),
        4 * eps / (9 * math.pi) * ((4 - 2 * e2) * big_e + (2 * e2 - 5 + 3 / e2) * big_k),
    )


def ring_force_and_torque(eps: float) -> tuple[float, float]:
    """Return F and T of a thin ring at eps = v / (R omega)."""
    if eps > 1:
        torque, force = ring_force_and_torque(1 / eps)
        return force, torque
    if eps < 2e-3:
        return eps / 2 * (1 + eps**2 / 8), 1 - eps**2 / 4
    e2 = eps * eps
    big_k = ellipk(e2) if eps < 1 else 0.0
    return (
        2 / (math.pi * eps) * (ellipe(e2) - (1 - e2) * big_k),
        2 / math.pi * ellipe(e2),
    )


def integrate(support: str, torque_ratio: float, speed: float, rim_speed: float):
    """Return mu g x, mu g R theta and mu g t of a complete slide, with a relative accuracy of
    1e-10.

    ``torque_ratio`` is kappa m R^2 / I. The integration variable sigma is defined by dt = r dsigma
    with r = hypot(speed, rim speed). The integration ends when both speeds are at most 1e-9 of the
    initial value of r. The quotients x / v0 and theta / omega0 are integrated, so that even a very
    small translation or rotation has this relative accuracy.
    """
    friction = {"disk": disk_force_and_torque, "ring": ring_force_and_torque}[support]
    r0 = math.hypot(speed, rim_speed)

    def rates(length, state):
        log_v, log_s, *_ = state
        v, s = math.exp(log_v), math.exp(log_s)
        force, torque = friction(v / s)
        r = math.hypot(v, s)
        # The derivatives of v and s with respect to time are -F and -Lambda T (Lambda is
        # torque_ratio). The factor r changes from time to the integration variable.
        return [
            -force * r / v,
            -torque_ratio * torque * r / s,
            v / speed * r,
            s / rim_speed * r,
            r,
        ]

    start = [math.log(speed / r0), math.log(rim_speed / r0), 0.0, 0.0, 0.0]

    def stopped(length, state):
        return max(state[0], state[1]) + 9 * math.log(10)

    stopped.terminal = True
    solution = solve_ivp(
        rates, (0, 1e3), start, method="DOP853", rtol=3e-13, atol=1e-16, events=stopped
    )
    assert solution.status == 1
    _, _, travel, rim_travel, time = solution.y[:, -1]
    # The integration ends at 1e-9 of the initial velocity. The remaining distance and rotation are
    # negligible. The remaining duration is added; it is computed with the friction at the final
    # ratio of the velocities.
    log_v, log_s = solution.y[:2, -1]
    v, s = math.exp(log_v), math.exp(log_s)
    force, torque = friction(v / s)
    time += v / force if v >= s else s / (torque_ratio * torque)
    return np.array([travel * r0**2 * speed, rim_travel * r0**2 * rim_speed, time * r0])
