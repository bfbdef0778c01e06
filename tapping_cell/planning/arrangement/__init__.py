"""Arrangement of several objects: choice of the next object to move and of its tap.

Example::

    maps = AmongOthers()
    bodies = [Body("left", FreeSpace(space), planner, goal_pose), ...]
    session = ArrangementSession(bodies, maps=maps)
    decision = session.decide({"left": Observation(pose, covariance), ...})
    # AllDone, ObserveLonger, TapOf(name, strike, move) or Refusal
    ...  # fire decision.strike.plan, measure the pose of every object again
    session.observe(decision, before, after)

Contacts between objects are never planned. Other objects are represented by bounding circles;
obstacles, such as objects without a file, are represented by their outlines
(``ArrangementSession.avoid``). Objects may be put on the table or taken away during an arrangement
(``ArrangementSession.set_bodies``).
"""

from tapping_cell.planning.arrangement.among import AmongOthers, bodies_among
from tapping_cell.planning.arrangement.baselines import FileOrder, NearestFirst
from tapping_cell.planning.arrangement.interface import (
    ArrangementPlanner,
    Body,
    Move,
    Purpose,
    Scene,
)
from tapping_cell.planning.arrangement.layout import check_goals, check_layout
from tapping_cell.planning.arrangement.presets import (
    PRESETS,
    middle_of,
    preset_goals,
    preset_places,
)
from tapping_cell.planning.arrangement.sequence import SequencePlanner
from tapping_cell.planning.arrangement.session import (
    AllDone,
    ArrangementDecision,
    ArrangementSession,
    Observation,
    ObserveLonger,
    TapOf,
)

__all__ = [
    "PRESETS",
    "AllDone",
    "AmongOthers",
    "ArrangementDecision",
    "ArrangementPlanner",
    "ArrangementSession",
    "Body",
    "FileOrder",
    "Move",
    "NearestFirst",
    "Observation",
    "ObserveLonger",
    "Purpose",
    "Scene",
    "SequencePlanner",
    "TapOf",
    "bodies_among",
    "check_goals",
    "check_layout",
    "middle_of",
    "preset_goals",
    "preset_places",
]
