"""Planning: choice of the next tap, learning from taps, strikes, and evaluation of the methods.

Example::

    planner = make_planner("exact", PlannerSettings(cone_slope=tap.cone_slope))
    space = StrikeSpace(tap, Workspace(), arm_reach)
    session = PositioningSession(goal_pose, planner, space)
    decision = session.decide(object_pose, covariance)  # Done, Strike or Refusal
    ...  # fire decision.plan, measure the pose again
    session.observe(decision, object_pose, pose_after)
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
