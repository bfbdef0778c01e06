"""Several objects, each to its place: which object next, by which tap.

The whole of it in use::

    maps = AmongOthers()
    bodies = [Body("left", FreeSpace(space), planner, goal_pose), ...]
    session = ArrangementSession(bodies, maps=maps)
    decision = session.decide({"left": Observation(pose, covariance), ...})
    # AllDone, LookLonger, TapOf(name, strike, move) or Refusal
    ...  # fire decision.strike.plan, look again at every object
    session.observe(decision, before, after)

Deliberate contact between objects is not planned. Another object counts as its bounding circle.
"""

from tapping_cell.planning.arrangement.among import AmongOthers
from tapping_cell.planning.arrangement.baselines import FileOrder, NearestFirst
from tapping_cell.planning.arrangement.interface import (
    ArrangementPlanner,
    Body,
    Move,
    Purpose,
    Scene,
)
from tapping_cell.planning.arrangement.layout import check_layout
from tapping_cell.planning.arrangement.sequence import SequencePlanner
from tapping_cell.planning.arrangement.session import (
    AllDone,
    ArrangementDecision,
    ArrangementSession,
    LookLonger,
    Observation,
    TapOf,
)

__all__ = [
    "AllDone",
    "AmongOthers",
    "ArrangementDecision",
    "ArrangementPlanner",
    "ArrangementSession",
    "Body",
    "FileOrder",
    "LookLonger",
    "Move",
    "NearestFirst",
    "Observation",
    "Purpose",
    "Scene",
    "SequencePlanner",
    "TapOf",
    "check_layout",
]
