"""The spring's carriage when its motor loses steps, for all moments of the loss and of the
withdrawal."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.simulation.spring_drive import SpringDrive, SpringMechanism, Status

ENERGY_TOLERANCE = 0.03
"""Tolerance of the released energy, relative."""
SETTLED_S = 5.0
"""Time after which every movement has ended, s."""
moments = st.floats(0.0, 0.3)


def homed() -> SpringDrive:
    drive = SpringDrive(SpringMechanism(), 0.0)
    drive.home(0.0)
    drive.advance(1.0)
    assert drive.status is Status.THERE
    return drive


@given(
    withdrawn=st.one_of(st.floats(0.0, 0.02), moments),
    lost=st.one_of(st.floats(0.0, 0.02), moments),
    lasting=moments,
)
def test_steps_lost_in_a_withdrawn_charge_do_not_change_the_next_shot(withdrawn, lost, lasting):
    drive = homed()
    drive.charge(12.5e-3, 1.0)
    events = [
        (1.0 + withdrawn, drive.back),
        (1.0 + lost, lambda now: drive.set_power(False, now)),
        (1.0 + lost + lasting, lambda now: drive.set_power(True, now)),
    ]
    for time, action in sorted(events, key=lambda event: event[0]):
        drive.advance(time)
        action(time)
    drive.advance(1.0 + SETTLED_S)
    if drive.status is not Status.THERE:
        assert drive.status is Status.UNKNOWN
        return
    assert abs(drive.place(1.0 + SETTLED_S)) < 1.0
    energy = 4.2e-3
    drive.charge(energy, 1.0 + SETTLED_S)
    end = 1.0 + 2 * SETTLED_S
    drive.advance(end)
    assert drive.status is Status.THERE
    assert abs(drive.stored(end) - energy) <= ENERGY_TOLERANCE * energy
