"""Each state can be left, either by a person's action or after some time."""

from enum import Enum
from types import ModuleType

import pytest

from tapping_cell.logic import arm_states, tapper_states


@pytest.mark.parametrize(
    ("machine", "rest"),
    [(arm_states, arm_states.State.IDLE), (tapper_states, tapper_states.State.SAFE)],
    ids=["arm", "tapper"],
)
def test_every_state_leads_back_to_the_rest_state(machine: ModuleType, rest: Enum) -> None:
    """From each state, a sequence of transitions leads back to the resting state."""
    leads = {rest}
    grown = True
    while grown:
        more = {
            state
            for (state, _), targets in machine.TABLE.items()
            if targets & leads and state not in leads
        }
        leads |= more
        grown = bool(more)
    assert leads == set(machine.State)


@pytest.mark.parametrize("machine", [arm_states, tapper_states], ids=["arm", "tapper"])
def test_every_state_can_be_stopped(machine: ModuleType) -> None:
    for state in machine.State:
        assert machine.TABLE[state, machine.Event.STOP] == {machine.State.STOPPED}
