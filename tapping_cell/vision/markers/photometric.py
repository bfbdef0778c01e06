"""Photometric alignment of a marker at rest, using every pixel of the pattern.

The grey values are modelled by the blurred printed pattern, projected by the known camera at the
known height. The pose has three unknowns. The parameters of illumination and ink are linear: a gain
and an offset, each with a gradient across the marker. To first order, the deviation of the blur
from the assumed blur is also a linear parameter. Gauss-Newton starts from the pose given by the
edges (Lucas and Kanade 1981; Baker and Matthews 2004 for the family of methods). A symmetric blur
moves no edge, so it causes no bias.

Smoothing, sharpening and compression make the noise of neighbouring pixels correlated. This
correlation is estimated from the autocorrelation of the residuals, and the covariance is corrected
for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray
from scipy import fft

from tapping_cell.vision.camera import Array, CameraModel, Image, View
from tapping_cell.vision.markers.detection import ObjectMarker, marker_pattern

_MARGIN = 0.4
"""Width of the used part of the white border, in modules; an adjacent object may begin beyond this
part."""
_LARGEST_STEP = 0.5
"""Maximum distance of the result from the initial pose, in pixels. The initial pose comes from the
edges, and its error is smaller than this distance."""
_SMALLEST_STEP = 0.002
"""Step size, in pixels, below which Gauss-Newton has converged (a tenth of the error due to
noise)."""
_POSE = slice(11, 14)
"""Columns of the design matrix for the pose of the marker (x, y, theta)."""
_LAGS = 4
"""Maximum lag, in pixels, of the noise autocorrelation."""
_MIN_POWER = 0.1
"""Lower limit of the estimated power of the noise at every spatial frequency, relative to white
noise."""
_SAME_PLACE = 0.03
"""Distance in pixels up to which the linearisation is reused. At this distance, the second-order
error is at most a thousandth of a pixel. If the marker does not move, noise alone displaces the
result by a fifth of this distance. There, the second-order error is below 5e-5 pixel."""
_SAME_LIGHT = 0.05
"""Maximum relative change of the contrast for which the linearisation is reused."""


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """The blurred pattern around its centre.

    ``texture`` (n, n, 4) holds the value (0 black, 1 white), its derivatives along u and v, and its
    Laplacian (per m, per m^2). ``blur`` is the Gaussian's sigma in m.
    """

    texture: NDArray[np.float32]
    texel: float
    blur: float


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Result of an alignment.

    ``pose`` (3,) of the marker is in ``table``, and its ``covariance`` (3, 3) is due to pixel
    noise. ``unexplained`` is the root mean square residual at edges of the pattern, in grey levels,
    and ``blur`` the best-fitting sigma in m.
    """

    pose: Array
    covariance: Array
    unexplained: float
    blur: float
    linearisation: Linearisation


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """An alignment linearised at ``pose`` (3,), for frames in which the marker has not moved.

    The linearisation holds the pixels on the marker (flat indices), the design matrix (N, 14) and
    its normal matrix (14, 14). ``light`` (3,) is the contrast and its gradients. ``together`` (3,
    3) corrects the covariance for correlated noise, see :func:`_together`.
    """

    pixels: NDArray[np.intp]
    columns: Array
    normal: Array
    pose: Array
    light: Array
    template: Template
    pixel: float
    together: Array


def make_template(marker: ObjectMarker, pixel: float, blur: float) -> Template:
    """Create the template of a marker; a pixel is ``pixel`` m wide on the marker."""
    pattern = marker_pattern(marker.dictionary, marker.id)
    module = marker.size / pattern.shape[0]
    each = int(np.clip(math.ceil(3.5 * module / pixel), 3, 48))
    texel = module / each
    sheet = np.kron(np.pad(pattern, 2, constant_values=True), np.ones((each, each)))
    sigma = blur / texel
    soft = cv2.GaussianBlur(sheet, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    down, right = np.gradient(soft, texel)
    laplacian = np.gradient(right, texel, axis=1) + np.gradient(down, texel, axis=0)
    # Rows increase downwards, v increases upwards.
    return Template(np.stack([soft, right, -down, laplacian], -1).astype(np.float32), texel, blur)


def align(
    image: Image, view: View, template: Template, marker: ObjectMarker, start: Array
) -> Alignment | None:
    """Align the marker near ``start`` (3,), which must be accurate to a fraction of a pixel.

    Returns None if the fit does not converge there or the pattern does not explain the image.
    """
    pixels = _pixels(image, view, marker, start)
    if pixels is None:
        return None
    x, y, chosen = pixels
    grey = image.reshape(-1)[chosen].astype(float)
    pixel = float(view.pose.translation[2]) / view.camera.fx
    pose = start.copy()
    weight: Array | None = None
    gain = np.full(x.shape, float(np.ptp(grey)))
    for iteration in range(6):
        columns, fixed = _columns(template, marker, x, y, pose, gain)
        weighted = columns if weight is None else columns * weight[:, None]
        information = weighted.T @ columns
        try:
            answer = np.linalg.solve(information, weighted.T @ grey)
        except np.linalg.LinAlgError:
            return None
        step = answer[_POSE]
        pose = pose + step
        gain = fixed @ answer[:3]
        size = _displacement(step, marker) / pixel
        if not math.isfinite(size) or size > _LARGEST_STEP:
            return None
        residual = grey - columns @ answer
        robust, spread = _robust_weights(residual)
        if weight is not None and size < _SMALLEST_STEP:
            break
        if iteration > 0 or size < 0.05:
            weight = robust
    else:
        return None
    moved = pose - start
    if math.hypot(moved[0], moved[1]) > _LARGEST_STEP * pixel:
        return None
    normal = columns.T @ columns
    answers = np.linalg.inv(information)[_POSE]
    influence = weighted @ np.linalg.solve(np.linalg.cholesky(answers[:, _POSE]), answers).T
    together = _together(chosen, image.shape[1], influence, weight * residual)
    linearisation = Linearisation(
        chosen, columns, normal, pose - step, answer[:3], template, pixel, together
    )
    return _judged(linearisation, answer, residual, weight, information, spread)


def align_again(
    image: Image, linearisation: Linearisation, marker: ObjectMarker, start: Array
) -> Alignment | None:
    """Align the marker in a frame in which, according to the edges (``start``), it has not moved.

    One step of Gauss-Newton from the last alignment suffices. This step takes a tenth of the time
    of :func:`align`. None means only that the marker or the illumination changed, not that the
    marker is absent.
    """
    gap = start - linearisation.pose
    if math.hypot(gap[0], gap[1]) > _LARGEST_STEP * linearisation.pixel:
        return None
    columns = linearisation.columns
    grey = image.reshape(-1)[linearisation.pixels].astype(float)
    product = grey @ columns
    residual = grey - columns @ np.linalg.solve(linearisation.normal, product)
    weight, spread = _robust_weights(residual)
    # Nearly all pixels have full weight. The normal matrix for full weights is known, so only the
    # missing weights of the other pixels are subtracted from it.
    less = np.flatnonzero(weight < 1.0)
    excluded = columns[less]
    lost = excluded.T * (1.0 - weight[less])
    information = linearisation.normal - lost @ excluded
    try:
        answer = np.linalg.solve(information, product - lost @ grey[less])
    except np.linalg.LinAlgError:
        return None
    step = answer[_POSE]
    size = _displacement(step, marker) / linearisation.pixel
    light = linearisation.light
    change = float(np.abs(answer[:3] - light).max()) / abs(float(light[0]))
    if not size < _SAME_PLACE or not change < _SAME_LIGHT:
        return None
    residual = grey - columns @ answer
    return _judged(linearisation, answer, residual, weight, information, spread)


def _displacement(step: Array, marker: ObjectMarker) -> float:
    """Displacement in m of the marker's sides by a step (x, y, theta)."""
    return max(math.hypot(step[0], step[1]), abs(float(step[2])) * 0.5 * marker.size)


def _robust_weights(residual: Array) -> tuple[Array, float]:
    """Return Huber's weights (N,) of residuals (N,), and the robust standard deviation on which
    they are based."""
    off = np.abs(residual)
    spread = 1.4826 * float(np.median(off))
    return np.minimum(1.0, 3.0 * max(spread, 0.3) / np.maximum(off, 1e-6)), spread


def _judged(
    linearisation: Linearisation,
    answer: Array,
    residual: Array,
    weight: Array,
    information: Array,
    spread: float,
) -> Alignment | None:
    """Evaluate the last step of an alignment; None if the pattern does not explain the image."""
    columns, template, pixel = linearisation.columns, linearisation.template, linearisation.pixel
    contrast = float(answer[0])
    noise = max(math.sqrt(float((weight * residual**2).sum() / weight.sum())), spread, 0.3)
    # The residuals at edges determine the pose error and show where the image deviates from the
    # pattern.
    slope = weight * (columns[:, _POSE][:, :2] ** 2).sum(axis=1)
    unexplained = math.sqrt(float((slope * residual**2).sum() / slope.sum()))
    noise = max(noise, unexplained)
    if contrast < 12.0 or noise > 0.12 * contrast:
        return None
    root = np.linalg.cholesky(np.linalg.inv(information)[_POSE, _POSE]) * noise
    covariance = np.asarray(root @ linearisation.together @ root.T, dtype=float)
    softening = template.blur**2 + 2.0 * float(answer[6])
    blur = math.sqrt(max(softening, (0.3 * pixel) ** 2))
    return Alignment(
        linearisation.pose + answer[_POSE], covariance, unexplained, blur, linearisation
    )


def _together(
    chosen: NDArray[np.intp], width: int, influence: Array, residual: Array
) -> NDArray[np.float64]:
    """Return the covariance (3, 3) of the whitened pose parameters. The result is the identity if
    the noise of the pixels is independent, because the whitening assumes independent noise.

    ``influence`` (N, 3) are the derivatives of the whitened parameters with respect to the pixels
    ``chosen`` (flat indices, rows of ``width``). The correlation of the noise is estimated from the
    autocorrelation of ``residual`` (N,) and propagated to the parameters by the influence. This is
    the sandwich estimator of Huber 1967 and White 1980, for noise that is stationary over the
    marker.
    """
    rows, columns = np.divmod(chosen, width)
    rows, columns = rows - rows.min(), columns - columns.min()
    shape = int(rows.max()) + 1, int(columns.max()) + 1
    # Single precision is sufficient, because this correction of the covariance is known to 1 % at
    # best.
    maps = np.zeros((5, *shape), dtype=np.float32)
    maps[:, rows, columns] = np.vstack([influence.T, residual, np.ones(len(residual))])
    size = [fft.next_fast_len(n + _LAGS, real=True) for n in shape]
    waves = fft.rfft2(maps, size)
    products, pairs = fft.irfft2(np.abs(waves[3:]) ** 2, size)
    lags = np.arange(-_LAGS, _LAGS + 1)
    near = np.ix_(lags, lags)
    kernel = np.zeros(size, dtype=np.float32)
    kernel[near] = products[near] / pairs[near] * (pairs[0, 0] / max(products[0, 0], 1e-9))
    power = np.maximum(fft.rfft2(kernel).real, _MIN_POWER)
    filtered = fft.irfft2(waves[:3] * power, size)[:, : shape[0], : shape[1]]
    apart = maps[:3].reshape(3, -1) @ filtered.reshape(3, -1).T - influence.T @ influence
    return np.asarray(np.eye(3) + 0.5 * (apart + apart.T), dtype=float)


def _pixels(
    image: Image, view: View, marker: ObjectMarker, start: Array
) -> tuple[Array, Array, NDArray[np.intp]] | None:
    """Return the projections of the marker's pixels to its plane (x and y in ``table``, in m), and
    the flat indices of these pixels; None if the marker is partly outside the image or too
    small."""
    modules = marker_pattern(marker.dictionary, marker.id).shape[0]
    reach = marker.size * (0.5 + _MARGIN / modules)
    cos, sin = math.cos(start[2]), math.sin(start[2])
    square = reach * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    corners = square @ np.array([[cos, sin], [-sin, cos]]) + start[:2]
    seen = view.project(corners, marker.height)
    x0, y0 = np.floor(seen.min(axis=0)).astype(int)
    x1, y1 = np.ceil(seen.max(axis=0)).astype(int) + 1
    camera = view.camera
    if x0 < 0 or y0 < 0 or x1 > camera.width or y1 > camera.height:
        return None
    points = view.rays_on_plane(window_rays(camera, x0, y0, x1, y1), marker.height)
    x, y = points[..., 0], points[..., 1]
    dx, dy = x - start[0], y - start[1]
    inside = np.maximum(np.abs(cos * dx + sin * dy), np.abs(cos * dy - sin * dx)) < reach
    chosen = np.flatnonzero(inside)
    # The textures are sampled in rows of 64 pixels, so the pixels that do not fill a row are
    # omitted.
    chosen = chosen[: len(chosen) // 64 * 64]
    if len(chosen) < 256:
        return None
    rows, columns = np.divmod(chosen, x1 - x0)
    return x.ravel()[chosen], y.ravel()[chosen], (rows + y0) * image.shape[1] + columns + x0


def _columns(
    template: Template, marker: ObjectMarker, x: Array, y: Array, pose: Array, gain: Array
) -> tuple[Array, Array]:
    """Design matrix (N, 14), and the three functions (N, 3) by which the gain may vary across the
    marker: constant, and linear along both axes.

    The columns are: gain and its gradients, offset and its gradients, blur, nonlinear grey levels
    at blurred edges (gamma, ink bleeding), two stretches and a shear, x, y, theta.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = x - pose[0], y - pose[1]
    u, v = cos * dx + sin * dy, cos * dy - sin * dx
    middle = 0.5 * template.texture.shape[0] - 0.5
    found = cv2.remap(
        template.texture,
        (u / template.texel + middle).astype(np.float32).reshape(-1, 64),
        (middle - v / template.texel).astype(np.float32).reshape(-1, 64),
        cv2.INTER_LINEAR,
    ).reshape(-1, 4)
    value = found[:, 0]
    by_u, by_v = gain * found[:, 1], gain * found[:, 2]
    across, up = u / marker.size, v / marker.size
    fixed = np.stack([np.ones_like(u), across, up], axis=-1)
    columns = np.empty((len(u), 14))
    columns[:, :3] = fixed * value[:, None]
    columns[:, 3:6] = fixed
    columns[:, 6] = gain * found[:, 3]
    columns[:, 7] = gain * value * (1.0 - value)
    columns[:, 8] = u * by_u
    columns[:, 9] = v * by_v
    columns[:, 10] = v * by_u + u * by_v
    columns[:, 11] = -cos * by_u + sin * by_v
    columns[:, 12] = -sin * by_u - cos * by_v
    columns[:, 13] = v * by_u - u * by_v
    return columns, fixed


def window_rays(camera: CameraModel, x0: int, y0: int, x1: int, y1: int) -> Array:
    """Directions (y1 - y0, x1 - x0, 2) of the pixels of an image window.

    The directions are exact at 8 x 8 Chebyshev nodes and are interpolated by a polynomial between
    them. The error is below 1e-6 pixel for windows of a few hundred pixels, because the distortion
    of a lens varies smoothly.
    """
    degree = 7
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    half_x, half_y = 0.5 * (x1 - 1 - x0) + 0.5, 0.5 * (y1 - 1 - y0) + 0.5
    mid_x, mid_y = 0.5 * (x0 + x1 - 1), 0.5 * (y0 + y1 - 1)
    grid = np.stack(np.meshgrid(mid_x + half_x * nodes, mid_y + half_y * nodes), axis=-1)
    known = camera.rays(grid)
    inverse = np.linalg.inv(chebvander(nodes, degree))
    at_x = chebvander((np.arange(x0, x1) - mid_x) / half_x, degree) @ inverse
    at_y = chebvander((np.arange(y0, y1) - mid_y) / half_y, degree) @ inverse
    return np.stack([at_y @ known[..., i] @ at_x.T for i in (0, 1)], axis=-1)
