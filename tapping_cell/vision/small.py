"""Markers too small for their edges: the whole printed pattern is fitted to the pixels.

Where a module is only one to four pixels wide, the pixels beside an edge already belong to the next
module, and no level of black or white can be read there. The pattern itself is known, though: its
image is a sum of steps along both sides of each module, blurred (the normal distribution function),
under a light that changes across it. Gauss-Newton moves the four corners, the blur and the light
until the pattern explains the pixels (Lucas and Kanade 1981 with a homography); what it does not
explain gives the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from tapping_cell.vision.camera import Array, Image
from tapping_cell.vision.edges import BINS, MarkerEdges

_QUIET = 0.6
"""Modules of the white margin that take part: narrow margins have one."""
_BLUR, _LEAST_BLUR, _MOST_BLUR = 0.7, 0.35, 2.5
"""Sigma in pixels: at the start, and bounds."""
_ROUNDS = 15
_LARGEST_STEP = 0.6
"""Pixels that a corner may move in one round."""
_CONVERGED = 0.01
_STRAYED = 0.9
"""Modules that a corner may lie from where the search saw it."""
_LEAST_CONTRAST = 12.0
_MOST_UNEXPLAINED = 0.2
"""Root mean square of what remains, over the contrast."""
_MODULE_OFF = 0.4
"""Of the contrast, by which the mean of a module may differ from the pattern."""
_MODULES_WRONG = 0.04
_PRINTED = 0.02
"""Pixels by which such a corner may be off whatever the noise: sharpening and compression of the
picture are no noise that averages out (measured on photographs)."""


@dataclass(frozen=True, slots=True, eq=False)
class PatternFit:
    """Corners (4, 2) in pixels, their covariance (8, 8) in pixels^2, grey levels of black and
    white, and the blur (sigma in pixels)."""

    corners: Array
    covariance: Array
    black: float
    white: float
    blur: float


def fit_pattern(image: Image, quad: Array, pattern: NDArray[np.bool_]) -> PatternFit | None:
    """The marker with this pattern near corners ``quad`` (4, 2), right to half a module.

    None if the pattern does not explain the pixels, or not everywhere: another marker, something
    that covers a part of it, smear by motion.
    """
    chosen = _pixels(image, quad, pattern.shape[0])
    if chosen is None:
        return None
    pixels, grey = chosen
    black = (~pattern).astype(float)
    corners, blur = quad.astype(float), _BLUR
    gain = float(np.ptp(grey))
    weight = np.ones(len(grey))
    reach = max(1.0, 0.5 * float(np.ptp(pixels, axis=0).max()))
    x, y = ((pixels - pixels.mean(axis=0)) / reach).T
    for _ in range(_ROUNDS):
        value, slopes = _model(pixels, corners, blur, black)
        light = np.stack([np.ones_like(value), value, x * value, y * value], axis=-1)
        columns = np.concatenate([gain * slopes, light], axis=1)
        weighted = columns * weight[:, None]
        information = weighted.T @ columns
        information[np.diag_indices(9)] += 1e-6 * np.trace(information[:8, :8]) / 8.0
        try:
            answer = np.linalg.solve(information, weighted.T @ grey)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(answer).all():
            return None
        step = answer[:8]
        step = step * min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-9))
        corners = corners + step.reshape(4, 2)
        blur = float(np.clip(blur + np.clip(answer[8], -0.3, 0.3), _LEAST_BLUR, _MOST_BLUR))
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
    if np.abs(corners - quad).max() > max(_STRAYED * side / modules, 1.0):
        return None
    contrast = float(answer[10])
    slope = weight * (columns[:, :8] ** 2).sum(axis=1)
    unexplained = float(np.sqrt((slope * residual**2).sum() / max(float(slope.sum()), 1e-9)))
    noise = max(unexplained, float(np.sqrt((residual**2).mean())), 0.5)
    if contrast < _LEAST_CONTRAST or noise > _MOST_UNEXPLAINED * contrast:
        return None
    if not _whole(pixels, corners, residual / contrast, modules):
        return None
    # What is left is alike in neighbouring pixels: fewer are independent than there are.
    covariance = np.linalg.inv(information)[:8, :8] * noise**2 * _alike(pixels, residual)
    covariance += _PRINTED**2 * np.eye(8)
    return PatternFit(corners, covariance, float(answer[9]), float(answer[9]) + contrast, blur)


def _pixels(image: Image, quad: Array, modules: int) -> tuple[Array, Array] | None:
    """Places (N, 2) and grey values (N,) of the pixels on the marker and a part of its margin."""
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


def _within(pixels: Array, corners: Array, modules: int) -> tuple[Array, Array]:
    """Places (N, 2) of pixels in modules (u right, v down) and the matrix from the image there."""
    square = np.array([[0, 0], [modules, 0], [modules, modules], [0, modules]], dtype=np.float32)
    middle = corners.mean(axis=0)
    corners = (corners - middle).astype(np.float32)
    matrix: Array = np.array(cv2.getPerspectiveTransform(corners, square), dtype=float)
    seen = (pixels - middle) @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(seen[:, :2] / seen[:, 2:], dtype=float), matrix


def _model(pixels: Array, corners: Array, blur: float, black: Array) -> tuple[Array, Array]:
    """The pattern (N,), 0 black and 1 white, as the pixels see it, and how it answers the corners'
    eight coordinates and the blur (N, 9)."""
    modules = black.shape[0]
    places, matrix = _within(pixels, corners, modules)
    # At the middle of the marker: d(u, v) / d(x, y), and what the blur is along u and v.
    at = matrix[:2, 2] / matrix[2, 2]
    local = (matrix[:2, :2] - np.outer(at, matrix[2, :2])) / matrix[2, 2]
    scales = np.linalg.norm(local, axis=1)
    steps = np.arange(modules + 1)
    boxes, changes, widths = [], [], []
    for axis in (0, 1):
        sigma = blur * scales[axis]
        z = (places[:, axis, None] - steps) / sigma
        bell = np.exp(-0.5 * z**2) / (np.sqrt(2.0 * np.pi) * sigma)
        boxes.append(-np.diff(ndtr(z), axis=1))
        changes.append(-np.diff(bell, axis=1))
        widths.append(np.diff(bell * z, axis=1) * scales[axis])
    across, down = boxes
    rows = down @ black
    value = 1.0 - (rows * across).sum(axis=1)
    by_u = -(rows * changes[0]).sum(axis=1)
    by_v = -((changes[1] @ black) * across).sum(axis=1)
    by_blur = -(rows * widths[0]).sum(axis=1) - ((widths[1] @ black) * across).sum(axis=1)
    slopes = np.empty((len(pixels), 9))
    small = 0.01
    for k in range(8):
        moved = corners.copy()
        moved[k // 2, k % 2] += small
        change = (_within(pixels, moved, modules)[0] - places) / small
        slopes[:, k] = by_u * change[:, 0] + by_v * change[:, 1]
    slopes[:, 8] = by_blur
    return value, slopes


def _whole(pixels: Array, corners: Array, residual: Array, modules: int) -> bool:
    """Is the pattern right in every module but a few, and the margin white on all sides?

    ``residual`` (N,) is over the contrast.
    """
    places, _ = _within(pixels, corners, modules)
    cells = np.clip(np.floor(places).astype(int), -1, modules) + 1
    size = modules + 2
    inside = (cells >= 1).all(axis=1) & (cells <= modules).all(axis=1)
    index = cells[:, 1] * size + cells[:, 0]
    number = np.bincount(index, minlength=size * size).reshape(size, size)
    mean = np.bincount(index, residual, size * size).reshape(size, size) / np.maximum(number, 1)
    off = (np.abs(mean) > _MODULE_OFF)[1:-1, 1:-1]
    if off.mean() > _MODULES_WRONG or not inside.any():
        return False
    for band, counts in (
        (mean[0], number[0]),
        (mean[-1], number[-1]),
        (mean[:, 0], number[:, 0]),
        (mean[:, -1], number[:, -1]),
    ):
        total = float(counts.sum())
        if total > 0 and abs(float((band * counts).sum()) / total) > _MODULE_OFF:
            return False
    return True


def _alike(pixels: Array, residual: Array) -> float:
    """By how much the variance of a mean grows because neighbouring pixels' errors are alike."""
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


def as_edges(fit: PatternFit) -> MarkerEdges:
    """A fitted pattern as the sides of one marker.

    The sides count as independent lines there; their noise is made so large that neither the place
    nor the angle of the marker seems better known than it is.
    """
    corners = fit.corners
    along = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(along, axis=1)
    rows = max(float(length.mean()), 4.0)
    to_middle = np.tile(np.eye(2), 4) / 4.0
    place = float(np.linalg.eigvalsh(to_middle @ fit.covariance @ to_middle.T).max())
    arm = corners - corners.mean(axis=0)
    turn = np.stack([-arm[:, 1], arm[:, 0]], axis=-1).reshape(-1) / (arm**2).sum()
    angle = float(turn @ fit.covariance @ turn)
    # Four lines of variance s^2 place a square to s^2 / 2 and turn it to 3 s^2 / side^2.
    variance = max(2.0 * place, angle * rows**2 / 3.0)
    share = (np.arange(BINS) + 0.5) / BINS
    points = corners[:, None] + share[None, :, None] * along[:, None]
    return MarkerEdges(
        points=points[None],
        weights=np.full((1, 4, BINS), rows / BINS),
        corners=corners[None],
        spread=np.array([np.sqrt(variance * rows)]),
        black=np.array([fit.black]),
        white=np.array([fit.white]),
        pull=np.zeros(1),
        good=np.ones(1, dtype=bool),
    )
