"""The state machines make only the transitions of their tables."""

from enum import Enum

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.logic.transitions import StateMachine, UndefinedTransition, diagram, table


class Light(Enum):
    RED = "red"
    GREEN = "green"
    DARK = "dark"


class Event(Enum):
    TIMER = "timer"
    POWER_LOST = "power lost"


RULES = table(
    [
        ((Light.RED,), Event.TIMER, (Light.GREEN,)),
        ((Light.GREEN,), Event.TIMER, (Light.RED,)),
        ((Light.RED, Light.GREEN), Event.POWER_LOST, (Light.DARK,)),
    ]
)


@given(st.lists(st.tuples(st.sampled_from(Event), st.sampled_from(Light))))
def test_a_machine_follows_its_table_and_refuses_everything_else(moves):
    machine: StateMachine[Light, Event] = StateMachine(RULES, Light.RED)
    for event, target in moves:
        before = machine.state
        if target in RULES.get((before, event), frozenset()):
            machine.move(event, target)
            assert machine.state is target
        else:
            with pytest.raises(UndefinedTransition):
                machine.move(event, target)
            assert machine.state is before


def test_two_rows_for_one_event_are_an_error() -> None:
    row = ((Light.RED,), Event.TIMER, (Light.GREEN,))
    with pytest.raises(ValueError, match="two rows"):
        table([row, row])


def test_the_diagram_has_an_arrow_for_every_pair_of_states() -> None:
    assert diagram(RULES, Light.RED).splitlines() == [
        "stateDiagram-v2",
        "    [*] --> red",
        "    green --> dark: power lost",
        "    green --> red: timer",
        "    red --> dark: power lost",
        "    red --> green: timer",
    ]
