"""What a person may set of the planner's machine; the node declares these as its parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tapping_cell.configuration.schema import choice, quantity, text


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """Limits and choices of the planner's machine."""

    planner: str = text("planning method; empty for the cell file's", default="")
    objective: str = choice(
        "what goals are reached with the fewest of; empty for the cell file's",
        "",
        "taps",
        "time",
        default="",
    )
    adapt: bool = text("learn from every tap how the object responds", default=True)
    keep_gains: bool = text("remember what was learnt of an object between runs", default=False)
    probe: bool = text(
        "begin with up to three of the smallest taps where the object's friction is not known",
        default=False,
    )
    ask: bool = text("ask a person to confirm every tap before it is made", default=False)
    confirm_deadline: float = quantity(
        "longest wait for a person's confirmation of a tap", "s", 1.0, 3600.0, default=120.0
    )
    others_memory: float = quantity(
        "time after which another object that is no longer seen counts as taken away",
        "s",
        0.2,
        3600.0,
        default=5.0,
    )
    frames_needed: int = quantity(
        "minimum number of stationary frames to fuse", "", 1, 1000, default=5
    )
    goal_time_limit: float = quantity(
        "time after which a goal that states no limit is given up", "s", 1.0, 86400.0, default=600.0
    )
    ready_deadline: float = quantity(
        "longest wait for arm, tapper and camera", "s", 1.0, 3600.0, default=30.0
    )
    look_deadline: float = quantity(
        "longest wait for an observation of the object at rest", "s", 0.5, 600.0, default=10.0
    )
    place_deadline: float = quantity(
        "longest time to bring the striker to its strike pose", "s", 1.0, 600.0, default=20.0
    )
    fire_deadline: float = quantity("longest time to charge and fire", "s", 0.5, 60.0, default=8.0)
    withdraw_deadline: float = quantity(
        "longest time to withdraw the arm", "s", 1.0, 600.0, default=20.0
    )
    silence_limit: float = quantity(
        "message timeout of arm, tapper and camera", "s", 0.1, 60.0, default=1.0
    )
    moved_limit: float = quantity(
        "distance by which the object may differ from where the tap was planned",
        "m",
        0.0001,
        0.1,
        default=0.002,
    )
    turned_limit: float = quantity(
        "rotation by which the object may differ from where the tap was planned",
        "rad",
        0.001,
        3.2,
        default=math.radians(3.0),
    )
    resume_within: float = quantity(
        "a planner that crashed resumes its goal when it is back so soon; 0 never does",
        "s",
        0.0,
        600.0,
        default=15.0,
    )
    attempts: int = quantity(
        "consecutive taps that may end without a release or without an effect",
        "",
        1,
        100,
        default=3,
    )
