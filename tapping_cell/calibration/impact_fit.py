"""Restitution, contact friction and the scales of B1, B2 and B3 from measured launches.

What a trial tells: the striker's speed, where and how it hit, and the launch: speed, spin over
speed, and direction against the contact normal. Each is compared with the impact's model
(``mechanics.impact``) over the scatter that a tap has of its own. That scatter is estimated with
the parameters: the mean over the trials is what the parameters explain, the rest is scatter.

Which parameters are free is decided from the data. Restitution is, where the striker's speed is
known; contact friction, where the contact slid in some trials; the scale of B1 (and of B3 where it
is not zero) only if the trials speak for it, by the Bayesian information criterion. B2 and the
restitution always act together, as (1 + e) / B2, so B2 keeps its model value unless no restitution
from 0 to 1 explains the launches.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tapping_cell.mechanics import Body, Impact, Striker

Array = NDArray[np.float64]

# All parameters of the impact. Restitution is fitted as ln(1 + e), the others as logarithms.
NAMES = ("restitution", "contact_friction", "scale_b1", "scale_b2", "scale_b3")
_LOW = dict(zip(NAMES, (0.0, math.log(0.005), *(math.log(0.05),) * 3), strict=True))
_HIGH = dict(zip(NAMES, (math.log(2.0), math.log(2.0), *(math.log(20.0),) * 3), strict=True))
_PASSES = 4
_STICKS = 2.0  # a contact friction that holds any impulse
_TELLING = 2.0  # by which the criterion must fall for a parameter more
_LEAST_SLIDING = 3  # trials whose contact slides, to say anything of its friction
_FLOOR = (0.003, 0.01, 0.001)  # least scatter of speed, spin (relative) and direction (rad)
_FIRST = (0.05, 0.15, 0.02)
_STEP = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Strikes:
    """Impacts and what they did: arrays (n,), SI; NaN in ``angle`` where it was not measured.

    ``contact`` (n, 2) is (c_n, c_t) of ``Impact.strike``; ``angle`` that of the launch from the
    contact normal, rad. Deviations are those of the measurement, not of the tap.
    """

    speed: Array
    speed_std: Array
    incidence: Array
    contact: Array
    launch_speed: Array
    launch_speed_std: Array
    spin: Array
    spin_std: Array
    angle: Array
    angle_std: Array

    def of(self, rows: NDArray[np.intp]) -> Strikes:
        """Those of some trials."""
        return Strikes(*(getattr(self, entry.name)[rows] for entry in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class ImpactFit:
    """The result. ``free`` names the fitted parameters; ``score`` (n, p) and ``information``
    (n, p, p) are those of their logarithms (ln(1 + e) for the restitution).

    ``scatter`` is one standard deviation of a tap: speed and spin over speed (relative), direction
    (rad); ``sliding`` (n,) is true where the contact slid to the end; ``deviations`` (n, 3) are the
    measured over the modelled values, minus one (minus the modelled angle, for the direction).
    """

    values: Mapping[str, float]
    free: tuple[str, ...]
    score: Array
    information: Array
    scatter: tuple[float, float, float]
    sliding: NDArray[np.bool_]
    deviations: Array
    notes: tuple[str, ...]


def fit_impact(model: ImpactModel) -> ImpactFit:
    """Fit the impact; what is not free keeps the value that the model knows.

    Raises ValueError for fewer than four strikes.
    """
    count = model.strikes.speed.size
    if count < 4:
        raise ValueError(f"{count} impacts cannot be fitted; four are needed at least")
    notes: list[str] = []
    free: tuple[str, ...] = ("restitution", "contact_friction")
    base = _fit(model, free)
    slid = int(np.sum(model.sliding(base.values)))
    stuck = _fit(model.with_known(contact_friction=_STICKS), ("restitution",))
    if slid < _LEAST_SLIDING or stuck.criterion < base.criterion + _TELLING:
        model = _without_friction(model, base, stuck, notes)
        free, slid = ("restitution",), 0
        base = _fit(model, free)
    at_limit = base.values["restitution"] > 1 - 1e-6 or base.values["restitution"] < 1e-6
    if at_limit:
        free = ("scale_b2", *free[1:])
        kept = dict(model.known)
        notes.append(
            "no restitution from 0 to 1 explains the launches; the scale of B2 is fitted instead, "
            f"with the restitution left at {kept['restitution']:g}"
        )
        base = _fit(model, free)
    best = base
    for extra in _candidates(model, base, slid):
        other = _fit(model, (*free, extra))
        if other.criterion < best.criterion - _TELLING:
            best = other
    return _result(model, best, tuple(notes))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    values: dict[str, float]
    free: tuple[str, ...]
    scatter: tuple[float, float, float]
    criterion: float


class ImpactModel:
    """Launches that the parameters predict, and their residuals."""

    def __init__(
        self, strikes: Strikes, body: Body, striker: Striker, known: dict[str, float]
    ) -> None:
        self.strikes = strikes
        self.known = known
        self._body = body
        self._striker = striker

    def impact(self, values: Mapping[str, float]) -> Impact:
        """The impact with these values."""
        return Impact(
            self._body,
            self._striker,
            restitution=values["restitution"],
            friction=values["contact_friction"],
            scale=(values["scale_b1"], values["scale_b2"], values["scale_b3"]),
        )

    def launch(self, values: Mapping[str, float]) -> Array:
        """Speed, spin over speed and angle, (n, 3)."""
        s = self.strikes
        result = self.impact(values).strike(s.speed, s.incidence, s.contact)
        speed = np.hypot(result.velocity[..., 0], result.velocity[..., 1])
        angle = np.arctan2(result.velocity[..., 1], result.velocity[..., 0])
        return np.stack([speed, result.spin / np.maximum(speed, 1e-12), angle], axis=1)

    def sliding(self, values: Mapping[str, float]) -> NDArray[np.bool_]:
        """Where the contact slides to the end, (n,)."""
        s = self.strikes
        slid = self.impact(values).strike(s.speed, s.incidence, s.contact).sliding
        return np.asarray(slid != 0)

    def seen(self) -> Array:
        """What was measured, as :meth:`launch`; NaN where nothing was."""
        s = self.strikes
        return np.stack([s.launch_speed, s.spin / s.launch_speed, s.angle], axis=1)

    def measured_std(self) -> Array:
        """Standard deviations of the measurement, (n, 3)."""
        s = self.strikes
        ratio = s.spin_std / s.launch_speed
        relative = np.hypot(s.launch_speed_std, s.launch_speed * s.speed_std / s.speed)
        return np.stack([relative, ratio, s.angle_std], axis=1)

    def deviation_std(self, launch: Array, scatter: Sequence[float]) -> Array:
        """Standard deviation of seen minus launch, (n, 3)."""
        size = np.stack([launch[:, 0], np.abs(launch[:, 1]), np.ones(len(launch))], axis=1)
        return np.asarray(np.hypot(size * np.asarray(scatter), self.measured_std()))

    def with_known(self, **values: float) -> ImpactModel:
        """The same with other values for what is not fitted."""
        return ImpactModel(self.strikes, self._body, self._striker, self.known | values)

    def with_strikes(self, strikes: Strikes) -> ImpactModel:
        """The same body and striker, hit otherwise."""
        return ImpactModel(strikes, self._body, self._striker, self.known)

    def rebound(self, values: Mapping[str, float]) -> Array:
        """Speed (n,) of the striker along the contact normal after the impact, m/s.

        By the restitution of the parting speeds, as the paper measured it: the contact point of the
        body less e times the speed of the approach.
        """
        s = self.strikes
        result = self.impact(values).strike(s.speed, s.incidence, s.contact)
        point = result.velocity[..., 0] - result.spin * s.contact[..., 1]
        return np.asarray(point - values["restitution"] * s.speed * np.cos(s.incidence))

    def with_free(self, free: Sequence[str], x: Array) -> dict[str, float]:
        """All parameters, those of ``free`` from their logarithms ``x``."""
        values = dict(self.known)
        for name, value in zip(free, x.tolist(), strict=True):
            values[name] = _outside(name, value)
        return values


def _inside(name: str, value: float) -> float:
    return math.log1p(value) if name == "restitution" else math.log(value)


def _outside(name: str, value: float) -> float:
    return min(max(math.expm1(value), 0.0), 1.0) if name == "restitution" else math.exp(value)


def _fit(model: ImpactModel, free: tuple[str, ...]) -> _Fit:
    """Weighted least squares, the scatter estimated anew between passes.

    The weights are those of the pass before: they must not follow the parameters, or large modelled
    values would excuse themselves.
    """
    low = np.array([_LOW[name] for name in free])
    high = np.array([_HIGH[name] for name in free])
    x = np.clip([_inside(name, model.known[name]) for name in free], low + 1e-6, high - 1e-6)
    scatter: tuple[float, float, float] = _FIRST
    seen = model.seen()
    known = np.isfinite(seen)
    deviation = model.deviation_std(model.launch(model.with_free(free, x)), scatter)

    def residuals(trial: Array) -> Array:
        off = (seen - model.launch(model.with_free(free, trial))) / deviation
        return np.asarray(off[known])

    for _ in range(_PASSES):
        starts = [x]
        if "contact_friction" in free:
            # Sticking and sliding trials change sides with the friction: look from several.
            place = free.index("contact_friction")
            for friction in (0.08, 0.2, 0.5):
                start = x.copy()
                start[place] = math.log(friction)
                starts.append(start)
        found = [
            least_squares(residuals, start, bounds=(low, high), diff_step=_STEP, xtol=1e-10)
            for start in starts
        ]
        x = np.asarray(min(found, key=lambda result: result.cost).x, dtype=float)
        launch = model.launch(model.with_free(free, x))
        scatter = _scatter(model, seen - launch, launch, len(free))
        deviation = model.deviation_std(launch, scatter)
    off = residuals(x)
    likelihood = float(off @ off) + 2 * float(np.sum(np.log(deviation[known])))
    return _Fit(
        values=model.with_free(free, x),
        free=free,
        scatter=scatter,
        criterion=likelihood + len(free) * math.log(len(seen)),
    )


def _scatter(
    model: ImpactModel, off: Array, launch: Array, used: int
) -> tuple[float, float, float]:
    """What a tap varies by itself: the residuals' spread less that of the measurement."""
    measured = model.measured_std()
    size = np.stack([launch[:, 0], np.abs(launch[:, 1]), np.ones(len(launch))], axis=1)
    values = []
    for k, floor in enumerate(_FLOOR):
        usable = np.isfinite(off[:, k])
        if k == 1:
            # A spin near zero says nothing of a relative scatter.
            usable &= size[:, 1] * 0.1 > measured[:, 1]
        if usable.sum() < 3:
            values.append(_FIRST[k])
            continue
        spare = usable.sum() / max(usable.sum() - used / 2, 1)
        total = spare * np.mean((off[usable, k] / size[usable, k]) ** 2)
        values.append(
            math.sqrt(max(total - np.mean((measured[usable, k] / size[usable, k]) ** 2), floor**2))
        )
    return values[0], values[1], values[2]


def _without_friction(model: ImpactModel, base: _Fit, stuck: _Fit, notes: list[str]) -> ImpactModel:
    """Contacts that stick as well explain the launches: the file's friction stays, unless with it
    they are explained worse. No bound follows from that: a model that is wrong elsewhere lets
    contacts seem to stick which slid."""
    known = model.known["contact_friction"]
    said = (
        "contacts that stick explain the launches as well: the contact friction is not determined"
    )
    held = _fit(model, ("restitution",))
    if held.criterion <= stuck.criterion + _TELLING:
        notes.append(f"{said}; it is left at {known:.3g}")
        return model
    s = model.strikes
    hits = model.impact(stuck.values).strike(1.0, s.incidence, s.contact)
    needed = float(np.max(np.abs(hits.tangential_impulse / hits.normal_impulse)))
    kept = min(base.values["contact_friction"], 1.01 * needed)
    notes.append(
        f"{said}, but with the file's {known:.3g} they are explained worse; {kept:.3g} is taken, "
        "which is no measurement of it"
    )
    return model.with_known(contact_friction=kept)


def _candidates(model: ImpactModel, base: _Fit, slid: int) -> tuple[str, ...]:
    """Scales that the trials could speak of."""
    extra = []
    if model.strikes.speed.size - slid >= _LEAST_SLIDING:
        extra.append("scale_b1")
    b3 = model.impact(base.values).inverse_inertias(model.strikes.incidence, model.strikes.contact)[
        2
    ]
    if np.ptp(b3) > 0:
        extra.append("scale_b3")
    return tuple(extra)


def weighted_slopes(
    model: ImpactModel, values: Mapping[str, float], names: Sequence[str], deviation: Array
) -> Array:
    """Derivatives of the residuals by the parameters, (n, 3, p); 0 where nothing was measured."""
    known = np.isfinite(model.seen())
    columns = []
    for name in names:
        inside = _inside(name, values[name])
        ends = []
        for sign in (1, -1):
            moved = min(max(inside + sign * _STEP, _LOW[name]), _HIGH[name])
            ends.append((moved, model.launch({**values, name: _outside(name, moved)})))
        (up, above), (down, below) = ends
        columns.append(np.where(known, -(above - below) / (up - down) / deviation, 0.0))
    return np.stack(columns, axis=2)


def _result(model: ImpactModel, fit: _Fit, notes: tuple[str, ...]) -> ImpactFit:
    launch, seen = model.launch(fit.values), model.seen()
    deviation = model.deviation_std(launch, fit.scatter)
    slopes = weighted_slopes(model, fit.values, fit.free, deviation)
    off = np.nan_to_num((seen - launch) / deviation)
    size = np.stack([launch[:, 0], launch[:, 1], np.ones(len(launch))], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = (seen - launch) / size
    return ImpactFit(
        values=fit.values,
        free=fit.free,
        score=np.einsum("nkp,nk->np", slopes, off),
        information=np.einsum("nkp,nkq->npq", slopes, slopes),
        scatter=fit.scatter,
        sliding=model.sliding(fit.values),
        deviations=relative,
        notes=notes,
    )


def contact_frame(body: Body, contact_angle: Array) -> tuple[Array, Array]:
    """(c_n, c_t) of contacts (n, 2) and the direction (n,) of their normals in the body's frame.

    A NaN contact angle gives the contact at angle 0, which serves round bodies, and no direction.
    """
    angle = np.nan_to_num(contact_angle)
    point, outward = body.boundary(angle), body.normal(angle)
    normal = -outward
    local = np.stack(
        [
            (normal * point).sum(axis=-1),
            normal[..., 0] * point[..., 1] - normal[..., 1] * point[..., 0],
        ],
        axis=-1,
    )
    direction = np.arctan2(normal[..., 1], normal[..., 0])
    return local, np.where(np.isnan(contact_angle), math.nan, direction)
