"""Registry of planning methods: four built-in methods and methods of other packages.

Another package adds a method by an entry point of the group ``tapping_cell.planners``. The entry
point's object is called with ``PlannerSettings`` and must return a ``Planner``:

    [project.entry-points."tapping_cell.planners"]
    mine = "my_package.my_module:MyPlanner"
"""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points

import numpy as np

from tapping_cell.planning.errors import PlanningError, UnknownPlannerError
from tapping_cell.planning.interface import Planner, Taps
from tapping_cell.planning.multi import multi_planner
from tapping_cell.planning.optimal import OptimalPlanner
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.two_tap import ConservativePlanner, ExactPlanner

ENTRY_POINT_GROUP = "tapping_cell.planners"
SLACK = 1e-6
"""Relative rounding error that is accepted in the taps of a registered method."""

BUILT_IN: dict[str, Callable[[PlannerSettings], Planner]] = {
    "exact": ExactPlanner,
    "conservative": ConservativePlanner,
    "multi": multi_planner,
    "optimal": OptimalPlanner,
}


def _registered() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=ENTRY_POINT_GROUP)}


def planner_names() -> list[str]:
    """Return all names that ``make_planner`` accepts, the built-in methods first."""
    return [*BUILT_IN, *sorted(set(_registered()) - set(BUILT_IN))]


def require_planner(name: str) -> None:
    """Check that a planning method with this name exists, without creating it.

    Raises:
        UnknownPlannerError: unknown name; the message lists the names.
    """
    if name not in BUILT_IN and name not in planner_names():
        raise UnknownPlannerError(
            f"there is no planning method {name!r}; choose one of {', '.join(planner_names())}"
        )


def make_planner(
    name: str, settings: PlannerSettings | None = None, *, background: bool = False
) -> Planner:
    """Create the planning method of that name. Entry points cannot replace built-in methods.

    Args:
        name: one of ``planner_names()``.
        settings: settings of the method; by default those of the paper's cell.
        background: return immediately and solve the plan of ``optimal`` in a thread; until the plan
            is solved, another method is used. All other methods are ready at once and ignore this
            argument.

    Raises:
        UnknownPlannerError: unknown name; the message lists the names.
        PlanningError: a registered method cannot be loaded, is not a ``Planner``, or
            chooses impossible taps.
    """
    require_planner(name)
    settings = PlannerSettings() if settings is None else settings
    if name == "optimal":
        return OptimalPlanner(settings, background=background)
    if name in BUILT_IN:
        return BUILT_IN[name](settings)
    return _created(_registered()[name], settings)


def load_planner(name: str, settings: PlannerSettings) -> Planner:
    """Create a planning method for trials: one of ``planner_names()`` or ``module:Class``.

    The cell itself uses only ``make_planner``, because a name that arrives on a topic must not
    import a module.

    Raises:
        UnknownPlannerError: unknown name; the message lists the names.
        PlanningError: the class cannot be loaded, is not a ``Planner``, or
            chooses impossible taps.
    """
    if ":" not in name:
        return make_planner(name, settings)
    return _created(EntryPoint(name, name, ENTRY_POINT_GROUP), settings)


def _created(point: EntryPoint, settings: PlannerSettings) -> Planner:
    try:
        planner = point.load()(settings)
    # a plug-in may raise any exception; it is reported as a PlanningError
    except Exception as error:
        raise PlanningError(
            f"the planning method {point.name!r} ({point.value}) cannot be created: {error}"
        ) from error
    if not isinstance(planner, Planner):
        raise PlanningError(
            f"the planning method {point.name!r} ({point.value}) returned a "
            f"{type(planner).__name__}, which lacks name, settings, choose or taps_to_go"
        )
    if problem := _problem(planner, settings):
        raise PlanningError(f"the planning method {point.name!r} ({point.value}): {problem}")
    return planner


def _problem(planner: Planner, settings: PlannerSettings) -> str | None:
    """Return what is wrong with the taps that a method chooses for a grid of residuals."""
    distance, rotation = np.meshgrid(
        [0.0, *np.geomspace(1e-4, 0.3, 24)], np.radians(np.linspace(-170.0, 170.0, 35))
    )
    try:
        tap, after = planner.choose(distance, rotation), planner.taps_to_go(distance, rotation)
        one = planner.choose(0.010, 0.17)
    # a plug-in may raise any exception
    except Exception as error:
        return f"choose or taps_to_go fails for arrays or numbers of m and rad: {error}"
    for returned, shape in ((tap, distance.shape), (one, ())):
        if not isinstance(returned, Taps) or {np.shape(part) for part in returned} != {shape}:
            return (
                "choose must return Taps(distance, rotation), m and rad, of the shape of its "
                f"arguments {shape}, not {type(returned).__name__}"
            )
    if np.shape(after) != distance.shape or np.any(np.isnan(after)):
        return "taps_to_go must return one number for each residual, of the shape of its arguments"
    size = np.abs(tap.distance)
    least, steepest = settings.smallest_distance, settings.cone_slope
    possible = (size >= least * (1 - SLACK)) & np.isfinite(size)
    possible &= np.abs(tap.rotation) <= steepest * size * (1 + SLACK)
    if np.all(possible):
        return None
    where = np.unravel_index(np.argmin(possible), possible.shape)
    residual, chosen = (
        f"{1e3 * x[where]:.4g} mm and {np.degrees(y[where]):.4g} degrees"
        for x, y in ((distance, rotation), tap)
    )
    return (
        f"for the residual {residual}, choose returns a tap of {chosen}, which is not possible; "
        f"the size of a tap is at least settings.smallest_distance ({1e3 * least:.4g} mm), and its "
        f"rotation at most settings.cone_slope ({1e-3 * math.degrees(steepest):.3g} degrees/mm) "
        "times the size"
    )
