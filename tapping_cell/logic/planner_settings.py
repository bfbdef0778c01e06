"""Settings of the planner, which the node declares as its parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tapping_cell.configuration.schema import choice, quantity, text


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """Limits and choices of the planner."""

    planner: str = text("planning method; if empty, the one named in the cell file", default="")
    objective: str = choice(
        "quantity to minimise: taps or time; if empty, the one in the cell file",
        "",
        "taps",
        "time",
        default="",
    )
    adapt: bool = text("learn from every tap how the object responds", default=True)
    keep_gains: bool = text(
        "keep what was learnt about an object's response between runs", default=False
    )
    probe: bool = text(
        "begin a goal with up to three of the smallest taps if the object's friction is not known",
        default=False,
    )
    ask: bool = text("wait for an operator to confirm every tap", default=False)
    confirm_deadline: float = quantity(
        "maximum wait for an operator to confirm a tap", "s", 1.0, 3600.0, default=120.0
    )
    others_memory: float = quantity(
        "time after which an obstacle that is no longer detected is assumed to have been removed; "
        "an arrangement waits for this time, but at most for 5 s, before it ignores the obstacle",
        "s",
        0.2,
        3600.0,
        default=5.0,
    )
    frames_needed: int = quantity(
        "minimum number of stationary frames to fuse", "", 1, 1000, default=3
    )
    goal_time_limit: float = quantity(
        "time after which a goal without a time limit of its own is aborted",
        "s",
        1.0,
        86400.0,
        default=600.0,
    )
    ready_deadline: float = quantity(
        "maximum wait for arm, tapper and camera to become ready", "s", 1.0, 3600.0, default=30.0
    )
    observe_deadline: float = quantity(
        "maximum wait for a measurement of the object at rest", "s", 0.5, 600.0, default=10.0
    )
    place_deadline: float = quantity(
        "maximum time to move the striker to its strike pose", "s", 1.0, 600.0, default=20.0
    )
    fire_deadline: float = quantity("maximum time to charge and fire", "s", 0.5, 60.0, default=8.0)
    withdraw_deadline: float = quantity(
        "maximum time to withdraw the arm", "s", 1.0, 600.0, default=20.0
    )
    silence_limit: float = quantity(
        "message timeout of arm, tapper and camera", "s", 0.1, 60.0, default=1.0
    )
    moved_limit: float = quantity(
        "maximum distance of the object from the pose for which the tap was planned",
        "m",
        0.0001,
        0.1,
        default=0.002,
    )
    turned_limit: float = quantity(
        "maximum rotation of the object since the tap was planned",
        "rad",
        0.001,
        3.2,
        default=math.radians(3.0),
    )
    resume_within: float = quantity(
        "a planner that crashed resumes its goal if it restarts within this time; 0: never",
        "s",
        0.0,
        600.0,
        default=15.0,
    )
    attempts: int = quantity(
        "maximum number of consecutive taps that did not fire or had no effect",
        "",
        1,
        100,
        default=3,
    )
    late_attempts: int = quantity(
        "maximum number of consecutive taps that did not fire because a message or image came too "
        "late, as on a busy machine",
        "",
        1,
        100,
        default=10,
    )
