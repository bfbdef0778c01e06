"""The parameters of the planning node."""

from __future__ import annotations

from dataclasses import dataclass

from tapping_cell.configuration.schema import quantity, text


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of tap_planner."""

    autostart: bool = text("configure and activate without being asked", default=True)
    cell_file: str = text("path of the cell file; empty for the package's own", default="")
    object_file: str = text("path of the object file; empty for the cell file's", default="")
    other_object_files: str = text(
        "paths of the files of further objects on the table, separated by commas: kept clear of; "
        "the same as camera_pose's",
        default="",
    )
    others_memory: float = quantity(
        "time after which a further object that is no longer seen counts as taken away",
        "s",
        0.2,
        3600.0,
        default=5.0,
    )
    planner: str = text("planning method; empty for the cell file's", default="")
    adapt: bool = text("learn from every tap how the object answers", default=True)
    keep_gains: bool = text("remember what was learnt of an object between runs", default=False)
    frames_needed: int = quantity(
        "pictures at rest that a look must be fused of", "", 1, 1000, default=10
    )
    ready_deadline: float = quantity(
        "longest wait for arm, tapper and camera", "s", 1.0, 3600.0, default=30.0
    )
    look_deadline: float = quantity(
        "longest wait for the object at rest and seen", "s", 0.5, 600.0, default=10.0
    )
    place_deadline: float = quantity(
        "longest time to bring the striker to its place", "s", 1.0, 600.0, default=20.0
    )
    fire_deadline: float = quantity("longest time to draw and fire", "s", 0.5, 60.0, default=8.0)
    withdraw_deadline: float = quantity(
        "longest time to withdraw the arm", "s", 1.0, 600.0, default=20.0
    )
    silence_limit: float = quantity(
        "greatest age of what arm, tapper and camera say", "s", 0.1, 60.0, default=1.0
    )
    moved_limit: float = quantity(
        "distance by which the object may differ from where the tap was planned",
        "m",
        0.0001,
        0.1,
        default=0.002,
    )
    resume_within: float = quantity(
        "a planner that crashed goes on with its goal when it is back so soon; 0 never does",
        "s",
        0.0,
        600.0,
        default=15.0,
    )
    attempts: int = quantity(
        "taps in a row that may end without a release or without an effect", "", 1, 100, default=3
    )
