"""Images of a slide are evenly spaced in simulated time, even if the machine is late."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.simulation.pacing import STEADY_S, Pace
from tapping_cell.simulation.truth import CameraTruth

PERIOD = 1 / 30


def play(pace: Pace, ticks: list[float], launch: float, slide: float) -> list[tuple[float, float]]:
    """Return the times of the images as (machine time, world time). The world is at rest except for
    one slide."""
    taken: list[tuple[float, float]] = []
    world = ticks[0]
    for now in ticks:
        # The slide begins at a given machine time and ends at a given world time.
        at_rest = now < launch or world >= launch + slide
        time = pace.next_picture(now, at_rest)
        if time is not None:
            world = time
            taken.append((now, time))
    return taken


@given(
    late=st.lists(st.floats(0.0, 0.4), min_size=300, max_size=300),
    slow_motion=st.sampled_from([1.0, 3.0]),
)
def test_a_slide_is_evenly_sampled_on_a_slow_computer(late, slow_motion):
    ticks = (np.cumsum(np.full(300, PERIOD) + np.array(late) * (np.arange(300) % 3 == 0))).tolist()
    launch, slide = 1.5, 0.3
    taken = play(Pace(PERIOD, slow_motion), ticks, launch, slide)
    machine, world = np.array(taken).T
    assert np.all(np.diff(world) >= 0)
    assert np.all(world <= machine)
    during = (world >= launch) & (world < launch + slide + STEADY_S - 2 * PERIOD)
    steps = np.diff(world[during])
    assert np.all(steps <= PERIOD + 1e-9)
    assert len(steps) >= 0.9 * slide / PERIOD


def test_at_rest_the_simulated_time_matches_the_computer_clock() -> None:
    pace = Pace(PERIOD, 4.0)
    for now in (1.0, 1.03, 1.5, 9.0):
        assert pace.next_picture(now, at_rest=True) == now


def test_the_simulated_time_catches_up_after_a_slide() -> None:
    pace = Pace(PERIOD)
    ticks = [1.0 + 0.2 * k for k in range(60)]
    taken = play(pace, ticks, launch=1.5, slide=0.2)
    assert taken[-1][0] == taken[-1][1]
    lag = [machine - world for machine, world in taken]
    assert max(lag) > 0.5


def test_slow_motion_extends_a_slide_by_its_factor() -> None:
    ticks = [1.0 + k * PERIOD for k in range(600)]
    spans = []
    for slow_motion in (1.0, 5.0):
        taken = play(Pace(PERIOD, slow_motion), ticks, launch=2.0, slide=0.5)
        moving = [machine for machine, world in taken if 2.0 <= world < 2.5]
        spans.append(moving[-1] - moving[0])
    assert spans[1] / spans[0] == pytest.approx(5.0, rel=0.1)


def test_an_exposure_longer_than_the_time_between_two_images_is_refused() -> None:
    CameraTruth(exposure=0.008).check_rate(120.0)
    with pytest.raises(ConfigurationError, match=r"9 ms, longer than the 8\.3 ms .* at 120 Hz"):
        CameraTruth(exposure=0.009).check_rate(120.0)
    CameraTruth(exposure=0.002, readout=0.006).check_rate(120.0)
    with pytest.raises(ConfigurationError, match=r"2 ms and the read-out takes 7 ms, longer than"):
        CameraTruth(exposure=0.002, readout=0.007).check_rate(120.0)
