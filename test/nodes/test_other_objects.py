"""The planner avoids the other objects that the camera sees."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from builtin_interfaces.msg import Time
from tapping_cell_msgs.msg import ErrorCode, ObjectState, PlanState, TapCommand
from test_tap_planner import Actors, acted

from tapping_cell.configuration.cell import load_cell, load_further_objects
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.nodes.conversions import from_message, to_message
from tapping_cell.se2 import Pose

OTHER = shared_folder() / "objects" / "plain_disk_with_dot.yaml"
PATIENT = {
    "other_object_files": OTHER,
    **dict.fromkeys(
        (
            "ready_deadline",
            "observe_deadline",
            "place_deadline",
            "fire_deadline",
            "withdraw_deadline",
            "silence_limit",
        ),
        30.0,
    ),
}
"""Long time limits, because a busy machine may pause a process for seconds. These tests do not
check the limits."""
NAME, RADIUS = "plain disk with dot", 0.048
START, GOAL = Pose(-0.10, 0.0, 0.0), Pose(0.12, 0.0, 0.3)
BETWEEN = Pose(0.01, 0.02, 0.0)


class Other:
    """The other object, which the camera sees unless its pose is None."""

    def __init__(self, actors: Actors, pose: Pose | None) -> None:
        self.pose = pose
        actors.others = self._states

    def _states(self, stamp: Time) -> list[ObjectState]:
        pose = self.pose
        state = ObjectState(object_id=NAME, visible=pose is not None)
        state.header.stamp = stamp
        if pose is not None:
            state.pose.pose = to_message(pose)
        return [state]


def gap(command: TapCommand, other: Pose) -> float:
    """Return the smallest distance between the edges of the two disks along the straight path of a
    tap."""
    start, end = from_message(command.object_pose), from_message(command.predicted_pose)
    ways = [start.x + s * (end.x - start.x) for s in (0.0, 0.25, 0.5, 0.75, 1.0)]
    sides = [start.y + s * (end.y - start.y) for s in (0.0, 0.25, 0.5, 0.75, 1.0)]
    return min(
        math.hypot(x - other.x, y - other.y) - 2 * RADIUS for x, y in zip(ways, sides, strict=True)
    )


def test_the_object_is_moved_around_another_object() -> None:
    with acted(**PATIENT) as actors:
        actors.pose = START
        Other(actors, BETWEEN)
        actors.send(GOAL)
        end = actors.end(120.0)
        assert end.state == PlanState.REACHED, end.error_msg
        assert min(gap(tap, BETWEEN) for tap in actors.taps()) > 0.004
        assert max(abs(from_message(tap.object_pose).y) for tap in actors.taps()) > 0.05


def test_a_goal_occupied_by_another_object_is_refused_and_the_object_named() -> None:
    with acted(**PATIENT) as actors:
        actors.pose = START
        Other(actors, Pose(GOAL.x, GOAL.y + 0.02, 0.0))
        actors.send(GOAL)
        words = f"'{NAME}'"
        actors.bench.wait(lambda: any(words in plan.error_msg for plan in actors.plans), "refused")
        refused = next(plan for plan in actors.plans if words in plan.error_msg)
        assert refused.error_code == ErrorCode.GOAL_IN_KEEP_OUT
        assert actors.taps() == []


def test_an_object_without_observations_is_waited_for_and_named() -> None:
    with acted(other_object_files=OTHER) as actors:
        actors.pose = START
        actors.send(GOAL)
        end = actors.end()
        assert end.error_code == ErrorCode.NOT_READY and NAME in end.error_msg
        assert actors.taps() == []


def test_an_object_placed_in_the_path_of_a_tap_causes_replanning() -> None:
    with acted(**PATIENT) as actors:
        actors.pose, actors.arm_arrives = START, False
        other = Other(actors, None)
        actors.send(GOAL)
        actors.bench.wait(actors.taps, "a tap")
        first = actors.taps()[0]
        actors.arm_arrives = True
        other.pose = BETWEEN
        actors.bench.wait(lambda: len(actors.taps()) > 1, "another tap")
        ended = actors.commands[1]
        assert (ended.request, ended.tap_id) == (TapCommand.WITHDRAW, first.tap_id)
        assert gap(actors.taps()[1], BETWEEN) > 0.004


def test_inconsistent_files_are_refused(tmp_path: Path) -> None:
    cell = load_cell()
    with pytest.raises(ConfigurationError, match="the name 'aluminium disk'"):
        load_further_objects(cell, str(shared_folder() / "objects" / "aluminium_disk.yaml"))
    tall = tmp_path / "tall.yaml"
    text = OTHER.read_text().replace("height: 0.012", "height: 0.300")
    tall.write_text(text.replace("mass: 0.2455", "mass: 2.455"))
    with pytest.raises(ConfigurationError, match=r"300\.0 mm high, but the tip travels"):
        load_further_objects(cell, f" {tall} ,")
    renamed = tmp_path / "renamed.yaml"
    renamed.write_text(cell.object_path.read_text().replace("aluminium disk", "twin"))
    with pytest.raises(ConfigurationError, match="two objects have marker"):
        load_further_objects(cell, str(renamed))
