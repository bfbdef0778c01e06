"""Model the residuals of the reference markers as errors of the lens and of the print.

After the camera's pose is fitted, the references still deviate from their positions in the map. One
part of these deviations is due to an inaccurate lens calibration, one part is individual to each
marker (printing, gluing), and one part is noise. All three parts are modelled as Gaussian. The
amplitudes of the errors of lens and markers are unknown. Conditioned on the references, the model
gives the expected error of a pose measured at any place and height above the table, and the
remaining uncertainty. This is kriging with the camera's pose as trend (Rasmussen and Williams 2006,
chapter 2). The results for a grid of amplitudes are averaged with the restricted likelihood of the
amplitudes as weight, so that the ambiguity left by few references increases the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tapping_cell.vision.camera import Array, CameraModel, View, at_height

_FOCAL, _ASPECT = 0.85, 0.35
_LENS = 0.7, 0.7, 0.0015, 0.004, 0.00012, 0.00012
"""Typical standard deviations of the lens parameters, as reported by OpenCV's calibration for some
twenty images of a board. A common amplitude of all lens errors is estimated from the references.

``_LENS`` contains the standard deviations of cx, cy, k1, k2, p1 and p2. Deviations of cx, cy and
the focal lengths are in pixels. ``_FOCAL`` is for the common error of the two focal lengths, and
``_ASPECT`` for half the difference of their errors. If a calibration states deviations
(``CameraModel.deviations``), these are used instead.
"""
_STATED_ASPECT = 0.25
"""Standard deviation of half the difference of the two focal lengths' errors, as a fraction of the
standard deviation of their common error. This value is used if the calibration states deviations.
Measured: 0.05 for calibrations from images of a board."""
_FIELD = np.geomspace(0.002, 12.0, 12)
_PRINT = np.geomspace(2e-7, 6e-4, 20)
"""Grids of the amplitude of the lens errors, in units of the standard deviations in ``_LENS``, and
of the amplitude of a marker's misplacement, in m. Coarser steps make the covariance too small if
the true value is between two steps."""
_TURNS = (0.1, 0.3, 1.0)
"""Assumed ratios of two displacements of a marker's corners: the displacement due to the marker's
rotation error, divided by the displacement due to its position error. The lowest ratio is typical
of markers printed on one sheet; the highest ratio is typical of markers glued individually."""
_PRIOR = (0.7, 1.0), (4e-5, 1.3)
"""Prior distributions of two amplitudes, of the lens errors and of a marker's misplacement: the
typical value of the amplitude, and the standard deviation of its logarithm. The priors matter if
there are only two or three references."""
_EXACT = (0.3, 0.1, 0.25)
"""Prior probabilities that both lens and print are practically exact, that only the lens is exact,
and that only the print is exact. Exact means that the amplitude is the smallest one of its
grid."""
_STATED = 1.0, 0.5
"""Typical amplitude of the lens errors in units of the deviations stated by the calibration, and
its logarithmic standard deviation. A lens with stated deviations is never assumed to be exact."""
_STATED_EXACT = 0.3
"""Prior probability that the print is exact if the calibration states deviations."""
_LEFT_OUT = 1e-3
"""Total probability of the unlikely combinations of amplitudes that may be dropped. This limit is
low, because many unlikely combinations matter together, even if each of them is only a fiftieth as
likely as an exact lens and print."""


@dataclass(frozen=True, slots=True, eq=False)
class SystematicError:
    """The error model conditioned on the references; see :func:`condition`.

    It consists of K combinations of amplitudes: their weights (K,), the squared amplitudes
    ``power`` (K,) of the lens error, the mean variance ``own`` (m^2) of a marker's misplacement,
    and matrices that do not depend on the pose to be corrected.
    """

    lens: Array
    gain: Array
    basis: Array
    data: Array
    weight: Array
    power: Array
    inverse: Array
    dragged: Array
    steps: Array
    own: float

    def at(self, response: Array, lens: Array) -> tuple[Array, Array]:
        """Expected error (3,) of a pose measured at a place, and covariance (3, 3) of the remaining
        error.

        ``response`` (3, 6) is the derivative of this pose with respect to the camera's pose, and
        ``lens`` (3, 8) its derivative with respect to the lens parameters (:func:`lens_shifts`).
        The object's marker is assumed to be misplaced in the image as much as a reference marker,
        by print, by lens errors nearby or by blur. The covariance includes this misplacement and
        the noise of the reference markers, but not the noise of the object's marker.
        """
        same, cross = lens @ lens.T, lens @ self.lens.T
        pulled = cross @ self.gain.T @ response.T
        power = self.power[:, None, None]
        to_data = power * (cross @ self.basis) - response @ self.dragged
        prior = power * (same - pulled - pulled.T) + response @ self.steps @ response.T
        answer = to_data @ self.inverse
        error = answer @ self.data
        left = prior - answer @ to_data.transpose(0, 2, 1)
        mean = self.weight @ error
        apart = error - mean
        spread = np.tensordot(self.weight, left, 1) + (self.weight * apart.T) @ apart
        return mean, spread + self.own * np.diag([1.0, 1.0, 0.0])


def condition(
    points: Array,
    residuals: Array,
    noise: Array,
    lens: Array,
    trend: Array,
    gain: Array,
    stated: bool = False,
) -> SystematicError:
    """Condition the error model on the references.

    ``points`` (M, 4, 2) are the corners in the map and ``residuals`` (M, 4, 2) their measured
    displacements, both in m. ``noise`` (8 M, 8 M) is the covariance, in m^2, of the displacements
    due to image noise. ``lens`` (8 M, 8) and ``trend`` (8 M, 6) are the derivatives of the corners,
    projected to the table, with respect to the lens parameters and to the camera's pose. ``gain``
    (6, 8 M) is the derivative of the fitted pose with respect to the corners. The 8 M values are x
    and y of successive corners. ``stated`` is True if ``lens`` is scaled by the deviations that the
    calibration states, and False if it is scaled by typical deviations.
    """
    # Use only the position and rotation of each marker. Ink, stray light and blur make a marker
    # appear larger, smaller or stretched. These effects must not be attributed to the lens.
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
    return SystematicError(
        lens,
        gain,
        basis,
        data,
        weight=weight[kept] / weight[kept].sum(),
        power=s[kept],
        inverse=np.linalg.inv(total[kept]),
        dragged=moved @ basis,
        steps=moved @ gain.T,
        own=float(weight[kept] @ p[kept] / weight[kept].sum()),
    )


def _prior(field: Array, print_: Array, stated: bool) -> Array:
    """Return the prior probabilities (K,) of combinations of amplitudes. The squared amplitudes are
    ``field`` (K,) for the lens errors and ``print_`` (K,) for the misplacement of markers."""
    usually, exactly = [], []
    of_lens = _STATED if stated else _PRIOR[0]
    for power, (usual, spread) in ((field, of_lens), (print_, _PRIOR[1])):
        density = np.exp(-0.5 * (np.log(power / usual**2) / (2.0 * spread)) ** 2)
        usually.append(density / density.sum())
        least = power == power.min()
        exactly.append(least / least.sum())
    both, lens, sheet = (0.0, 0.0, _STATED_EXACT) if stated else _EXACT
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
    """Return two covariance matrices (8 M, 8 M) of the corners: for independent position errors of
    the markers with a standard deviation of 1 m in x and y, and for independent rotations with a
    standard deviation of 1 / r (see :func:`_turned`)."""
    turned = _turned(points)
    same = np.eye(points.shape[0])
    shifted = np.kron(same, np.kron(np.ones((4, 4)), np.eye(2)))
    return shifted, np.kron(same, np.ones((8, 8))) * np.outer(turned, turned)


def _poses_of(points: Array) -> Array:
    """Return the matrix (3 M, 8 M) that maps displacements of all corners to the mean displacement
    in x and in y and the rotation of every marker. The rotation is multiplied by the distance r of
    :func:`_turned`."""
    x, y = np.tile([1.0, 0.0], 4), np.tile([0.0, 1.0], 4)
    turned = _turned(points).reshape(-1, 8)
    return block_diagonal(np.stack([0.25 * np.stack([x, y, turn]) for turn in turned]))


def block_diagonal(blocks: Array) -> Array:
    """Return the matrix (N a, N b) with the blocks (N, a, b) on its diagonal. SciPy's function
    would take 25 MB of each process."""
    count, rows, columns = blocks.shape
    matrix = np.zeros((count, rows, count, columns))
    matrix[np.arange(count), :, np.arange(count)] = blocks
    return matrix.reshape(count * rows, count * columns)


def _turned(points: Array) -> Array:
    """Return the displacements (8 M,) of all corners if each marker rotates by 1 / r, where r is
    the root mean square distance of the corners from the centre of their marker."""
    arm = points - points.mean(axis=1, keepdims=True)
    reach = np.sqrt((arm**2).sum(axis=-1).mean())
    return np.asarray(np.stack([-arm[..., 1], arm[..., 0]], axis=-1).reshape(-1) / reach)


def lens_shifts(view: View, points: Array, height: float) -> tuple[Array, Array]:
    """Return the directions (..., 2) of points (..., 2) of the plane at ``height``, and the changes
    (..., 2, 8) of these directions due to errors of eight lens parameters.

    For each change, one parameter differs from its calibrated value by one standard deviation. This
    is the standard deviation stated by the calibration or, if none is stated, a typical standard
    deviation.
    """
    camera = view.camera
    seen = view.pose.apply(at_height(points, height))
    rays = seen[..., :2] / seen[..., 2:]
    flat = np.column_stack([rays.reshape(-1, 2), np.ones(rays.size // 2)])
    zero = np.zeros(3)
    _, jacobian = cv2.projectPoints(flat, zero, zero, camera.matrix, camera.coefficients)
    slopes: Array = np.asarray(jacobian, dtype=float).reshape(len(flat), 2, -1)
    # Columns 3 and 4 are the derivatives of the pixels with respect to the direction, columns 6 to
    # 13 those with respect to fx, fy, cx, cy, k1, k2, p1 and p2.
    shifts = np.linalg.solve(slopes[..., 3:5], slopes[..., 6:14] @ _lens_errors(camera))
    return rays, np.asarray(shifts, dtype=float).reshape(*rays.shape, 8)


def _lens_errors(camera: CameraModel) -> Array:
    """Return a matrix (8, 8): each column is an independent error of fx, fy, cx, cy, k1, k2, p1 and
    p2 by one standard deviation (stated by the calibration, otherwise typical)."""
    focal, aspect, rest = _FOCAL, _ASPECT, np.array(_LENS)
    if camera.deviations:
        focal = float(np.sqrt(np.mean(np.square(camera.deviations[:2]))))
        aspect, rest = _STATED_ASPECT * focal, np.array(camera.deviations[2:])
    errors = np.diag([0.0, 0.0, *rest])
    errors[:2, :2] = [[focal, aspect], [focal, -aspect]]
    return errors
