"""What the reference markers still disagree about, as errors of the lens and of the print.

After the camera's pose is fitted, the references miss their places in the map. Part of that comes
from a lens that is not quite as calibrated, part belongs to each marker alone (printing, gluing),
part is noise. With amplitudes for the first two, all are Gaussian; conditioned on the references
they give, at any place and height over the table, the likely error of a pose measured there and how
uncertain that remains (kriging with the camera's pose as trend; Rasmussen and Williams 2006,
chapter 2). The amplitudes come from the restricted likelihood, averaged over a grid, so that what
few references cannot tell widens the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tapping_cell.vision.camera import Array, View

_LENS = (
    ("fx", 0.5),
    ("fy", 0.5),
    ("cx", 0.7),
    ("cy", 0.7),
    (0, 0.0015),
    (1, 0.004),
    (2, 0.00012),
    (3, 0.00012),
)
"""Parameters of the lens (pixels, or which coefficient) and their usual standard deviations in
relation to each other: what OpenCV's calibration reports for some twenty pictures of a board."""
_FIELD = np.geomspace(0.002, 12.0, 12)
_PRINT = np.geomspace(2e-7, 6e-4, 8)
"""Amplitudes that are weighed: of the lens errors, in these deviations; of a marker's misplacement,
m."""
_LEAST_WEIGHT = 0.02
"""Of the likeliest pair of amplitudes, below which a pair is not carried on."""


@dataclass(frozen=True, slots=True, eq=False)
class _Member:
    """One pair of amplitudes: its weight, the field's power, and products that every place
    needs."""

    weight: float
    power: float
    inverse: Array
    dragged: Array
    steps: Array


@dataclass(frozen=True, slots=True, eq=False)
class ErrorField:
    """The field conditioned on the references; see :func:`condition`."""

    lens: Array
    gain: Array
    basis: Array
    data: Array
    members: tuple[_Member, ...]

    def at(self, response: Array, lens: Array) -> tuple[Array, Array]:
        """Likely error (3,) of a pose measured somewhere, and covariance (3, 3) of what remains of
        it.

        ``response`` (3, 6) is how such a pose answers a step of the camera's pose, ``lens`` (3, 8)
        how it answers the lens (:func:`lens_shifts`). The covariance includes the noise of the
        reference markers, not that of the object's own.
        """
        own, cross = lens @ lens.T, lens @ self.lens.T
        projected, pulled = cross @ self.basis, cross @ self.gain.T @ response.T
        mean, second = np.zeros(3), np.zeros((3, 3))
        for m in self.members:
            to_data = m.power * projected - response @ m.dragged
            prior = m.power * (own - pulled - pulled.T) + response @ m.steps @ response.T
            answer = to_data @ m.inverse
            error = answer @ self.data
            mean += m.weight * error
            second += m.weight * (prior - answer @ to_data.T + np.outer(error, error))
        return mean, second - np.outer(mean, mean)


def condition(
    points: Array, residuals: Array, noise: Array, lens: Array, trend: Array, gain: Array
) -> ErrorField:
    """Condition the field on the references.

    ``points`` (M, 4, 2) are the corners in the map, ``residuals`` (M, 4, 2) by how much they are
    seen elsewhere (both in m), ``noise`` (M,) the standard deviation of a corner in m; ``lens`` (8
    M, 8) and ``trend`` (8 M, 6) are how the corners, seen on the table, answer the lens and a step
    of the camera's pose, ``gain`` (6, 8 M) the step that the fit makes of their misplacements. Rows
    count x and y of corner after corner.
    """
    full, _ = np.linalg.qr(trend, mode="complete")
    basis = full[:, 6:]
    data = basis.T @ residuals.reshape(-1)
    parts = (lens @ lens.T, _single(points), np.diag(np.repeat(noise**2, 8)))
    smooth, single, still = (basis.T @ part @ basis for part in parts)
    s, p = (a.ravel() for a in np.meshgrid(_FIELD**2, _PRINT**2))
    total = s[:, None, None] * smooth + p[:, None, None] * single + still
    root = np.linalg.cholesky(total)
    white = np.linalg.solve(root, np.broadcast_to(data[:, None], (len(s), data.size, 1)))[..., 0]
    likelihood = -0.5 * (white**2).sum(axis=1)
    likelihood -= np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    weight = np.exp(likelihood - likelihood.max())
    weight[weight < _LEAST_WEIGHT] = 0.0
    weight /= weight.sum()
    members = []
    for k in np.flatnonzero(weight):
        covariance = s[k] * parts[0] + p[k] * parts[1] + parts[2]
        moved = gain @ covariance
        members.append(
            _Member(
                float(weight[k]),
                float(s[k]),
                np.linalg.inv(total[k]),
                moved @ basis,
                moved @ gain.T,
            )
        )
    return ErrorField(lens, gain, basis, data, tuple(members))


def _single(points: Array) -> Array:
    """Covariance (8 M, 8 M) of corners of markers glued down wrong by 1: shifted, and turned by as
    much."""
    arm = points - points.mean(axis=1, keepdims=True)
    reach = np.sqrt((arm**2).sum(axis=-1).mean())
    turned = np.stack([-arm[..., 1], arm[..., 0]], axis=-1).reshape(-1) / reach
    same = np.kron(np.eye(points.shape[0]), np.ones((4, 4)))
    shifts = np.kron(same, np.eye(2))
    return np.asarray(shifts + np.kron(same, np.ones((2, 2))) * np.outer(turned, turned))


def lens_shifts(view: View, points: Array, height: float) -> tuple[Array, Array]:
    """Directions (..., 2) of points (..., 2) of the plane at ``height``, and how these move when
    the true lens differs from the calibrated one by a usual deviation of each parameter, (..., 2,
    8).
    """
    camera = view.camera
    coefficients = camera.coefficients.tolist()
    rays = camera.rays(view.project(points, height))
    columns = []
    for parameter, deviation in _LENS:
        if isinstance(parameter, str):
            true = replace(camera, **{parameter: getattr(camera, parameter) + deviation})
        else:
            changed = list(coefficients)
            changed[parameter] += deviation
            true = replace(camera, distortion=tuple(changed))
        columns.append(camera.rays(View(true, view.pose).project(points, height)) - rays)
    return rays, np.stack(columns, axis=-1)
