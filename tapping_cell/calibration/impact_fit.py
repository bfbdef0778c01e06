"""Fit of restitution, contact friction and the scales of the impact constants B1, B2 and B3 to
measured launches.

A trial gives the striker's speed, the contact point, the incidence and the launch. The launch
consists of speed, spin over speed, and direction relative to the contact normal. The residuals of
the impact model (``mechanics.impact``) are divided by the scatter of a tap. This scatter is
estimated together with the parameters.

The data decide which parameters are free. Restitution is free, and contact friction is free if the
contact slid in enough trials. The scale of B1 (and that of B3, if B3 differs between the trials) is
free only if the Bayesian information criterion supports it. B2 and the restitution e act only in
combination, as (1 + e) / B2. Therefore B2 keeps its model value. B2 is fitted instead of the
restitution only if no restitution from 0 to 1 explains the launches.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tapping_cell.mechanics import Body, Impact, Striker
from tapping_cell.se2 import Array

# All parameters of the impact. The restitution e is fitted as ln(1 + e), the other parameters as
# logarithms.
NAMES = ("restitution", "contact_friction", "scale_b1", "scale_b2", "scale_b3")
_LOW = dict(zip(NAMES, (0.0, math.log(0.005), *(math.log(0.05),) * 3), strict=True))
_HIGH = dict(zip(NAMES, (math.log(2.0), math.log(2.0), *(math.log(20.0),) * 3), strict=True))
_PASSES = 4
_STICKS = 2.0  # contact friction at which every contact sticks
# minimum decrease of the Bayesian information criterion that justifies another free parameter
_SIGNIFICANT = 2.0
_MIN_SLIDING = 3  # minimum number of trials with a sliding contact to fit its friction
_FLOOR = (0.003, 0.01, 0.001)  # minimum scatter: speed and spin (relative), direction (rad)
_FIRST = (0.05, 0.15, 0.02)
_STEP = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Strikes:
    """Impacts and the resulting launches: arrays (n,), SI.

    ``contact`` (n, 2) is (c_n, c_t) of ``Impact.strike``. ``angle`` is the angle of the launch from
    the contact normal in rad, NaN if not measured. The standard deviations are those of the
    measurement and do not include the scatter of a tap.
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
        """Select trials by index."""
        return Strikes(*(getattr(self, entry.name)[rows] for entry in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class ImpactFit:
    """Result of the fit. ``free`` names the fitted parameters.

    ``score`` (n, p) and ``information`` (n, p, p) refer to the logarithms of the free parameters
    (ln(1 + e) for the restitution). ``scatter`` holds the standard deviations of a tap: speed and
    spin over speed (relative), direction (rad). ``sliding`` (n,) is True for a contact that slid
    until the end of the impact. ``deviations`` (n, 3) are the residuals of speed and spin over
    speed (relative) and of the direction (rad).
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
    """Fit the impact; parameters that are not free keep the model's known values.

    Raises:
        ValueError: there are fewer than four strikes.
    """
    count = model.strikes.speed.size
    if count < 4:
        raise ValueError(f"{count} impacts cannot be fitted; at least four are needed")
    notes: list[str] = []
    free: tuple[str, ...] = ("restitution", "contact_friction")
    base = _fit(model, free)
    slid = int(np.sum(model.sliding(base.values)))
    stuck = _fit(model.with_known(contact_friction=_STICKS), ("restitution",))
    if slid < _MIN_SLIDING or stuck.criterion < base.criterion + _SIGNIFICANT:
        model = _without_friction(model, base, stuck, notes)
        free, slid = ("restitution",), 0
        base = _fit(model, free)
    at_limit = base.values["restitution"] > 1 - 1e-6 or base.values["restitution"] < 1e-6
    if at_limit:
        free = ("scale_b2", *free[1:])
        kept = dict(model.known)
        notes.append(
            "no restitution from 0 to 1 explains the object's velocities after the impacts; the "
            "scale of B2, a constant of the impact model, is fitted instead, and the restitution "
            f"is kept at {kept['restitution']:g}"
        )
        base = _fit(model, free)
    best = base
    for extra in _candidates(model, base, slid):
        other = _fit(model, (*free, extra))
        if other.criterion < best.criterion - _SIGNIFICANT:
            best = other
    return _result(model, best, tuple(notes))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    values: dict[str, float]
    free: tuple[str, ...]
    scatter: tuple[float, float, float]
    criterion: float


class ImpactModel:
    """Prediction of launches from the parameters, with standard deviations."""

    def __init__(
        self, strikes: Strikes, body: Body, striker: Striker, known: dict[str, float]
    ) -> None:
        self.strikes = strikes
        self.known = known
        self._body = body
        self._striker = striker

    def impact(self, values: Mapping[str, float]) -> Impact:
        """Create the impact model with these values."""
        return Impact(
            self._body,
            self._striker,
            restitution=values["restitution"],
            friction=values["contact_friction"],
            scale=(values["scale_b1"], values["scale_b2"], values["scale_b3"]),
        )

    def launch(self, values: Mapping[str, float]) -> Array:
        """Predict speed, spin over speed and angle, (n, 3)."""
        s = self.strikes
        result = self.impact(values).strike(s.speed, s.incidence, s.contact)
        speed = np.hypot(result.velocity[..., 0], result.velocity[..., 1])
        angle = np.arctan2(result.velocity[..., 1], result.velocity[..., 0])
        return np.stack([speed, result.spin / np.maximum(speed, 1e-12), angle], axis=1)

    def sliding(self, values: Mapping[str, float]) -> NDArray[np.bool_]:
        """Return whether each contact slides to the end of the impact, (n,)."""
        s = self.strikes
        slid = self.impact(values).strike(s.speed, s.incidence, s.contact).sliding
        return np.asarray(slid != 0)

    def seen(self) -> Array:
        """Return the measured launches in the format of :meth:`launch`; NaN if not measured."""
        s = self.strikes
        return np.stack([s.launch_speed, s.spin / s.launch_speed, s.angle], axis=1)

    def measured_std(self) -> Array:
        """Compute the standard deviations of the measurement, (n, 3)."""
        s = self.strikes
        ratio = s.spin_std / s.launch_speed
        relative = np.hypot(s.launch_speed_std, s.launch_speed * s.speed_std / s.speed)
        return np.stack([relative, ratio, s.angle_std], axis=1)

    def deviation_std(self, launch: Array, scatter: Sequence[float]) -> Array:
        """Compute the standard deviations of the residuals, (n, 3)."""
        return np.asarray(np.hypot(_sizes(launch) * np.asarray(scatter), self.measured_std()))

    def with_known(self, **values: float) -> ImpactModel:
        """Return a copy that keeps the given parameters at these values unless they are fitted."""
        return ImpactModel(self.strikes, self._body, self._striker, self.known | values)

    def with_strikes(self, strikes: Strikes) -> ImpactModel:
        """Return a model of the same body and striker with other strikes."""
        return ImpactModel(strikes, self._body, self._striker, self.known)

    def rebound(self, values: Mapping[str, float]) -> Array:
        """Compute the striker's speed (n,) along the contact normal after the impact, in m/s.

        As in the paper, restitution is a ratio of relative speeds: the striker's speed is the speed
        of the body's contact point minus e times the approach speed.
        """
        s = self.strikes
        result = self.impact(values).strike(s.speed, s.incidence, s.contact)
        point = result.velocity[..., 0] - result.spin * s.contact[..., 1]
        return np.asarray(point - values["restitution"] * s.speed * np.cos(s.incidence))

    def with_free(self, free: Sequence[str], x: Array) -> dict[str, float]:
        """Return the values of all parameters, given the logarithms ``x`` of the ``free``
        parameters."""
        values = dict(self.known)
        for name, value in zip(free, x.tolist(), strict=True):
            values[name] = _outside(name, value)
        return values


def _sizes(launch: Array) -> Array:
    """Return the sizes (n, 3) to which the scatters of speed, spin and direction refer."""
    return np.stack([launch[:, 0], np.abs(launch[:, 1]), np.ones(len(launch))], axis=1)


def _inside(name: str, value: float) -> float:
    return math.log1p(value) if name == "restitution" else math.log(value)


def _outside(name: str, value: float) -> float:
    return min(max(math.expm1(value), 0.0), 1.0) if name == "restitution" else math.exp(value)


def _fit(model: ImpactModel, free: tuple[str, ...]) -> _Fit:
    """Fit by weighted least squares, re-estimating the scatter after each pass.

    The weights are fixed during a pass. If the weights changed with the parameters, the fit could
    reduce the weighted residuals by predicting larger values, because larger values have a larger
    assumed scatter.
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
            # The residuals are not smooth in the friction, because contacts switch between sticking
            # and sliding. Use several starts, so that the fit does not end in a local minimum.
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
    """Estimate the scatter of a tap. Its variance is the variance of the residuals minus the
    variance of the measurement."""
    measured = model.measured_std()
    size = _sizes(launch)
    values = []
    for k, floor in enumerate(_FLOOR):
        usable = np.isfinite(off[:, k])
        if k == 1:
            # The relative scatter of a spin near zero is meaningless.
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
    """Fix the contact friction, because contacts that stick explain the launches no worse than
    contacts that slide. The file's friction is kept, except if it explains the launches worse than
    contacts that stick do. The launches do not give a bound on the friction, because an error
    elsewhere in the model can make sliding contacts appear to stick.
    """
    known = model.known["contact_friction"]
    sentence = (
        "contacts that stick explain the object's velocities after the impacts as well as contacts "
        "that slide, so the trials do not determine the contact friction"
    )
    held = _fit(model, ("restitution",))
    if held.criterion <= stuck.criterion + _SIGNIFICANT:
        notes.append(f"{sentence}; the object file's value, {known:.3g}, is kept")
        return model
    s = model.strikes
    hits = model.impact(stuck.values).strike(1.0, s.incidence, s.contact)
    needed = float(np.max(np.abs(hits.tangential_impulse / hits.normal_impulse)))
    kept = min(base.values["contact_friction"], 1.01 * needed)
    notes.append(
        f"{sentence}. The object file's value, {known:.3g}, explains these velocities worse than "
        f"sticking contacts do; {kept:.3g}, which is not a measured value, is used instead"
    )
    return model.with_known(contact_friction=kept)


def _candidates(model: ImpactModel, base: _Fit, slid: int) -> tuple[str, ...]:
    """Return the names of the scales that the trials could determine."""
    extra = []
    if model.strikes.speed.size - slid >= _MIN_SLIDING:
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
    """Compute the derivatives of the residuals with respect to the parameters, (n, 3, p). The
    derivatives of residuals that were not measured are 0."""
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
    """Compute the contact points (c_n, c_t), (n, 2), and the directions (n,) of the contact normals
    in the body frame.

    For a NaN contact angle, the contact at angle 0 (exact for round bodies) and the direction NaN
    are returned.
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
