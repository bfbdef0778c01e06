"""After a tap by a fixed tapper, an image shows the result only if the object came to rest after
the strike."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st
from logic_parts import alone

from tapping_cell.logic.cell_monitor import QUICKEST_IMAGE_S, CellMonitor
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.messages import ObjectState

STRUCK = 100.0
MOMENTS = st.floats(-5.0, 5.0, allow_nan=False)


def monitor(rest: float, *, at_rest: bool = True, visible: bool = True) -> tuple[CellMonitor, Now]:
    """Return a monitor that has received an image. In this image the object has been at rest since
    ``rest`` s after the strike."""
    at = STRUCK + 6.0
    now = Now(at, round(1e9 * at))
    state = ObjectState(visible=visible, at_rest=at_rest)
    state.header.stamp = to_stamp(now.ros)
    state.at_rest_since = to_stamp(round(1e9 * (STRUCK + rest)))
    made = CellMonitor(1.0)
    made.on_objects(alone(state), now)
    return made, now


@given(MOMENTS)
def test_only_a_rest_that_began_after_the_strike_counts(rest: float) -> None:
    seen, now = monitor(rest)
    if abs(rest - QUICKEST_IMAGE_S) > 1e-6:
        assert seen.at_rest_after(STRUCK, now) == (rest > QUICKEST_IMAGE_S)
    assert not seen.at_rest_after(math.inf, now)


def test_an_object_that_moves_or_is_hidden_is_not_at_rest() -> None:
    for seen, now in (monitor(1.0, at_rest=False), monitor(1.0, visible=False)):
        assert not seen.at_rest_after(STRUCK, now)
    assert not CellMonitor(1.0).at_rest_after(STRUCK, Now(STRUCK, 0))
