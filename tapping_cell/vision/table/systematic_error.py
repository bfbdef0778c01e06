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

from tapping_cell.vision.camera import Array, CameraModel, View

_FOCAL, _ASPECT = 0.85, 0.35
_LENS: tuple[tuple[str | int, float], ...] = (
    ("cx", 0.7),
    ("cy", 0.7),
    (0, 0.0015),
    (1, 0.004),
    (2, 0.00012),
    (3, 0.00012),
)
"""Parameters of the lens (pixels, or which coefficient) and their usual standard deviations in
relation to each other: what OpenCV's calibration reports for some twenty pictures of a board, and
is off by. Both focal lengths (pixels) are nearly always off by the same, and much less against each
other. Deviations that a calibration states (``CameraModel.deviations``) take their place."""
_STATED_ASPECT = 0.25
"""Deviation of the focal lengths against each other over that of both, where the latter is stated:
measured 0.05 for calibrations from pictures of a board."""
_FIELD = np.geomspace(0.002, 12.0, 12)
_PRINT = np.geomspace(2e-7, 6e-4, 20)
"""Amplitudes that are weighed: of the lens errors, in these deviations; of a marker's misplacement,
m. Coarser steps make the covariance too small where the truth lies between two."""
_TURNS = (0.1, 0.3, 1.0)
"""Misplacement of a marker's corners by its turn, per shift: printed on one sheet, or glued one by
one."""
_PRIOR = (0.7, 1.0), (4e-5, 1.3)
"""What the two amplitudes usually are, and the logarithmic standard deviations of that: it decides
where two or three references cannot."""
_EXACT = (0.3, 0.1, 0.25)
"""Probabilities beforehand that lens and print are as good as exact (then the smallest amplitude):
both; the lens alone; the print alone."""
_STATED = 1.0, 0.5
"""Usual amplitude of the lens errors in deviations that the calibration states, and logarithmic
standard deviation of that; such a lens is never taken for exact."""
_LEFT_OUT = 1e-3
"""Probability of all the unlikely pairs of amplitudes together that are not carried on. Each alone
may be a fiftieth as likely as an exact lens and print, and together they are not."""


@dataclass(frozen=True, slots=True, eq=False)
class _Members:
    """K pairs of amplitudes: weights (K,), the field's powers (K,), and products that every place
    needs."""

    weight: Array
    power: Array
    inverse: Array
    dragged: Array
    steps: Array


@dataclass(frozen=True, slots=True, eq=False)
class SystematicError:
    """The field conditioned on the references; see :func:`condition`."""

    lens: Array
    gain: Array
    basis: Array
    data: Array
    members: _Members

    def at(self, response: Array, lens: Array) -> tuple[Array, Array]:
        """Likely error (3,) of a pose measured somewhere, and covariance (3, 3) of what remains of
        it.

        ``response`` (3, 6) is how such a pose answers a step of the camera's pose, ``lens`` (3, 8)
        how it answers the lens (:func:`lens_shifts`). The covariance includes the noise of the
        reference markers, not that of the object's own.
        """
        m = self.members
        own, cross = lens @ lens.T, lens @ self.lens.T
        pulled = cross @ self.gain.T @ response.T
        power = m.power[:, None, None]
        to_data = power * (cross @ self.basis) - response @ m.dragged
        prior = power * (own - pulled - pulled.T) + response @ m.steps @ response.T
        answer = to_data @ m.inverse
        error = answer @ self.data
        left = prior - answer @ to_data.transpose(0, 2, 1)
        mean = m.weight @ error
        apart = error - mean
        return mean, np.tensordot(m.weight, left, 1) + (m.weight * apart.T) @ apart


def condition(
    points: Array,
    residuals: Array,
    noise: Array,
    lens: Array,
    trend: Array,
    gain: Array,
    stated: bool = False,
) -> SystematicError:
    """Condition the field on the references.

    ``points`` (M, 4, 2) are the corners in the map, ``residuals`` (M, 4, 2) by how much they are
    seen elsewhere (both in m), ``noise`` (8 M, 8 M) their covariance from the image's noise in m^2;
    ``lens`` (8 M, 8) and ``trend`` (8 M, 6) are how the corners, seen on the
    table, answer the lens and a step of the camera's pose, ``gain`` (6, 8 M) the step that the fit
    makes of their misplacements. Rows count x and y of corner after corner. ``stated``: the
    deviations behind ``lens`` are those of its calibration, not usual ones.
    """
    # Only where each marker is and how it is turned counts: ink, bloom and blur make it seem
    # larger, smaller or stretched, and a lens that explains that is a wrong one.
    poses = _poses_of(points)
    full, _ = np.linalg.qr(poses @ trend, mode="complete")
    basis = poses.T @ full[:, 6:]
    data = basis.T @ residuals.reshape(-1)
    parts = np.stack([lens @ lens.T, *_misplaced(points), noise])
    s, p, turn = (a.ravel() for a in np.meshgrid(_FIELD**2, _PRINT**2, np.square(_TURNS)))
    amounts = np.stack([s, p, p * turn, np.ones_like(s)], axis=-1)
    total = np.einsum("ka,aij->kij", amounts, basis.T @ parts @ basis)
    root = np.linalg.cholesky(total)
    white = np.linalg.solve(root, np.broadcast_to(data[:, None], (len(s), data.size, 1)))[..., 0]
    likelihood = -0.5 * (white**2).sum(axis=1)
    likelihood -= np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    likelihood += np.log(_prior(s, p, stated))
    weight = np.exp(likelihood - likelihood.max())
    order = np.argsort(weight)[::-1]
    total_weight = np.cumsum(weight[order]) / weight.sum()
    kept = order[: int(np.searchsorted(total_weight, 1.0 - _LEFT_OUT)) + 1]
    moved = gain @ np.tensordot(amounts[kept], parts, 1)
    members = _Members(
        weight[kept] / weight[kept].sum(),
        s[kept],
        np.linalg.inv(total[kept]),
        moved @ basis,
        moved @ gain.T,
    )
    return SystematicError(lens, gain, basis, data, members)


def _prior(field: Array, print_: Array, stated: bool) -> Array:
    """Probability beforehand of pairs of amplitudes, given their squares."""
    usually, exactly = [], []
    of_lens = _STATED if stated else _PRIOR[0]
    for power, (usual, spread) in ((field, of_lens), (print_, _PRIOR[1])):
        density = np.exp(-0.5 * (np.log(power / usual**2) / (2.0 * spread)) ** 2)
        usually.append(density / density.sum())
        least = power == power.min()
        exactly.append(least / least.sum())
    both, lens, sheet = (0.0, 0.0, _EXACT[0] + _EXACT[2]) if stated else _EXACT
    count = len(field)
    return np.asarray(
        count
        * (
            both * exactly[0] * exactly[1]
            + lens * exactly[0] * usually[1]
            + sheet * usually[0] * exactly[1]
            + (1.0 - both - lens - sheet) * usually[0] * usually[1]
        )
    )


def _misplaced(points: Array) -> tuple[Array, Array]:
    """Covariances (8 M, 8 M) of corners of markers printed or glued wrong by 1: shifted; turned."""
    turned = _turned(points)
    same = np.eye(points.shape[0])
    shifted = np.kron(same, np.kron(np.ones((4, 4)), np.eye(2)))
    return shifted, np.kron(same, np.ones((8, 8))) * np.outer(turned, turned)


def _poses_of(points: Array) -> Array:
    """Matrix (3 M, 8 M): mean x, mean y and turn (times the corners' distance) of every marker."""
    count = points.shape[0]
    turned = _turned(points).reshape(count, 8)
    rows = np.zeros((count, 3, count, 8))
    for k in range(count):
        rows[k, 0, k, 0::2] = 0.25
        rows[k, 1, k, 1::2] = 0.25
        rows[k, 2, k] = 0.25 * turned[k]
    return rows.reshape(3 * count, 8 * count)


def _turned(points: Array) -> Array:
    """Shifts (8 M,) of all corners when each marker turns by one over its corners' distance."""
    arm = points - points.mean(axis=1, keepdims=True)
    reach = np.sqrt((arm**2).sum(axis=-1).mean())
    return np.asarray(np.stack([-arm[..., 1], arm[..., 0]], axis=-1).reshape(-1) / reach)


def lens_shifts(view: View, points: Array, height: float) -> tuple[Array, Array]:
    """Directions (..., 2) of points (..., 2) of the plane at ``height``, and how these move when
    the true lens differs from the calibrated one by a deviation of each parameter, stated or usual,
    (..., 2, 8).
    """
    camera = view.camera
    rays = camera.rays(view.project(points, height))
    shifts = [
        camera.rays(View(true, view.pose).project(points, height)) - rays
        for true in _other_lenses(camera)
    ]
    return rays, np.stack(shifts, axis=-1)


def _other_lenses(camera: CameraModel) -> list[CameraModel]:
    """The camera with one parameter after another off by its deviation, stated or usual."""
    focal, aspect, rest = _FOCAL, _ASPECT, [usual for _, usual in _LENS]
    if camera.deviations:
        focal = float(np.sqrt(np.mean(np.square(camera.deviations[:2]))))
        aspect, rest = _STATED_ASPECT * focal, list(camera.deviations[2:])
    others = [
        replace(camera, fx=camera.fx + focal, fy=camera.fy + focal),
        replace(camera, fx=camera.fx + aspect, fy=camera.fy - aspect),
    ]
    for (parameter, _), deviation in zip(_LENS, rest, strict=True):
        if isinstance(parameter, str):
            changed = getattr(camera, parameter) + deviation
            others.append(replace(camera, **{parameter: changed}))
        else:
            coefficients = camera.coefficients.tolist()
            coefficients[parameter] += deviation
            others.append(replace(camera, distortion=tuple(coefficients)))
    return others
