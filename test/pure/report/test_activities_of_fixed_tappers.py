"""The timeline of a run with fixed tappers: charging, motion of the striker, slide, images,
decision."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.messages import ObjectState, PlanState, TapperState
from tapping_cell.report.activities import activities


class Recorded:
    """A bag with messages at the given times, s."""

    def __init__(self, *messages: tuple[str, float, Any]) -> None:
        self._messages = messages

    def of(self, topic: str) -> list[tuple[int, Any]]:
        return [(0, stamped(at, message)) for name, at, message in self._messages if name == topic]

    def of_own_object(self) -> list[Any]:
        return [message for _, message in self.of("object")]


def stamped(at: float, message: Any) -> Any:
    message.header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=at * 1e9))
    return message


def tapper(state: int, outcome: int = TapperState.NONE) -> TapperState:
    return TapperState(state=state, outcome=outcome, fixed_mounts=True)


def test_a_tap_is_described_by_the_activities_of_tapper_and_object() -> None:
    bag = Recorded(
        ("plan_state", 0.0, PlanState(state=PlanState.LOOKING)),
        ("object", 0.1, ObjectState(visible=True, at_rest=True)),
        ("plan_state", 0.3, PlanState(state=PlanState.FIRING)),
        ("tapper_state", 0.4, tapper(TapperState.CHARGING)),
        ("tapper_state", 0.5, tapper(TapperState.FIRING)),
        ("tapper_state", 0.6, tapper(TapperState.FIRING, TapperState.FIRED)),
        ("object", 0.8, ObjectState(visible=True, at_rest=False)),
        ("object", 1.0, ObjectState(visible=True, at_rest=True)),
        ("tapper_state", 1.1, tapper(TapperState.SAFE, TapperState.FIRED)),
        ("plan_state", 1.15, PlanState(state=PlanState.LOOKING)),
        ("plan_state", 1.2, PlanState(state=PlanState.REACHED)),
    )
    found = activities(bag, 0.0, 2.0)  # type: ignore[arg-type]
    assert [(round(step.began, 6), step.name) for step in found] == [
        (0.0, "the camera measures"),
        (0.3, "the planner waits or plans"),
        (0.4, "the tapper charges and fires"),
        (0.6, "the striker flies or returns"),
        (0.8, "the object slides"),
        (1.0, "the striker flies or returns"),
        (1.1, "the planner waits or plans"),
        (1.15, "the camera measures"),
        (1.2, "the planner waits or plans"),
    ]


@given(
    st.lists(
        st.tuples(st.floats(0.0, 10.0), st.sampled_from(range(7)), st.sampled_from(range(4))),
        min_size=1,
        max_size=20,
    ),
    st.floats(0.0, 5.0),
)
def test_activities_follow_each_other_without_gaps(rows, began):
    bag = Recorded(*(("tapper_state", at, tapper(state, told)) for at, state, told in rows))
    found = activities(bag, began, 10.0)  # type: ignore[arg-type]
    assert all(one.name != two.name for one, two in itertools.pairwise(found))
    assert all(0.0 <= one.began <= two.began for one, two in itertools.pairwise(found))


def test_there_are_no_activities_without_an_arm_or_fixed_tappers() -> None:
    bag = Recorded(("plan_state", 0.0, PlanState(state=PlanState.LOOKING)))
    assert activities(bag, 0.0, 1.0) == ()  # type: ignore[arg-type]
