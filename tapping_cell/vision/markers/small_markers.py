"""Measure markers too small for their edges by fitting the whole printed pattern to the pixels.

If a module is only one to four pixels wide, the pixels beside an edge already belong to the next
module, so the levels of black and white cannot be measured there. The pattern is known, however.
The pattern's image is a sum of blurred steps at both sides of each module (normal distribution
function), with illumination that varies across the marker. Gauss-Newton adjusts the four corners,
the blur and the illumination until the pattern explains the pixels (Lucas and Kanade 1981 with a
homography). The residuals give the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image
from tapping_cell.vision.markers.edges import BINS, MarkerEdges

_QUIET = 0.6
"""Width, in modules, of the part of the white margin that is used. It is less than one module,
because a printed margin may be as narrow as one module."""
_BLUR, _MIN_BLUR, _MAX_BLUR = 0.7, 0.35, 2.5
"""Sigma of the blur in pixels: initial value and bounds."""
_ROUNDS = 15
_LARGEST_STEP = 0.6
"""Maximum displacement of a corner in one iteration, in pixels."""
_CONVERGED = 0.03
_MAX_CORNER_SHIFT = 0.9
"""Maximum distance of a corner from its detected position, in modules."""
_MIN_CONTRAST = 12.0
_MAX_UNEXPLAINED = 0.18
"""Upper limit of the root mean square residual of the fit, relative to the contrast. The largest
value measured on 530 markers in photographs was 0.16."""
_VAGUE, _MIN_MODULE = 0.15, 1.2
"""Maximum standard deviation of a side, in modules, and minimum width of a module, in pixels. For
the markers in the photographs, the standard deviation was at most 0.10 for correct patterns and at
least 0.2 for wrong patterns."""
_MODULE_OFF = 0.4
"""Maximum deviation of a module's mean from the pattern, relative to the contrast."""
_MODULES_WRONG = 0.04
_PRINTED = 0.02
"""Part of the standard deviation of a fitted corner, in pixels, that does not depend on the noise.
Errors due to sharpening and compression of the image do not average out (measured on
photographs)."""


_TANH = 0.7978846, 0.0356774
"""Coefficients a and b of 1/2 + tanh(a z + b z^3) / 2. This function approximates the normal
distribution function to 3e-4 and takes a tenth of its computing time."""
_UNIT = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class PatternFit:
    """Result of a pattern fit.

    It holds corners (4, 2) in pixels, their covariance (8, 8) in pixels^2, and grey levels of black
    and white.
    """

    corners: Array
    covariance: Array
    black: float
    white: float


def fit_pattern(image: Image, quad: Array, pattern: NDArray[np.bool_]) -> PatternFit | None:
    """Fit the marker with this pattern near the corners ``quad`` (4, 2), which must be accurate to
    half a module.

    Returns None if the pattern does not explain the pixels everywhere, for example because of
    another marker, partial occlusion or motion blur.
    """
    chosen = _pixels(image, quad, pattern.shape[0])
    if chosen is None:
        return None
    try:
        return _fit(*chosen, quad, pattern)
    except np.linalg.LinAlgError:
        return None


def _fit(pixels: Array, grey: Array, quad: Array, pattern: NDArray[np.bool_]) -> PatternFit | None:
    black = (~pattern).astype(float)
    corners, blur = quad.astype(float), _BLUR
    middle = quad.mean(axis=0)
    matrix = _to_marker(corners - middle)
    places = np.column_stack([pixels - middle, np.ones(len(pixels))])
    gain = float(np.ptp(grey))
    weight = np.ones(len(grey))
    reach = max(1.0, 0.5 * float(np.ptp(pixels, axis=0).max()))
    x, y = ((pixels - pixels.mean(axis=0)) / reach).T
    for _ in range(_ROUNDS):
        value, slopes = _model(places @ matrix.T, matrix, blur, black)
        light = np.stack([np.ones_like(value), value, x * value, y * value], axis=-1)
        columns = np.concatenate([gain * slopes, light], axis=1)
        weighted = columns * weight[:, None]
        information = weighted.T @ columns
        information[np.diag_indices(9)] += 1e-6 * np.trace(information[:8, :8]) / 8.0
        answer = np.linalg.solve(information, weighted.T @ grey)
        if not np.isfinite(answer).all():
            return None
        matrix, step = _stepped(matrix, answer[:8], corners - middle)
        corners = corners + step
        blur = float(np.clip(blur + np.clip(answer[8], -0.3, 0.3), _MIN_BLUR, _MAX_BLUR))
        gain = max(float(answer[10]), 1.0)
        residual = grey - columns @ answer
        spread = max(1.4826 * float(np.median(np.abs(residual))), 0.5)
        weight = np.minimum(1.0, 3.0 * spread / np.maximum(np.abs(residual), 1e-6))
        if float(np.abs(step).max()) < _CONVERGED:
            break
    else:
        return None
    modules = pattern.shape[0]
    side = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).min())
    if side < _MIN_MODULE * modules:
        return None
    if np.abs(corners - quad).max() > max(_MAX_CORNER_SHIFT * side / modules, 1.0):
        return None
    contrast = float(answer[10])
    slope = weight * (columns[:, 2] ** 2 + columns[:, 5] ** 2)
    unexplained = float(np.sqrt((slope * residual**2).sum() / max(float(slope.sum()), 1e-9)))
    noise = max(unexplained, float(np.sqrt((residual**2).mean())), 0.5)
    if contrast < _MIN_CONTRAST or noise > _MAX_UNEXPLAINED * contrast:
        return None
    seen = places @ matrix.T
    if not _whole(0.5 * modules * (seen[:, :2] / seen[:, 2:] + 1.0), residual / contrast, modules):
        return None
    moves = _moves(matrix, corners - middle)
    covariance = moves @ np.linalg.inv(information)[:8, :8] @ moves.T
    # Residuals of neighbouring pixels are correlated, so their number of independent values is
    # lower and the covariance higher.
    covariance *= noise**2 * _alike(pixels, residual)
    covariance += _PRINTED**2 * np.eye(8)
    if _side_deviation(corners, covariance) > _VAGUE * side / modules:
        return None
    black_level = float(answer[9])
    return PatternFit(corners, covariance, black_level, black_level + contrast)


def _pixels(image: Image, quad: Array, modules: int) -> tuple[Array, Array] | None:
    """Positions (N, 2) and grey values (N,) of the pixels on the marker and part of its margin."""
    if not np.isfinite(quad).all():
        return None
    middle = quad.mean(axis=0)
    wider = middle + (quad - middle) * (1.0 + 2.0 * _QUIET / modules)
    low = np.floor(wider.min(axis=0)).astype(int)
    high = np.ceil(wider.max(axis=0)).astype(int) + 1
    height, width = image.shape
    if (low < 0).any() or high[0] > width or high[1] > height:
        return None
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.rint((wider - low) * 16).astype(np.int32), [1], shift=4)
    rows, columns = np.nonzero(mask)
    if len(rows) < 40:
        return None
    pixels = np.stack([columns + low[0], rows + low[1]], axis=-1).astype(float)
    return pixels, image[rows + low[1], columns + low[0]].astype(float)


def _to_marker(corners: Array) -> Array:
    """Homography (3, 3) from the image to the marker with corners at -1 and 1 (right, down)."""
    matrix = cv2.getPerspectiveTransform(corners.astype(np.float32), _UNIT.astype(np.float32))
    return np.asarray(matrix, dtype=float)


def _model(seen: Array, matrix: Array, blur: float, black: Array) -> tuple[Array, Array]:
    """Predicted pattern and its derivatives at the homogeneous marker coordinates ``seen`` (N, 3).

    The pattern (N,) is 0 if black and 1 if white. The derivatives (N, 9) are with respect to a
    small homography of the marker (eight parameters, :func:`_fields`) and to the blur.
    """
    modules = black.shape[0]
    places = seen[:, :2] / seen[:, 2:]
    # Scale at the centre of the marker: modules per pixel, along u and v.
    at = matrix[:2, 2] / matrix[2, 2]
    local = (matrix[:2, :2] - np.outer(at, matrix[2, :2])) / matrix[2, 2]
    scales = 0.5 * modules * np.linalg.norm(local, axis=1)
    steps = np.arange(modules + 1)
    boxes, changes, widths = [], [], []
    for axis in (0, 1):
        sigma = blur * scales[axis]
        # Single precision is sufficient: its error is a millionth of the contrast.
        z = ((0.5 * modules * (places[:, axis, None] + 1.0) - steps) / sigma).astype(np.float32)
        bell = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
        boxes.append(-np.diff(0.5 * np.tanh(z * (_TANH[0] + _TANH[1] * z**2)), axis=1))
        changes.append(-np.diff(bell, axis=1) / sigma * 0.5 * modules)
        widths.append(np.diff(bell * z, axis=1) / blur)
    across, down = boxes
    black = black.astype(np.float32)
    rows = down @ black
    value = 1.0 - (rows * across).sum(axis=1)
    by_u = -(rows * changes[0]).sum(axis=1)
    by_v = -((changes[1] @ black) * across).sum(axis=1)
    by_blur = -(rows * widths[0]).sum(axis=1) - ((widths[1] @ black) * across).sum(axis=1)
    along_u, along_v = _fields(places)
    slopes = np.empty((len(places), 9))
    slopes[:, :8] = by_u[:, None] * along_u + by_v[:, None] * along_v
    slopes[:, 8] = by_blur
    return value, slopes


def _fields(places: Array) -> tuple[Array, Array]:
    """Return the derivatives (N, 8) of the coordinate u and the derivatives (N, 8) of the
    coordinate v of points (N, 2) on the marker with respect to the eight parameters of a small
    homography. The matrix of this homography is the identity plus (a b c; d e f; g h 0)."""
    u, v = places.T
    one, none = np.ones_like(u), np.zeros_like(u)
    return (
        np.stack([u, v, one, none, none, none, -u * u, -u * v], axis=-1),
        np.stack([none, none, none, u, v, one, -u * v, -v * v], axis=-1),
    )


def _moves(matrix: Array, corners: Array) -> Array:
    """Derivatives (8, 8) of the corners (4, 2) in the image with respect to a small homography of
    the marker."""
    seen = np.column_stack([corners, np.ones(4)]) @ matrix.T
    places = seen[:, :2] / seen[:, 2:]
    local = matrix[None, :2, :2] - places[:, :, None] * matrix[None, 2:, :2]
    local = local / seen[:, 2, None, None]
    fields = np.stack(_fields(_UNIT), axis=1)
    return np.asarray(-np.linalg.solve(local, fields).reshape(8, 8))


def _stepped(matrix: Array, answer: Array, corners: Array) -> tuple[Array, Array]:
    """Apply a small homography to the matrix, shortened if it moves a corner too far. Return also
    the displacements (4, 2) of the corners in the image."""
    furthest = float(np.abs(_moves(matrix, corners) @ answer).max())
    answer = answer * min(1.0, _LARGEST_STEP / max(furthest, 1e-9))
    change = np.append(answer, 0.0).reshape(3, 3)
    matrix = (np.eye(3) + change) @ matrix
    back = np.column_stack([_UNIT, np.ones(4)]) @ np.linalg.inv(matrix).T
    return matrix, np.asarray(back[:, :2] / back[:, 2:] - corners)


def _whole(places: Array, residual: Array, modules: int) -> bool:
    """Return whether all modules but a few agree with the pattern and the whole margin is white.

    ``places`` (N, 2) are the positions of the pixels, in modules from the top left corner, and
    ``residual`` (N,) are their residuals relative to the contrast.
    """
    cells = np.clip(np.floor(places).astype(int), -1, modules) + 1
    size = modules + 2
    inside = (cells >= 1).all(axis=1) & (cells <= modules).all(axis=1)
    index = cells[:, 1] * size + cells[:, 0]
    number = np.bincount(index, minlength=size * size).reshape(size, size)
    mean = np.bincount(index, residual, size * size).reshape(size, size) / np.maximum(number, 1)
    off = (np.abs(mean) > _MODULE_OFF)[1:-1, 1:-1]
    if off.mean() > _MODULES_WRONG or not inside.any():
        return False
    bands = (
        (float((mean[band] * number[band]).sum()), float(number[band].sum()))
        for band in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1])
    )
    return not any(total > 0 and abs(sum_ / total) > _MODULE_OFF for sum_, total in bands)


def _alike(pixels: Array, residual: Array) -> float:
    """Factor by which correlated errors of neighbouring pixels increase the variance of a mean."""
    low = pixels.min(axis=0).astype(int)
    index = pixels.astype(int) - low
    sheet = np.full(index.max(axis=0) + 2, np.nan)
    sheet[index[:, 0], index[:, 1]] = residual
    power = float((residual**2).mean())
    factor = 1.0
    for first, second in ((sheet[1:], sheet[:-1]), (sheet[:, 1:], sheet[:, :-1])):
        product = first * second
        known = np.isfinite(product)
        likeness = float(product[known].mean()) / max(power, 1e-9) if known.any() else 0.0
        likeness = min(max(likeness, 0.0), 0.8)
        factor *= (1.0 + likeness) / (1.0 - likeness)
    return factor


def _side_deviation(corners: Array, covariance: Array) -> float:
    """Return the standard deviation, in pixels, of the sides of a marker with these corners (4, 2)
    and their covariance (8, 8).

    This standard deviation is large enough that the sides, treated as four independent lines,
    determine neither the position nor the angle of the marker more accurately than the corners do.
    """
    to_middle = np.tile(np.eye(2), 4) / 4.0
    place = float(np.linalg.eigvalsh(to_middle @ covariance @ to_middle.T).max())
    arm = corners - corners.mean(axis=0)
    turn = np.stack([-arm[:, 1], arm[:, 0]], axis=-1).reshape(-1) / (arm**2).sum()
    angle = float(turn @ covariance @ turn)
    side = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
    # Four lines with the variance s^2 determine the position of a square with the variance s^2 / 2,
    # and its angle with the variance 3 s^2 / side^2.
    return float(np.sqrt(max(2.0 * place, angle * side**2 / 3.0)))


def as_edges(fit: PatternFit) -> MarkerEdges:
    """Convert a fitted pattern to the sides of one marker.

    The sides are treated as independent lines. Their noise is chosen large enough that neither the
    position nor the angle of the marker appears more accurate than it is.
    """
    corners = fit.corners
    along = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(along, axis=1)
    rows = max(float(length.mean()), 4.0)
    deviation = _side_deviation(corners, fit.covariance)
    share = (np.arange(BINS) + 0.5) / BINS
    points = corners[:, None] + share[None, :, None] * along[:, None]
    return MarkerEdges(
        points=points[None],
        weights=np.full((1, 4, BINS), rows / BINS),
        corners=corners[None],
        spread=np.array([deviation * np.sqrt(rows)]),
        black=np.array([fit.black]),
        white=np.array([fit.white]),
        pull=np.zeros(1),
        good=np.ones(1, dtype=bool),
    )
