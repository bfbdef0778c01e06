"""Registry of planning methods: four built-in methods and methods of other packages.

Another package adds a method by an entry point of the group ``tapping_cell.planners``. The entry
point's object is called with ``PlannerSettings`` and must return a ``Planner``:

    [project.entry-points."tapping_cell.planners"]
    mine = "my_package.my_module:MyPlanner"
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points

from tapping_cell.planning.errors import PlanningError, UnknownPlannerError
from tapping_cell.planning.interface import Planner
from tapping_cell.planning.multi import multi_planner
from tapping_cell.planning.optimal import OptimalPlanner
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.two_tap import ConservativePlanner, ExactPlanner

ENTRY_POINT_GROUP = "tapping_cell.planners"

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
    if name not in planner_names():
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
        PlanningError: a registered method cannot be loaded or is not a ``Planner``.
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
        PlanningError: the class cannot be loaded or is not a ``Planner``.
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
    return planner
