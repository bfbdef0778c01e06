"""Planning: choice of the next tap, learning from taps, strikes, and evaluation of the methods.

The closed loop of a cell (docs/planning.md)::

    session = tapping_cell.configuration.assembly.make_session(cell, goal)
    for decision in session.decisions(observe):  # Strike, ObserveAgain; at last Done or Refusal
        if isinstance(decision, Strike):
            ...  # fire decision.plan
"""

from tapping_cell.planning.errors import PlanningError, UnknownPlannerError
from tapping_cell.planning.free_space import FreeSpace
from tapping_cell.planning.gains import Gains
from tapping_cell.planning.goal import check_goal
from tapping_cell.planning.interface import Planner, Taps
from tapping_cell.planning.kept_gains import keep_gains, load_gains
from tapping_cell.planning.prescribed import PrescribedSession, Prescription, cautious
from tapping_cell.planning.refusal import Refusal, RefusalReason
from tapping_cell.planning.registry import make_planner, planner_names, require_planner
from tapping_cell.planning.session import Decision, Done, ObserveAgain, PositioningSession, Strike
from tapping_cell.planning.settings import CameraNoise, PlannerSettings, Scatter
from tapping_cell.planning.stopping import StoppingBox, stopping_box
from tapping_cell.planning.strike import (
    ArmReach,
    StrikePlan,
    StrikeSettings,
    StrikeSpace,
    reach_everywhere,
)
from tapping_cell.planning.workspace import CircleArea, KeepOut, PolygonArea, Workspace

__all__ = [
    "ArmReach",
    "CameraNoise",
    "CircleArea",
    "Decision",
    "Done",
    "FreeSpace",
    "Gains",
    "KeepOut",
    "ObserveAgain",
    "Planner",
    "PlannerSettings",
    "PlanningError",
    "PolygonArea",
    "PositioningSession",
    "PrescribedSession",
    "Prescription",
    "Refusal",
    "RefusalReason",
    "Scatter",
    "StoppingBox",
    "Strike",
    "StrikePlan",
    "StrikeSettings",
    "StrikeSpace",
    "Taps",
    "UnknownPlannerError",
    "Workspace",
    "cautious",
    "check_goal",
    "keep_gains",
    "load_gains",
    "make_planner",
    "planner_names",
    "reach_everywhere",
    "require_planner",
    "stopping_box",
]
