"""Objects without a file in ``object_states``: goals avoid them, a goal on one of them is refused,
and no tap is planned before the table has been searched."""

from __future__ import annotations

import math

import pytest
from test_planner_with_played_devices import Actors

from tapping_cell.configuration.cell import load_cell
from tapping_cell.logic.clock import Now
from tapping_cell.logic.objects_on_table import ObjectsOnTable
from tapping_cell.logic.peer_clock import PeerClock
from tapping_cell.logic.poses import to_message
from tapping_cell.messages import (
    ErrorCode,
    ObjectState,
    PlanState,
    Point32,
    Polygon,
    TapCommand,
    Time,
    UnknownObjects,
)
from tapping_cell.planning import PolygonArea
from tapping_cell.se2 import Pose

START, GOAL = Pose(-0.12, 0.0, 0.0), Pose(0.12, 0.0, 0.3)
HALF = 0.03


def square_at(x: float, y: float) -> Polygon:
    corners = [(-HALF, -HALF), (HALF, -HALF), (HALF, HALF), (-HALF, HALF)]
    return Polygon(points=[Point32(x=x + u, y=y + v) for u, v in corners])


class Searching(Actors):
    """Simulated devices; the camera also searches for objects without a file."""

    def __init__(self, *unknown: Polygon) -> None:
        self.unknown = list(unknown)
        self.searching = True
        super().__init__()
        self.searches = True
        self.pose = START
        self.scheduler.after(0.0, self._search)

    def _search(self) -> None:
        if self.searching:
            found = UnknownObjects(outlines=self.unknown)
            found.header.stamp = self.stamp()
            self.publish("unknown_objects", found)
        self.scheduler.after(0.03, self._search)

    def taps(self) -> list[TapCommand]:
        return [each for each in self.commands if each.request == TapCommand.TAP]

    def ended(self) -> PlanState:
        self.wait(
            lambda: self.plans[-1].state in (PlanState.REACHED, PlanState.FAILED), "the end", 300.0
        )
        return self.plans[-1]


def test_an_object_without_a_file_is_avoided() -> None:
    actors = Searching(square_at(0.0, 0.0))
    actors.send(GOAL)
    assert actors.ended().state == PlanState.REACHED
    way = [each.object_pose.position.y for each in actors.taps()]
    assert max(abs(y) for y in way) > 0.05


def test_a_goal_on_an_unknown_object_is_refused_with_its_position() -> None:
    actors = Searching(square_at(0.10, 0.0))
    actors.send(GOAL)
    actors.wait(lambda: actors.plans[-1].error_code, "the refusal")
    last = actors.plans[-1]
    assert last.error_code == ErrorCode.GOAL_IN_KEEP_OUT
    assert "unknown object at x 100 mm, y 0 mm" in last.error_msg
    assert actors.taps() == []


def test_no_tap_is_planned_before_the_table_was_searched_since_the_last_motion() -> None:
    actors = Searching()
    actors.send(GOAL)
    actors.wait(lambda: len(actors.taps()) == 1, "a tap")
    actors.searching = False
    last = actors.ended()
    assert last.error_code == ErrorCode.NOT_READY and "search" in last.error_msg
    assert len(actors.taps()) == 1


def test_a_camera_that_does_not_search_is_not_waited_for() -> None:
    actors = Searching()
    actors.searching = actors.searches = False
    actors.send(GOAL)
    assert actors.ended().state == PlanState.REACHED


def outlines(*found: Polygon) -> UnknownObjects:
    message = UnknownObjects(outlines=list(found))
    message.header.stamp = Time(sec=10)
    return message


def test_outlines_are_areas_and_a_moved_one_counts_as_moved() -> None:
    others, clock, now = ObjectsOnTable((), 5.0, 0.002), PeerClock(), Now(10.0, 10_000_000_000)
    assert others.searched(1e9)
    clock.receive(Time(sec=10), now)
    others.search(True)
    others.on_unknown(outlines(square_at(0.1, 0.0)), clock, now)
    (area,) = before = others.areas(now)
    assert isinstance(area, PolygonArea) and float(area.distance([0.1, 0.0])) < 0.0
    assert others.searched(9.0) and not others.searched(11.0)
    assert not others.moved_since(before, now)
    others.on_unknown(outlines(square_at(0.12, 0.0)), clock, now)
    assert others.moved_since(before, now)


@pytest.mark.parametrize(
    "corners",
    [
        [],
        [(0.1, 0.0), (0.2, 0.0)],
        [(0.1, 0.0), (0.2, 0.0), (math.nan, 0.1)],
        [(0.1, 0.0), (math.inf, 0.0), (0.2, 0.1)],
        [(0.1, 0.0), (1e30, 0.0), (0.2, 0.1)],
    ],
)
def test_an_outline_that_bounds_no_area_is_skipped(corners: list[tuple[float, float]]) -> None:
    others, clock, now = ObjectsOnTable((), 5.0, 0.002), PeerClock(), Now(10.0, 10_000_000_000)
    outline = Polygon(points=[Point32(x=x, y=y) for x, y in corners])
    others.search(True)
    others.on_unknown(outlines(outline, square_at(0.1, 0.0)), clock, now)
    (area,) = others.unknown
    assert float(area.distance([0.1, 0.0])) < 0.0


def test_a_goal_goes_on_after_an_empty_outline() -> None:
    actors = Searching(Polygon())
    actors.send(GOAL)
    assert actors.ended().state == PlanState.REACHED
    assert actors.reported_errors() == []


@pytest.mark.parametrize("wrong", [(math.nan, 0.0, 0.0), (0.0, -1e30, 0.0), (0.0, 0.0, math.nan)])
def test_a_pose_that_is_not_on_a_table_is_no_observation(wrong: tuple[float, float, float]) -> None:
    file = load_cell().object
    others, clock, now = ObjectsOnTable((file,), 5.0, 0.002), PeerClock(), Now(10.0, 10_000_000_000)
    message = ObjectState(object_id=file.name, visible=True)
    message.header.stamp = Time(sec=9)
    message.pose.pose = to_message(Pose(*wrong))
    others.on_object(message, clock, now)
    assert others.areas(now) == (None,)
    message = ObjectState(object_id=file.name, visible=True)
    message.header.stamp = Time(sec=10)
    message.pose.pose = to_message(Pose(0.1, 0.0, 0.0))
    others.on_object(message, clock, now)
    (area,) = others.areas(now)
    assert area is not None and float(area.distance([0.1, 0.0])) < 0.0


def test_a_camera_that_no_longer_searches_reports_no_unknown_objects() -> None:
    others, clock, now = ObjectsOnTable((), 5.0, 0.002), PeerClock(), Now(100.0, 100_000_000_000)
    others.search(True)
    others.on_unknown(outlines(square_at(0.0, 0.0)), clock, now)
    assert others.unknown and not others.searched(150.0)
    others.search(False)  # camera_pose was restarted without the search
    assert not others.unknown and others.searched(150.0)


def test_no_tap_is_commanded_before_the_first_search() -> None:
    actors = Searching()
    actors.searching = False
    actors.send(GOAL)
    actors.run(1.0)
    assert actors.plans[-1].state == PlanState.LOOKING and not actors.taps()
    actors.searching = True
    assert actors.ended().state == PlanState.REACHED


def test_an_obstacle_under_the_arm_is_remembered_until_the_arm_has_left() -> None:
    file = load_cell().object
    others, clock = ObjectsOnTable((file,), 5.0, 0.002), PeerClock()
    seen = ObjectState(object_id=file.name, visible=True)
    seen.header.stamp = Time(sec=10)
    seen.pose.pose = to_message(Pose(0.1, 0.0, 0.0))
    others.on_object(seen, clock, Now(10.0, 10_000_000_000))
    for time in range(11, 40):
        hidden, now = ObjectState(object_id=file.name), Now(float(time), time * 1_000_000_000)
        others.on_object(hidden, clock, now, covered=time < 30)
        assert (others.areas(now) == (None,)) == (time > 34)
