"""Least squares with local parameters of each trial and parameters shared by all trials.

The residuals of a trial depend only on its own ``local`` parameters and on the ``shared``
parameters. The matrix of the normal equations is therefore a bordered block-diagonal matrix. The
local parameters are eliminated for each trial (Schur complement), so the computing time is linear
in the number of trials.

Methods: Levenberg 1944 and Marquardt 1963; for the elimination, Triggs et al., "Bundle adjustment",
2000, section 6.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import Array

Rows = NDArray[np.intp]

_STEPS = 60
_LONGEST_STEP = 0.5
"""Maximum change of a shared parameter (a logarithm or a ratio) in one step."""


class Estimate(NamedTuple):
    """Parameters ``shared`` (s,) and ``local`` (n, p); ``cost`` is half the sum of squares."""

    shared: Array
    local: Array
    cost: float = np.inf
    evaluations: int = 0


class NormalEquations(NamedTuple):
    """A linearised problem with the Jacobian J and the residuals r.

    ``cost`` is half the sum of squares. ``h_local`` (n, p, p), ``h_mixed`` (n, p, s) and
    ``h_shared`` (n, s, s) are the blocks of each trial's J^T J. ``g_local`` (n, p) and ``g_shared``
    (n, s) are the parts of each trial's J^T r.
    """

    cost: float
    h_local: Array
    h_mixed: Array
    h_shared: Array
    g_local: Array
    g_shared: Array


Linearise = Callable[[Estimate], NormalEquations]
Limit = Callable[[Estimate, Estimate], Estimate]
"""Function of a new and the previous estimate. It returns the new estimate, limited to the valid
range."""


def normal_equations(cost: float, hessian: Array, gradient: Array, local: int) -> NormalEquations:
    """Split J^T J (n, p + s, p + s) and J^T r (n, p + s) after the first p = ``local``
    parameters."""
    return NormalEquations(
        cost,
        hessian[:, :local, :local],
        hessian[:, :local, local:],
        hessian[:, local:, local:],
        gradient[:, :local],
        gradient[:, local:],
    )


def sum_by_trial(jacobian: Array, residuals: Array, rows: Rows, count: int) -> tuple[Array, Array]:
    """Compute J^T J (count, q, q) and J^T r (count, q) of each trial.

    ``rows`` (N,) is the trial of each residual. Every trial must have at least one residual.
    """
    order = np.argsort(rows, kind="stable")
    starts = np.searchsorted(rows[order], np.arange(count))
    j = jacobian[order]
    hessian = np.add.reduceat(j[:, :, None] * j[:, None, :], starts, axis=0)
    gradient = np.add.reduceat(j * residuals[order][:, None], starts, axis=0)
    return hessian, gradient


def eliminated(equations: NormalEquations) -> tuple[Array, Array]:
    """Compute gradient (n, s) and curvature (n, s, s) of each trial in the shared parameters.

    The local parameters are eliminated: they have their optimal values for the given shared
    parameters.
    """
    by_shared, by_gradient = _solved(equations, equations.h_local)
    return _reduced(equations, by_shared, by_gradient)


def solve(
    linearise: Linearise, start: Estimate, limit: Limit, *, local_only: bool = False
) -> Estimate:
    """Minimise the sum of squares from ``start``; ``local_only`` fixes the shared parameters."""
    at, damping, evaluations = start, 1e-4, start.evaluations
    point = linearise(at)
    for _ in range(_STEPS):
        step_local, step_shared = _step(point, damping, local_only)
        trial = limit(Estimate(at.shared + step_shared, at.local + step_local), at)
        following = linearise(trial)
        evaluations += 1
        if following.cost <= point.cost:
            gained = point.cost - following.cost
            at, point, damping = trial, following, max(damping / 5, 1e-9)
            if gained <= 1e-9 * (1.0 + point.cost):
                break
        elif damping > 1e6:
            break
        else:
            damping *= 8
    return at._replace(cost=point.cost, evaluations=evaluations)


def _step(equations: NormalEquations, damping: float, local_only: bool) -> tuple[Array, Array]:
    diagonal = np.einsum("nii->ni", equations.h_local)
    eye = np.eye(diagonal.shape[1])
    damped = equations.h_local + damping * diagonal[:, :, None] * eye
    by_shared, by_gradient = _solved(equations, damped)
    if local_only:
        return -by_gradient, np.zeros(by_shared.shape[2])
    gradients, curvatures = _reduced(equations, by_shared, by_gradient)
    h, g = curvatures.sum(axis=0), gradients.sum(axis=0)
    h += damping * np.diag(np.diag(h)) + 1e-12 * np.eye(len(g))
    step = np.clip(-np.linalg.solve(h, g), -_LONGEST_STEP, _LONGEST_STEP)
    return -by_gradient - by_shared @ step, step


def _solved(equations: NormalEquations, h_local: Array) -> tuple[Array, Array]:
    """Return inverse(h_local) h_mixed, (n, p, s), and inverse(h_local) g_local, (n, p), of each
    trial."""
    right = np.concatenate([equations.h_mixed, equations.g_local[:, :, None]], axis=2)
    solved = np.linalg.solve(h_local, right)
    return solved[:, :, :-1], solved[:, :, -1]


def _reduced(
    equations: NormalEquations, by_shared: Array, by_gradient: Array
) -> tuple[Array, Array]:
    gradient = equations.g_shared - np.einsum("nps,np->ns", equations.h_mixed, by_gradient)
    curvature = equations.h_shared - np.einsum("nps,npq->nsq", equations.h_mixed, by_shared)
    return gradient, curvature
