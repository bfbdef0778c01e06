"""Fit an outline to an image, using all pixels in a band along the rim and around the dot.

In the model (``model.py``), the grey levels of top, wall and surroundings are fitted separately in
every sector of the rim, because light, shadows and reflections of the wall differ around the
object. The rim is therefore located as an edge, not at a fixed grey level. A wall too narrow to be
distinguished from the edge increases the covariance. Occluded sectors are outliers and are
excluded. The solver is Gauss-Newton, with the levels eliminated sector by sector (Schur
complement). For a stationary object, the last linearisation, levels and weights are used again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.outline.model import (
    BLUR,
    DOT_SIZE,
    GLOBALS,
    LEVELS,
    SIZE,
    SMEAR,
    Band,
    Shape,
    dot_model,
    rim_model,
)
from tapping_cell.vision.outline.pixels import (
    MAX_PIXELS,
    ROUGH_PIXELS,
    SOFTENED,
    Pixels,
    dot_pixels,
    rim_pixels,
    sectors_a_side,
    sectors_of,
    softened,
)
from tapping_cell.vision.outline.shape import ObjectOutline

FINE = 4.5
COARSE = 10.0
"""Half width of the band in pixels: ``FINE`` for a fine fit, ``COARSE`` for a coarse fit."""
USUAL_BLUR = 0.75
MIN_CONTRAST = 8.0
"""Minimum difference in grey levels between top and surroundings, and between dot and top."""
SIZE_SPREAD = 0.004
"""Standard deviation of an object's size, relative to the size in its file."""
_EVEN = 0.02
"""Usual deviation of the position of a single sector from that of the whole rim, in pixels, for an
object with a sharp, regular rim."""
_SLOPE_SPREAD = 0.5
"""Standard deviation of the brightness gradient across the rim, in grey levels per pixel."""
_SMEARED = 2.0
"""Motion from frame to frame, in pixels, above which motion blur of the rim is modelled."""
_SAME_PLACE = 0.15
"""Distance in pixels up to which the linearisation is reused. An edge is antisymmetric, so the
error of a step is of third order, 0.005 pixel at this distance."""
_SAME_LIGHT = 0.05
"""Maximum relative change of the contrast for which the linearisation is reused."""
_LONG = 0.15
"""Minimum length of a long side of a polygon, as a fraction of the length of the rim."""
_BRIGHTEST = 2.5
"""The noise of a sector is assumed to increase with the sector's brightness, up to this multiple of
the brightness of a typical sector."""
_ROUNDS_AGAIN, _STEADY = 4, 0.004
"""Maximum number of iterations in :func:`fit_again`, and the change (pixels) below which they
stop."""


@dataclass(frozen=True, slots=True, eq=False)
class OutlineFit:
    """Result of an outline fit.

    ``pose`` (3,) is the object's pose in ``table`` (m, m, rad) and ``covariance`` (3, 3) is due to
    pixel noise. ``size`` is the apparent size (1: as configured). ``seen`` is the fraction of the
    rim that agrees with the model, and ``least_side`` the lowest such fraction among a polygon's
    long sides. ``contrast`` and ``dot_contrast`` are the contrasts of the rim and of the dot, in
    grey levels; a positive value has the configured sign. ``noise`` is the noise of the pixels in
    grey levels, and ``blur`` a sigma in pixels.
    """

    pose: Array
    covariance: Array
    size: float
    seen: float
    least_side: float
    contrast: float
    dot_contrast: float
    noise: float
    blur: float
    linearisation: Linearisation


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """Constants of a fit. ``pixel`` is the size of a pixel in m at the height of the object's top,
    ``step`` (2,) the object's motion since the last frame in pixels (the cause of motion blur), and
    ``with_dot`` states whether the dot is fitted."""

    outline: ObjectOutline
    pixel: float
    width: float
    step: Array
    measures: bool
    size_spread: float
    with_dot: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Design:
    """The linearised model of the rim and, if it is fitted, of the dot (``dot_model``)."""

    rim: Array
    dot: Array | None


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """State and linearised model of a fit before its last step. Both are used again to measure a
    stationary object."""

    scene: _Scene
    state: _State
    band: Band
    around: Pixels | None
    design: _Design
    contrast: float


def fit_outline(
    image: Image,
    view: View,
    outline: ObjectOutline,
    start: Array,
    *,
    width: float = FINE,
    blur: float = USUAL_BLUR,
    step: Array | None = None,
    with_dot: bool = True,
    size: float = 1.0,
    size_spread: float = SIZE_SPREAD,
) -> OutlineFit | None:
    """Fit the outline near ``start`` (3,), which must be accurate to half of ``width`` pixels.

    ``size`` is the initial size relative to the file, and ``size_spread`` its relative standard
    deviation. ``blur`` is the initial sigma in pixels, and ``step`` (2,) the object's motion since
    the last frame in m. Returns None if the fit fails.
    """
    pixel = (float(view.pose.position[2]) - outline.height) / view.camera.fx
    coarse = width > FINE
    if coarse:
        image = softened(image, view, outline, start, width)
        blur = math.hypot(blur, SOFTENED)
    moving = np.zeros(2) if step is None else np.asarray(step, dtype=float) / pixel
    dot = outline.dot if with_dot else None
    scene = _Scene(outline, pixel, width, moving, not coarse, size_spread, dot is not None)
    smeared = float(np.hypot(*moving)) > _SMEARED
    # For an object with a dot, a fit without the dot provides only the start of a fit with the dot,
    # so the fit without the dot may be rough.
    rough = coarse or smeared or (outline.dot is not None and not with_dot)
    most = ROUGH_PIXELS if rough else MAX_PIXELS
    state = _State(start.copy(), blur, size)
    gathered: Array | None = None
    tolerance, stays = (0.1, 3.0) if coarse else (0.02, 2.0) if rough else (_STEADY, 1.0)
    for _ in range(12 if coarse else 20):
        if gathered is None or np.hypot(*(state.pose - gathered)[:2]) > stays * pixel:
            gathered = state.pose.copy()
            rim = rim_pixels(view, outline, gathered, width, most)
            around = None if dot is None else dot_pixels(view, outline, dot, gathered)
            if rim is None or (dot is not None and around is None):
                return None
            band = Band.of(rim, sectors_of(outline, rim, gathered))
            state.start_anew(band)
            greys = band.grey(image), None if around is None else around.grey(image)
        before = replace(state)
        design = state.design(scene, band, around)
        step = state.solve(scene, design, *greys, band)
        if step is None:
            return None
        moved = state.take(step, scene)
        if np.hypot(*(state.pose - start)[:2]) > width * pixel:
            return None
        if moved < tolerance and state.settled:
            linearisation = Linearisation(scene, before, band, around, design, 0.0)
            return state.answer(linearisation)
    return None


def fit_again(image: Image, linearisation: Linearisation, expected: Array) -> OutlineFit | None:
    """Fit the outline in a frame in which, according to ``expected`` (3,), the object has not
    moved.

    This fit takes a fifth of the time of :func:`fit_outline`. None means only that the object or
    the illumination changed, not that the object is absent.
    """
    scene, band, around = linearisation.scene, linearisation.band, linearisation.around
    if _way(expected - linearisation.state.pose, scene) > 2.0 * _SAME_PLACE:
        return None
    state = replace(linearisation.state)
    greys = band.grey(image), None if around is None else around.grey(image)
    step: Array = np.full(GLOBALS, np.inf)
    for _ in range(_ROUNDS_AGAIN):
        found = state.solve(scene, linearisation.design, *greys, band)
        if found is None:
            return None
        last, step = step, found
        if _way(step - last, scene) < _STEADY:
            break
    if _way(step, scene) > _SAME_PLACE:
        return None
    state.take(step, scene)
    fit = state.answer(linearisation)
    if linearisation.contrast and abs(fit.contrast / linearisation.contrast - 1.0) > _SAME_LIGHT:
        return None
    return fit


def _way(step: Array, scene: _Scene) -> float:
    """Maximum displacement of the object's rim by a step, in pixels."""
    turned = abs(float(step[2])) * scene.outline.reach
    return (math.hypot(step[0], step[1]) + turned) / scene.pixel


def _least_side(outline: ObjectOutline, agrees: NDArray[np.bool_]) -> float:
    """Lowest fraction of agreeing sectors (S,) among a polygon's long sides; 1 for other shapes."""
    if outline.vertices is None:
        return 1.0
    parts = sectors_a_side(outline)
    padded = np.pad(agrees, (0, max(0, int(parts.sum()) - len(agrees))))
    shares = [side.mean() for side in np.split(padded, np.cumsum(parts)[:-1])]
    long = parts >= _LONG * parts.sum()
    return float(min((s for s, counts in zip(shares, long, strict=True) if counts), default=1.0))


@dataclass(slots=True, eq=False)
class _State:
    """State of the Gauss-Newton iteration."""

    pose: Array
    blur: float
    size: float = 1.0
    smear: float = 0.0
    dot_size: float = 1.0
    noise: float = 3.0
    rounds: int = 0
    levels: Array | None = None
    dot_levels: Array | None = None
    weight: Array = field(default_factory=lambda: np.ones(0))
    dot_weight: Array | None = None
    good: NDArray[np.bool_] = field(default_factory=lambda: np.ones(0, dtype=bool))
    """Sectors whose residuals are small."""
    taken: NDArray[np.bool_] = field(default_factory=lambda: np.ones(0, dtype=bool))
    """Sectors that agree with the position of the whole rim."""
    scatter: float = 1.0
    information: Array | None = None

    @property
    def settled(self) -> bool:
        """True if weights and levels have been updated for a few iterations."""
        return self.rounds >= 4

    def start_anew(self, band: Band) -> None:
        """Reset the weights, because the pixels changed. The levels are kept if the number of
        sectors is unchanged."""
        if self.levels is None or len(self.levels) != len(band.counts):
            self.levels = self.dot_levels = None
        self.weight, self.dot_weight = band.real.astype(float), None
        self.good = self.taken = np.ones(len(band.counts), dtype=bool)
        self.rounds = 0 if self.levels is None else 1

    def design(self, scene: _Scene, band: Band, around: Pixels | None) -> _Design:
        """Linearise the model at the current state."""
        shape = Shape(
            self.pose, self.blur, self.size, self.smear, self.dot_size, scene.step, scene.pixel
        )
        dot = scene.outline.dot
        return _Design(
            rim_model(scene.outline, shape, band, self.levels, scene.width),
            None
            if around is None or dot is None
            else dot_model(dot, shape, around, self.dot_levels),
        )

    def solve(
        self, scene: _Scene, design: _Design, grey: Array, dot_grey: Array | None, band: Band
    ) -> Array | None:
        """Solve for the step (GLOBALS,) and the levels that best explain the grey values.

        Updates levels, weights and noise, but does not apply the step. Returns None if the step is
        undetermined.
        """
        sectors = len(band.counts)
        variance = self.noise**2
        prior = self._prior(scene) * variance
        total = np.diag(prior)
        # How far each parameter is from its usual value.
        away = [0.0, 0.0, 0.0, 1.0 - self.size, 0.0, -self.smear, 1.0 - self.dot_size]
        pull = prior * np.array(away)
        both = np.concatenate([design.rim, grey[None]])
        normal = np.matmul((both * self.weight).transpose(1, 0, 2), both.transpose(1, 2, 0))
        precision, usual = self._level_prior(sectors)
        own = normal[:, :LEVELS, :LEVELS] + precision * variance
        mixed = normal[:, :LEVELS, LEVELS:].copy()
        mixed[..., -1] += usual * variance
        answer = np.linalg.solve(own, mixed)
        # Normal equations of each sector after elimination of the levels. Rows and columns: the
        # GLOBALS parameters that all sectors share (model.py), the displacement of this sector's
        # rim, and the grey values (right-hand side).
        left = normal[:, LEVELS:, LEVELS:] - np.matmul(mixed.transpose(0, 2, 1), answer)
        # The levels of an excluded sector are still updated, so that the sector can be included
        # again.
        gate = (self.good & self.taken).astype(float)
        summed = (gate @ left.reshape(sectors, -1)).reshape(left.shape[1:])
        total = total + summed[:GLOBALS, :GLOBALS]
        pull = pull + summed[:GLOBALS, -1]
        if design.dot is not None and dot_grey is not None:
            weighted = design.dot if self.dot_weight is None else design.dot * self.dot_weight
            dot_normal = weighted @ design.dot.T
            dot_pull = weighted @ dot_grey
            inner = np.linalg.inv(dot_normal[:4, :4] + 1e-6 * np.eye(4))
            cross = dot_normal[:4, 4:]
            total += dot_normal[4:, 4:] - cross.T @ inner @ cross
            pull += dot_pull[4:] - cross.T @ inner @ dot_pull[:4]
        try:
            step = np.linalg.solve(total, pull)
        except np.linalg.LinAlgError:
            return None
        if self.levels is None:
            step = np.zeros(GLOBALS)
        if not np.all(np.isfinite(step)):
            return None
        self.levels = answer[..., -1] - answer[..., :GLOBALS] @ step
        residual = grey - (self.levels.T[:, :, None] * design.rim[:LEVELS]).sum(axis=0)
        residual -= np.tensordot(step, design.rim[LEVELS:-1], 1)
        self._judge(scene, residual, band)
        if design.dot is not None and dot_grey is not None:
            self.dot_levels = inner @ (dot_pull[:4] - cross @ step)
            off = np.abs(dot_grey - self.dot_levels @ design.dot[:4] - step @ design.dot[4:])
            self.dot_weight = np.minimum(1.0, 3.0 * self.noise / np.maximum(off, 1e-6))
        self._compare(scene, left, step)
        self.information = total
        self.rounds += 1
        return step

    def answer(self, linearisation: Linearisation) -> OutlineFit:
        """Return the result after convergence."""
        scene, dot = linearisation.scene, linearisation.scene.outline.dot
        assert self.information is not None and self.levels is not None
        sign = 1.0 if scene.outline.brighter else -1.0
        contrast = sign * (self.levels[:, 0] - self.levels[:, 2])
        usual = float(np.median(contrast[self.good])) if self.good.any() else 0.0
        agrees = (
            self.good & self.taken & (contrast > 0.35 * usual) & (contrast > 0.5 * MIN_CONTRAST)
        )
        dot_contrast = 0.0
        if dot is not None and scene.with_dot and self.dot_levels is not None:
            difference = float(self.dot_levels[0] - self.dot_levels[1])
            dot_contrast = difference if dot.brighter else -difference
        covariance = np.linalg.inv(self.information)[:3, :3] * self.noise**2 * self.scatter
        return OutlineFit(
            self.pose,
            np.asarray(covariance, dtype=float),
            self.size,
            float(agrees.mean()),
            _least_side(scene.outline, agrees),
            usual,
            dot_contrast,
            self.noise,
            self.blur,
            linearisation if linearisation.contrast else replace(linearisation, contrast=usual),
        )

    def take(self, step: Array, scene: _Scene) -> float:
        """Apply the step, limited in length. Return the displacement of the rim, in pixels."""
        way = math.inf if self.rounds <= 1 else _way(step, scene)
        limit = 0.5 * scene.width * scene.pixel
        far = max(1.0, math.hypot(step[0], step[1]) / limit)
        step = step / far
        self.pose = self.pose + step[:3]
        self.size = float(np.clip(self.size + step[SIZE], 0.75, 1.35))
        self.dot_size = float(np.clip(self.dot_size + step[DOT_SIZE], 0.5, 2.0))
        if scene.measures:
            self.blur = math.sqrt(float(np.clip(self.blur**2 + step[BLUR], 0.15, 9.0)))
            self.smear = float(np.clip(self.smear + step[SMEAR], 0.0, 0.1))
        return way

    def _compare(self, scene: _Scene, left: Array, step: Array) -> None:
        """Exclude sectors that disagree with the position of the whole rim. Store in ``scatter``
        the mean squared deviation of the remaining sectors relative to their noise, at least 1. The
        covariance is multiplied by this value."""
        power = np.maximum(left[:, GLOBALS, GLOBALS], 1e-9)
        shift = (left[:, GLOBALS, -1] - left[:, GLOBALS, :GLOBALS] @ step) / power
        sigma = self.noise / np.sqrt(power)
        self.taken = np.ones(len(power), dtype=bool)
        clear = self.good & (sigma < 0.5)
        if not scene.measures or self.rounds == 0 or not clear.any():
            return
        score = shift / np.hypot(sigma, _EVEN)
        usual = float(np.clip(1.4826 * np.median(np.abs(score[clear])), 1.0, 3.0))
        self.taken = ~clear | (np.abs(score) < 3.5 * usual)
        kept = clear & self.taken
        self.scatter = max(1.0, float((np.square(shift / sigma)[kept]).mean()))

    def _judge(self, scene: _Scene, residual: Array, band: Band) -> None:
        """Update the weights of pixels and sectors from their residuals."""
        off = np.abs(residual)
        counts = band.counts
        squares = np.square(np.minimum(off, 60.0)) * band.real
        spread = np.sqrt(squares.sum(axis=1) / np.maximum(counts, 1))
        # The limits are wider in a coarse fit, because at first the whole rim fits badly.
        share, factor, margin = (0.3, 1.3, 0.3) if scene.measures else (0.5, 2.5, 1.0)
        ordered = np.sort(spread[counts > 0])
        usual = float(ordered[round(share * (len(ordered) - 1))])
        assert self.levels is not None
        # The limit for a sector increases with its brightness, because noise increases with
        # brightness, and half of the rim may be in a shadow.
        light = np.maximum(self.levels[:, 0], self.levels[:, 2])
        level = float(np.median(light[spread <= usual])) if (spread <= usual).any() else 1.0
        brighter = np.sqrt(np.clip(light / max(level, 1.0), 1.0, _BRIGHTEST))
        self.good = (spread < factor * usual * brighter + margin) & (counts >= 12)
        kept = band.real & self.good[:, None]
        inner = 1.4826 * float(np.median(off[kept])) if kept.any() else usual
        scale = max(inner, 0.3)
        self.weight = np.minimum(1.0, 3.0 * scale / np.maximum(off, 1e-6)) * band.real
        counted = self.weight[self.good]
        left = float((counted * residual[self.good] ** 2).sum() / max(counted.sum(), 1.0))
        self.noise = max(math.sqrt(left), 0.3)

    # -- priors

    def _prior(self, scene: _Scene) -> Array:
        """Return the precisions (GLOBALS,) of the priors of the parameters that are common to all
        sectors. The precisions are very low for the pose."""
        blur = 4.0 if scene.measures else 1e8
        moving = float(np.hypot(*scene.step)) > _SMEARED and scene.measures
        place = 1.0 / (5.0 * scene.pixel) ** 2
        return np.array(
            [place, place, 1.0, scene.size_spread**-2, blur, 1e4 if moving else 1e12, 100.0]
        )

    def _level_prior(self, sectors: int) -> tuple[Array, Array]:
        """Return the precisions (S, LEVELS, LEVELS) of the priors of the levels, and the usual
        levels multiplied by their precisions, (S, LEVELS).

        The precisions are very low for top and surroundings. The usual brightness of the wall is
        half that of the top.
        """
        top = np.full(sectors, 60.0) if self.levels is None else np.abs(self.levels[:, 0])
        precision, usual = np.zeros((sectors, LEVELS, LEVELS)), np.zeros((sectors, LEVELS))
        precision[:, 0, 0] = precision[:, 2, 2] = 1e-6
        precision[:, 1, 1] = 1.0 / (0.5 * top + 10.0) ** 2
        precision[:, 3, 3] = _SLOPE_SPREAD**-2
        usual[:, 1] = 0.5 * top / (0.5 * top + 10.0) ** 2
        return precision, usual
