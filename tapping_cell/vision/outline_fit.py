"""Where an outline lies in an image: all pixels of a band along the rim, and those around the dot.

A pixel near the rim sees the top, the side wall below it or what lies beside the object; which
shares of each follows from its distances to the outline of the top and to the silhouette of the
whole body, both known for a pose from the camera, the shape and the height, through a Gaussian
blur. The grey levels of top, wall and surroundings are free in every sector of the rim (light,
shadows and a shining wall differ around the object), so the rim is where it looks like an edge and
not where it has a certain grey. A wall too narrow to be told from the edge widens the covariance.
Sectors that something covers disagree and are left out. Gauss-Newton; the levels are eliminated
sector by sector (Schur complement).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from tapping_cell.se2 import inverse, transform_points
from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.outline import Dot, ObjectOutline
from tapping_cell.vision.outline_pixels import (
    MOST_PIXELS,
    ROUGH_PIXELS,
    SOFTENED,
    Pixels,
    dot_pixels,
    rim_pixels,
    sectors_of,
    softened,
)

FINE = 4.5
COARSE = 10.0
"""Half widths of the band in pixels: of a measurement, and around a rough place."""
USUAL_BLUR = 0.75
LEAST_CONTRAST = 8.0
"""Grey levels between top and surroundings, and between dot and top, below which neither is
seen."""
_LEVELS = 4  # top, wall, surroundings, and a slope of the light across the rim
_GLOBALS = 7  # x, y, theta, size, blur, blur by motion, size of the dot
_SIZE, _BLUR, _SMEAR, _DOT_SIZE = 3, 4, 5, 6
SIZE_SPREAD = 0.004
"""How much an object's size may differ from the file's without being another object (1 sigma)."""
_EVEN = 0.02
"""Pixels by which a sector of a good rim may differ from the whole."""
_SLOPE_SPREAD = 0.5
"""Usual change of the light across the rim, grey levels a pixel."""
_SMEARED = 2.0
"""Pixels from frame to frame beyond which an object's rim is smeared by its motion."""


@dataclass(frozen=True, slots=True, eq=False)
class OutlineFit:
    """Pose (3,) of the object in table (m, m, rad), its covariance (3, 3) from pixel noise, its
    apparent ``size`` (1: as configured), the share of the rim that agrees (``seen``), the contrasts
    of rim and dot and the ``noise`` in grey levels (with the configured sign above 0), the
    ``blur`` (sigma, pixels).
    """

    pose: Array
    covariance: Array
    size: float
    seen: float
    contrast: float
    dot_contrast: float
    noise: float
    blur: float


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What does not change while a pose is fitted. ``pixel`` in m at the top; ``step`` (2,) the
    motion between frames in pixels, for the blur that it makes."""

    outline: ObjectOutline
    pixel: float
    width: float
    step: Array
    measures: bool
    size_spread: float


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
    """The outline near ``start`` (3,), which must be right to half of ``width`` pixels.

    ``size`` is what it seems to measure, relative to the file; ``size_spread`` how much larger or
    smaller it may be (1 sigma, share). ``blur`` is the sigma in pixels to begin with; ``step`` (2,)
    the object's motion since the last frame in m. None where no such outline can be made out.
    """
    pixel = (float(view.pose.position[2]) - outline.height) / view.camera.fx
    coarse = width > FINE
    if coarse:
        image = softened(image, view, outline, start, width)
        blur = math.hypot(blur, SOFTENED)
    moving = np.zeros(2) if step is None else np.asarray(step, dtype=float) / pixel
    scene = _Scene(outline, pixel, width, moving, not coarse, size_spread)
    smeared = float(np.hypot(*moving)) > _SMEARED
    # A fit that leaves the dot out is only the way to one with it.
    rough = coarse or smeared or (outline.dot is not None and not with_dot)
    most = ROUGH_PIXELS if rough else MOST_PIXELS
    dot = outline.dot if with_dot else None
    state = _State(start.copy(), blur, size)
    gathered: Array | None = None
    tolerance, stays = (0.1, 3.0) if coarse else (0.02, 2.0) if rough else (0.004, 1.0)
    for _ in range(12 if coarse else 20):
        if gathered is None or np.hypot(*(state.pose - gathered)[:2]) > stays * pixel:
            gathered = state.pose.copy()
            found = rim_pixels(image, view, outline, gathered, width, most)
            around = None if dot is None else dot_pixels(image, view, outline, dot, gathered)
            if found is None or (dot is not None and around is None):
                return None
            rim = found
            sectors = sectors_of(outline, rim, gathered)
            state.forget()
        moved = state.improve(scene, rim, sectors, around, dot)
        if moved is None or np.hypot(*(state.pose - start)[:2]) > width * pixel:
            return None
        if moved < tolerance and state.settled:
            return state.answer(scene, dot)
    return None


@dataclass(slots=True, eq=False)
class _State:
    """Gauss-Newton under way."""

    pose: Array
    blur: float
    size: float = 1.0
    smear: float = 0.0
    dot_size: float = 1.0
    noise: float = 3.0
    rounds: int = 0
    levels: Array | None = None
    dot_levels: Array | None = None
    weight: Array | None = None
    dot_weight: Array | None = None
    good: NDArray[np.bool_] | None = None
    taken: NDArray[np.bool_] | None = None  # there exactly when ``good`` is
    scatter: float = 1.0
    information: Array | None = None

    @property
    def settled(self) -> bool:
        """Weights and levels are those of a few rounds."""
        return self.rounds >= 4

    def forget(self) -> None:
        """The pixels are others: levels and weights begin anew."""
        self.levels = self.dot_levels = self.weight = self.dot_weight = self.good = self.taken = (
            None
        )
        self.rounds = 0

    def improve(
        self,
        scene: _Scene,
        rim: Pixels,
        sectors: NDArray[np.intp],
        around: Pixels | None,
        dot: Dot | None,
    ) -> float | None:
        """One round; how far the pose moved in pixels, None if it cannot be."""
        free, columns = self._rim_columns(scene, rim, sectors)
        variance = self.noise**2
        total = np.diag(self._prior(scene)) * variance
        pull = self._prior(scene) * variance * self._distance_to_usual(scene)
        # Sector after sector: index of its pixels, padded; padding has no weight.
        order = np.argsort(sectors, kind="stable")
        counts = np.bincount(sectors, minlength=int(sectors.max()) + 1)
        begin = np.cumsum(counts) - counts
        index = begin[:, None] + np.arange(counts.max())
        padded = np.arange(counts.max()) >= counts[:, None]
        index = order[np.minimum(index, len(order) - 1)]
        weight = np.ones(len(sectors)) if self.weight is None else self.weight
        weights = np.where(padded, 0.0, weight[index])
        both = np.concatenate([free, columns, rim.grey[:, None]], axis=1)[index]
        normal = np.matmul((both * weights[..., None]).transpose(0, 2, 1), both)
        own = normal[:, :_LEVELS, :_LEVELS] + self._level_prior(len(counts)) * variance
        mixed = normal[:, :_LEVELS, _LEVELS:].copy()
        mixed[..., -1] += self._level_pull(len(counts)) * variance
        answer = np.linalg.solve(own, mixed)
        # What the levels cannot explain, sector by sector: globals, shift of the rim, grey values.
        left = normal[:, _LEVELS:, _LEVELS:] - np.matmul(mixed.transpose(0, 2, 1), answer)
        # A sector that is left out keeps its levels, so that it can come back.
        gate: Array = np.ones(len(counts))
        if self.good is not None and self.taken is not None:
            gate = (self.good & self.taken).astype(float)
        summed = np.einsum("s,sij->ij", gate, left)
        total = total + summed[:_GLOBALS, :_GLOBALS]
        pull = pull + summed[:_GLOBALS, -1]
        if around is not None and dot is not None:
            dot_free, dot_columns = self._dot_columns(scene, around, dot)
            dot_weight = np.ones(len(around.grey)) if self.dot_weight is None else self.dot_weight
            free_weighted = dot_free * dot_weight[:, None]
            inner = np.linalg.inv(free_weighted.T @ dot_free + 1e-6 * np.eye(dot_free.shape[1]))
            cross = free_weighted.T @ dot_columns
            total += (dot_columns * dot_weight[:, None]).T @ dot_columns - cross.T @ inner @ cross
            free_pull = free_weighted.T @ around.grey
            pull += (dot_columns * dot_weight[:, None]).T @ around.grey
            pull -= cross.T @ inner @ free_pull
        try:
            step = np.linalg.solve(total, pull)
        except np.linalg.LinAlgError:
            return None
        if self.levels is None:
            step = np.zeros(_GLOBALS)
        if not np.all(np.isfinite(step)):
            return None
        self.levels = answer[..., -1] - answer[..., :_GLOBALS] @ step
        residual = rim.grey - (free * self.levels[sectors]).sum(axis=1)
        residual -= columns[:, :_GLOBALS] @ step
        dot_residual = None
        if around is not None and dot is not None:
            self.dot_levels = inner @ (free_pull - cross @ step)
            dot_residual = around.grey - dot_free @ self.dot_levels - dot_columns @ step
        self._judge(scene, residual, sectors, counts, dot_residual)
        self._compare(scene, left, step)
        self._take(step, scene)
        self.information = total
        self.rounds += 1
        if self.rounds == 1:
            return math.inf
        turned = abs(float(step[2])) * scene.outline.reach
        return (math.hypot(step[0], step[1]) + turned) / scene.pixel

    def answer(self, scene: _Scene, dot: Dot | None) -> OutlineFit | None:
        """What was found, once it no longer moves."""
        assert self.information is not None and self.levels is not None and self.good is not None
        sign = 1.0 if scene.outline.brighter else -1.0
        contrast = sign * (self.levels[:, 0] - self.levels[:, 2])
        usual = float(np.median(contrast[self.good])) if self.good.any() else 0.0
        assert self.taken is not None
        agrees = (
            self.good & self.taken & (contrast > 0.35 * usual) & (contrast > 0.5 * LEAST_CONTRAST)
        )
        dot_contrast = 0.0
        if dot is not None and self.dot_levels is not None:
            difference = float(self.dot_levels[0] - self.dot_levels[1])
            dot_contrast = difference if dot.brighter else -difference
        covariance = np.linalg.inv(self.information)[:3, :3] * self.noise**2 * self.scatter
        return OutlineFit(
            self.pose,
            np.asarray(covariance, dtype=float),
            self.size,
            float(agrees.mean()),
            usual,
            dot_contrast,
            self.noise,
            self.blur,
        )

    def _take(self, step: Array, scene: _Scene) -> None:
        limit = 0.5 * scene.width * scene.pixel
        far = max(1.0, math.hypot(step[0], step[1]) / limit)
        step = step / far
        self.pose = self.pose + step[:3]
        self.size = float(np.clip(self.size + step[_SIZE], 0.75, 1.35))
        self.dot_size = float(np.clip(self.dot_size + step[_DOT_SIZE], 0.5, 2.0))
        if scene.measures:
            self.blur = math.sqrt(float(np.clip(self.blur**2 + step[_BLUR], 0.15, 9.0)))
            self.smear = float(np.clip(self.smear + step[_SMEAR], 0.0, 0.1))

    def _compare(self, scene: _Scene, left: Array, step: Array) -> None:
        """Do the sectors agree where the rim is? Those that do not are left out, and how much the
        others differ is what the covariance must tell."""
        power = np.maximum(left[:, _GLOBALS, _GLOBALS], 1e-9)
        shift = (left[:, _GLOBALS, -1] - left[:, _GLOBALS, :_GLOBALS] @ step) / power
        sigma = self.noise / np.sqrt(power)
        assert self.good is not None
        self.taken = np.ones(len(power), dtype=bool)
        clear = self.good & (sigma < 0.5)
        if not scene.measures or self.rounds == 0 or not clear.any():
            return
        score = shift / np.hypot(sigma, _EVEN)
        usual = float(np.clip(1.4826 * np.median(np.abs(score[clear])), 1.0, 3.0))
        self.taken = ~clear | (np.abs(score) < 3.5 * usual)
        kept = clear & self.taken
        self.scatter = max(1.0, float((np.square(shift / sigma)[kept]).mean()))

    def _judge(
        self,
        scene: _Scene,
        residual: Array,
        sectors: NDArray[np.intp],
        counts: NDArray[np.intp],
        dot_residual: Array | None,
    ) -> None:
        """Weights of pixels and sectors from what is left of them."""
        spread = np.sqrt(
            np.bincount(sectors, np.minimum(np.abs(residual), 60.0) ** 2, len(counts))
            / np.maximum(counts, 1)
        )
        # Around a rough place all of the rim fits badly at first.
        share, factor, margin = (0.3, 1.3, 0.3) if scene.measures else (0.5, 2.5, 1.0)
        usual = float(np.quantile(spread[counts > 0], share))
        self.good = (spread < factor * usual + margin) & (counts >= 12)
        kept = self.good[sectors]
        inner = 1.4826 * float(np.median(np.abs(residual[kept]))) if kept.any() else usual
        scale = max(inner, 0.3)
        self.weight = np.minimum(1.0, 3.0 * scale / np.maximum(np.abs(residual), 1e-6))
        counted = self.weight * kept
        squares = float((counted * residual**2).sum() / max(counted.sum(), 1.0))
        self.noise = max(math.sqrt(squares), 0.3)
        if dot_residual is not None:
            self.dot_weight = np.minimum(
                1.0, 3.0 * self.noise / np.maximum(np.abs(dot_residual), 1e-6)
            )

    # -- the model

    def _spread(self, scene: _Scene, normal: Array) -> Array:
        """Sigma (N,) of the blur across the rim, in pixels; ``normal`` (N, 2) in table."""
        return np.sqrt(self.blur**2 + self.smear * (normal @ scene.step) ** 2)

    def _rim_columns(
        self, scene: _Scene, rim: Pixels, sectors: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """How grey values answer the levels of their sector (N, 4), and the globals (N, 7)."""
        outline, pixel = scene.outline, scene.pixel
        back = inverse(self.pose)
        at_top, at_floor = transform_points(back, rim.top), transform_points(back, rim.floor)
        distance, normal = outline.distance(at_top)
        share, whole, whole_normal, whole_at = distance, distance, normal, at_top
        for part in (0.5, 1.0):
            place = at_top + part * (at_floor - at_top)
            share, direction = outline.distance(place)
            nearer = share < whole
            whole = np.where(nearer, share, whole)
            whole_normal = np.where(nearer[:, None], direction, whole_normal)
            whole_at = np.where(nearer[:, None], place, whole_at)
        rims = [
            self._edge(scene, place, d, n, self.size)
            for place, d, n in ((at_top, distance, normal), (whole_at, whole, whole_normal))
        ]
        (top, by_top), (body, by_body) = rims
        slope = np.clip(distance / pixel, -scene.width, scene.width)
        free = np.stack([top, body - top, 1.0 - body, slope], axis=-1)
        if self.levels is None:
            return free, np.zeros((len(distance), _GLOBALS + 1))
        of = self.levels[sectors]
        columns = (of[:, 0] - of[:, 1])[:, None] * by_top + (of[:, 1] - of[:, 2])[:, None] * by_body
        return free, columns

    def _edge(
        self, scene: _Scene, place: Array, distance: Array, normal: Array, size: float = 1.0
    ) -> tuple[Array, Array]:
        """Coverage (N,) inside an edge of a body ``size`` times as large, and how it answers the
        globals (N, 7)."""
        pixel = scene.pixel
        in_table = transform_points([0.0, 0.0, self.pose[2]], normal)
        support = ((place - distance[:, None] * normal) * normal).sum(axis=1)
        sigma = self._spread(scene, in_table)
        away = (distance - (size - 1.0) * support) / pixel
        scaled = away / sigma
        density = np.exp(-0.5 * scaled**2) / (math.sqrt(2.0 * math.pi) * sigma)
        columns = np.zeros((len(distance), _GLOBALS + 1))
        columns[:, -1] = density
        columns[:, :2] = in_table * (density / pixel)[:, None]
        turning = normal[:, 0] * place[:, 1] - normal[:, 1] * place[:, 0]
        columns[:, 2] = -turning * density / pixel
        columns[:, _SIZE] = support * density / pixel
        columns[:, _BLUR] = 0.5 * density * away / sigma**2
        columns[:, _SMEAR] = columns[:, _BLUR] * (in_table @ scene.step) ** 2
        return ndtr(-scaled), columns

    def _dot_columns(self, scene: _Scene, around: Pixels, dot: Dot) -> tuple[Array, Array]:
        """The same for the dot: levels of dot and top, two slopes; and the globals."""
        place = transform_points(inverse(self.pose), around.top)
        arm = place - np.array(dot.offset)
        length = np.sqrt((arm * arm).sum(axis=1))
        normal = arm / np.maximum(length, 1e-9)[:, None]
        distance = length - self.dot_size * dot.radius
        inside, columns = self._edge(scene, place, distance, normal)
        columns[:, _SIZE] = 0.0
        # Moving outward along the normal by the radius is what a dot twice as large does.
        outward = transform_points([0.0, 0.0, self.pose[2]], normal)
        columns[:, _DOT_SIZE] = dot.radius * (columns[:, :2] * outward).sum(axis=1)
        free = np.concatenate([np.stack([inside, 1.0 - inside], -1), arm / dot.radius], axis=1)
        if self.dot_levels is None:
            return free, np.zeros((len(length), _GLOBALS))
        return free, columns[:, :_GLOBALS] * (self.dot_levels[0] - self.dot_levels[1])

    # -- what is usual

    def _prior(self, scene: _Scene) -> Array:
        """Precisions (7,) of the globals around what is usual; hardly any of the pose."""
        blur = 4.0 if scene.measures else 1e8
        moving = float(np.hypot(*scene.step)) > _SMEARED and scene.measures
        place = 1.0 / (5.0 * scene.pixel) ** 2
        return np.array(
            [place, place, 1.0, scene.size_spread**-2, blur, 1e4 if moving else 1e12, 100.0]
        )

    def _distance_to_usual(self, scene: _Scene) -> Array:
        return np.array([0.0, 0.0, 0.0, 1.0 - self.size, 0.0, -self.smear, 1.0 - self.dot_size])

    def _level_prior(self, sectors: int) -> Array:
        """Precisions (S, 4, 4) of the levels: of the wall's, and of the slope."""
        top = np.full(sectors, 60.0) if self.levels is None else np.abs(self.levels[:, 0])
        prior = np.zeros((sectors, _LEVELS, _LEVELS))
        prior[:, 0, 0] = prior[:, 2, 2] = 1e-6
        prior[:, 1, 1] = 1.0 / (0.5 * top + 10.0) ** 2
        prior[:, 3, 3] = _SLOPE_SPREAD**-2
        return prior

    def _level_pull(self, sectors: int) -> Array:
        """The wall is usually half as bright as the top."""
        top = np.full(sectors, 60.0) if self.levels is None else np.abs(self.levels[:, 0])
        pull = np.zeros((sectors, _LEVELS))
        pull[:, 1] = 0.5 * top / (0.5 * top + 10.0) ** 2
        return pull
