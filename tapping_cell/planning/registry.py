"""Planning methods by name: the built-in four, and those that other packages register.

Another package adds a method by an entry point of the group ``tapping_cell.planners`` whose object
is called with ``PlannerSettings`` and returns a ``Planner``:

    [project.entry-points."tapping_cell.planners"]
    mine = "my_package.my_module:MyPlanner"
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points

from tapping_cell.planning.conservative import ConservativePlanner
from tapping_cell.planning.errors import PlanningError, UnknownPlannerError
from tapping_cell.planning.exact import ExactPlanner
from tapping_cell.planning.interface import Planner
from tapping_cell.planning.multi import multi_planner
from tapping_cell.planning.optimal import OptimalPlanner
from tapping_cell.planning.settings import PlannerSettings

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
    """Every name that ``make_planner`` knows: the built-in methods first, then registered ones."""
    return [*BUILT_IN, *sorted(set(_registered()) - set(BUILT_IN))]


def require_planner(name: str) -> None:
    """Check that a planning method has this name, without making it.

    Raises:
        UnknownPlannerError: no such name; the sentence lists the names.
    """
    if name not in planner_names():
        raise UnknownPlannerError(
            f"there is no planning method {name!r}; known are {', '.join(planner_names())}"
        )


def make_planner(
    name: str, settings: PlannerSettings | None = None, *, background: bool = False
) -> Planner:
    """The planning method of that name; a built-in name cannot be taken by an entry point.

    Args:
        name: one of ``planner_names()``.
        settings: what the method is told; the paper's cell by default.
        background: ``optimal`` returns at once and solves in a thread while a method that needs no
            solving answers; the others need no time and ignore it.

    Raises:
        UnknownPlannerError: no such name; the sentence lists the names.
        PlanningError: a registered method that cannot be loaded or is not a ``Planner``.
    """
    require_planner(name)
    settings = PlannerSettings() if settings is None else settings
    if name == "optimal":
        return OptimalPlanner(settings, background=background)
    if name in BUILT_IN:
        return BUILT_IN[name](settings)
    registered = _registered()
    try:
        planner = registered[name].load()(settings)
    except Exception as error:  # a plug-in may raise anything; users see one sentence
        raise PlanningError(
            f"the registered planning method {name!r} ({registered[name].value}) cannot be made: "
            f"{error}"
        ) from error
    if not isinstance(planner, Planner):
        raise PlanningError(
            f"the registered planning method {name!r} ({registered[name].value}) made a "
            f"{type(planner).__name__}, which has no name, settings, choose and taps_to_go"
        )
    return planner
