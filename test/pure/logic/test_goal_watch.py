"""A client's wait for a goal ends within a limited time, whatever happens to the planner."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.logic.goal_watch import (
    FINAL_STATES,
    GRACE_S,
    LOST_RESULT_S,
    RESUMING_S,
    RETURN_S,
    SILENCE_S,
    Ended,
    GoalWatch,
)
from tapping_cell.messages import ErrorCode, PlanState
from tapping_cell.se2 import Pose

GOAL = Pose(0.1, 0.02, 0.3)
OLD, NEW = b"old", b"new"
PERIOD = 0.25


class Client:
    """A client that checks the planner's state every PERIOD seconds until the wait ends."""

    def __init__(self) -> None:
        self.now = 100.0
        self.watch = GoalWatch(GOAL, frozenset({OLD}), self.now)
        self.received = self.now
        self.plan: PlanState | None = None
        self.pose: Pose | None = None

    def wait(
        self, patience: float, state: int | None, who: bytes = OLD, pose: Pose = GOAL, code: int = 0
    ) -> Ended | None:
        """Wait for ``patience`` s while the planner publishes ``state`` (None: it publishes
        nothing). Return how the wait ended, or None if it has not ended."""
        end = self.now + patience
        while self.now < end:
            self.now += PERIOD
            planners = {OLD, who}
            if state is not None:
                self.received, self.pose = self.now, pose
                self.plan = PlanState(state=state, error_code=code, error_msg="why" if code else "")
            found = self.watch.check(
                self.plan, self.pose, self.received, frozenset(planners), self.now
            )
            if found is not None:
                return found
        return None


def test_a_working_planner_is_waited_for() -> None:
    client = Client()
    assert client.wait(3600.0, PlanState.PLACING) is None and not client.watch.gone


@given(st.sampled_from(FINAL_STATES), st.sampled_from([0, ErrorCode.TAP_LIMIT_REACHED]))
def test_the_reported_end_counts_if_the_result_is_lost(state: int, code: int) -> None:
    client = Client()
    # The report of an earlier goal, which was sent again.
    assert client.wait(LOST_RESULT_S - PERIOD, state, code=code) is None
    assert client.wait(60.0, PlanState.PLACING) is None
    assert client.wait(60.0, state, pose=Pose(0.0, 0.0, 0.0), code=code) is None
    ended = client.now
    assert client.wait(60.0, state, code=code) == Ended(code, "why" if code else "")
    assert LOST_RESULT_S <= client.now - ended <= LOST_RESULT_S + 2 * PERIOD
    assert not client.watch.gone


def test_a_planner_that_does_not_return_ends_the_wait() -> None:
    client = Client()
    client.wait(10.0, PlanState.PLACING)
    died = client.now
    ended = client.wait(1e3, None)
    assert ended is not None and ended.code == ErrorCode.NOT_READY
    assert "30 s" in ended.sentence
    assert client.now - died <= RETURN_S + 2 * PERIOD


def test_a_goal_that_is_resumed_is_followed_to_its_end() -> None:
    client = Client()
    client.wait(5.0, PlanState.PLACING)
    client.wait(8.0, None)
    assert client.watch.gone
    assert client.wait(2.0, PlanState.IDLE, NEW, Pose(0, 0, 0)) is None
    assert client.wait(300.0, PlanState.PLACING, NEW) is None
    assert client.wait(5.0, PlanState.REACHED, NEW) == Ended(ErrorCode.NONE, "")


def test_a_planner_that_restarts_before_its_timeout_is_detected() -> None:
    client = Client()
    client.wait(5.0, PlanState.PLACING)
    client.wait(SILENCE_S / 2, None)
    client.wait(1.0, PlanState.WAITING_FOR_CELL, NEW)
    assert client.watch.gone, "its publisher is another one"
    ended = client.wait(5.0, PlanState.FAILED, NEW, code=ErrorCode.ARM_TIMEOUT)
    assert ended == Ended(ErrorCode.ARM_TIMEOUT, "why")


def test_a_planner_that_forgot_the_goal_ends_the_wait() -> None:
    client = Client()
    client.wait(5.0, PlanState.PLACING)
    back = client.now
    ended = client.wait(1e3, PlanState.IDLE, NEW, Pose(0, 0, 0))
    assert ended is not None and ended.code == ErrorCode.NOT_READY
    assert "did not resume" in ended.sentence
    assert client.now - back <= RESUMING_S + 2 * PERIOD


def test_a_planner_that_continues_after_a_freeze_reports_the_end_of_its_goal() -> None:
    """After the freeze the planner continues. When it reports the end of the goal, the client still
    waits up to GRACE_S for the result of the action."""
    client = Client()
    client.wait(5.0, PlanState.PLACING)
    client.wait(SILENCE_S + 1.0, None)
    assert client.wait(60.0, PlanState.PLACING) is None
    assert client.wait(GRACE_S - 2 * PERIOD, PlanState.REACHED) is None
    assert client.wait(5.0, PlanState.REACHED) is not None


def test_a_report_from_before_the_goal_does_not_end_it() -> None:
    """The planner had reached the same goal before. It dies as soon as the goal is sent, and its
    successor publishes nothing yet."""
    client = Client()
    client.plan, client.pose = PlanState(state=PlanState.REACHED), GOAL
    assert client.wait(RESUMING_S - 2 * PERIOD, None, NEW) is None
    assert client.watch.gone
    ended = client.wait(1e3, None, NEW)
    assert ended is not None and ended.code == ErrorCode.NOT_READY


def test_a_report_of_a_planner_that_has_ended_does_not_end_the_goal() -> None:
    """The planner dies before it has accepted the goal, and its last report is that it has reached
    an earlier goal with the same pose."""
    client = Client()
    client.wait(1.0, PlanState.REACHED)
    assert client.wait(GRACE_S + 2 * PERIOD, None, NEW) is None


def test_a_goal_with_another_angle_is_another_goal() -> None:
    client = Client()
    turned = Pose(GOAL.x, GOAL.y, GOAL.theta + 1.5)
    client.wait(1.0, PlanState.PLACING)
    ended = client.wait(1e3, PlanState.REACHED, NEW, turned)
    assert ended is not None and ended.code == ErrorCode.NOT_READY


def test_a_planner_that_restarts_late_in_a_goal_has_time_to_resume_it() -> None:
    client = Client()
    client.wait(60.0, PlanState.PLACING)
    assert client.wait(SILENCE_S / 2, None, NEW) is None
    assert client.wait(60.0, PlanState.PLACING, NEW) is None


@given(
    st.lists(
        st.tuples(
            st.floats(0.3, 60.0),
            st.sampled_from([None, PlanState.IDLE, PlanState.REACHED, PlanState.FAILED]),
            st.sampled_from([OLD, NEW]),
            st.booleans(),
        ),
        min_size=1,
        max_size=8,
    )
)
def test_without_a_working_planner_the_wait_is_bounded(illustrated):
    client = Client()
    client.wait(1.0, PlanState.PLACING)
    client.wait(SILENCE_S + 1.0, None)
    began = client.now
    for patience, state, who, own in illustrated:
        if client.wait(patience, state, who, GOAL if own else Pose(9.0, 0.0, 0.0)) is not None:
            break
    else:
        assert client.wait(1e3, None) is not None
    longest = (
        sum(patience for patience, *_ in illustrated)
        + RETURN_S
        + 2 * len(illustrated) * PERIOD
        + 1.0
    )
    assert client.now - began <= longest
