import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tapping_cell.planning import PlannerSettings, PlanningError, make_planner
from tapping_cell.planning.two_tap import SECOND_TAP_MARGIN, two_tap_choice

SETTINGS = {name: PlannerSettings(variant=name) for name in ("retreat", "overshoot")}
variants = st.sampled_from(["retreat", "overshoot"])
distances = st.floats(0.0, 0.3)
rotations = st.floats(-math.pi, math.pi)
lines = st.sampled_from([0.0, 0.3, 0.6])


@given(distances, rotations, variants, lines)
def test_every_tap_is_in_the_cone_and_between_the_sizes(distance, rotation, variant, line):
    settings = SETTINGS[variant]
    tap = two_tap_choice(distance, rotation, settings, line)
    size = abs(float(tap.distance))
    assert settings.smallest_distance * (1 - 1e-12) <= size
    assert size <= settings.largest_distance * (1 + 1e-12)
    assert abs(float(tap.rotation)) <= settings.cone_slope * size * (1 + 1e-12)


@given(distances, rotations, variants, lines)
def test_the_opposite_sense_of_rotation_gives_the_mirror_image(distance, rotation, variant, line):
    one = two_tap_choice(distance, rotation, SETTINGS[variant], line)
    other = two_tap_choice(distance, -rotation, SETTINGS[variant], line)
    assert float(one.distance) == float(other.distance)
    assert float(one.rotation) == -float(other.rotation) or rotation == 0.0


@given(st.floats(0.0017, 0.12), st.floats(-1.0, 1.0), variants, lines)
def test_inside_the_cone_one_tap_is_sufficient(distance, share, variant, line):
    rotation = share * SETTINGS[variant].cone_slope * distance * (1 - 1e-9)
    tap = two_tap_choice(distance, rotation, SETTINGS[variant], line)
    assert float(tap.distance) == pytest.approx(distance)
    assert float(tap.rotation) == pytest.approx(rotation)


@given(st.floats(0.0, 0.03), st.floats(0.0, 0.35), variants, lines, st.floats(-1.0, 1.0))
# just outside the cone
@example(0.0234375, 0.1875, "overshoot", 0.3, 1.0)
@example(0.02, 0.13, "overshoot", 0.6, -1.0)
def test_a_second_tap_reaches_the_goal_from_anywhere_on_the_error_line(
    distance, rotation, variant, line, error
):
    settings = SETTINGS[variant]
    tap = two_tap_choice(distance, rotation, settings, line)
    second = abs(distance - float(tap.distance))
    left = rotation - float(tap.rotation) * (1.0 + error * line)
    if second < 1e-12:  # a direct tap reaches the goal
        assert abs(rotation - float(tap.rotation)) < 1e-12
        return
    assert second >= SECOND_TAP_MARGIN * settings.smallest_distance * (1 - 1e-9)
    assert abs(left) <= settings.cone_slope * second * (1 + 1e-9) + 1e-12


def test_the_papers_task_has_the_published_subgoals():
    retreat = make_planner("exact", SETTINGS["retreat"]).choose(0.010, math.radians(10.0))
    overshoot = make_planner("exact", SETTINGS["overshoot"]).choose(0.010, math.radians(10.0))
    assert 1e3 * float(retreat.distance) == pytest.approx(-10.0)
    assert math.degrees(float(retreat.rotation)) == pytest.approx(10.0 / 3.0)
    assert 1e3 * float(overshoot.distance) == pytest.approx(20.0)
    assert math.degrees(float(overshoot.rotation)) == pytest.approx(20.0 / 3.0)


def test_conservative_taps_are_longer_than_exact_ones():
    for settings in SETTINGS.values():
        exact = make_planner("exact", settings).choose(0.010, math.radians(10.0))
        careful = make_planner("conservative", settings).choose(0.010, math.radians(10.0))
        assert abs(float(careful.distance)) > 1.1 * abs(float(exact.distance))


def test_single_and_batch_choices_agree():
    rng = np.random.default_rng(3)
    r, theta = rng.uniform(0, 0.3, 200), rng.uniform(-3, 3, 200)
    for name in ("exact", "conservative", "multi", "optimal"):
        planner = make_planner(name)
        together = planner.choose(r, theta)
        single = [planner.choose(a, b) for a, b in zip(r, theta, strict=True)]
        assert np.allclose(together.distance, [float(tap.distance) for tap in single])
        assert np.allclose(together.rotation, [float(tap.rotation) for tap in single])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cone_slope": -1.0}, "cone_slope is -1.0"),
        ({"smallest_distance": math.nan}, "smallest_distance is nan"),
        ({"largest_distance": 0.001}, "largest_distance is 0.001"),
        ({"box": 2.0}, "box is 2.0"),
        ({"variant": "sideways"}, "'sideways'; choose one of retreat, overshoot"),
        ({"tolerance_position": 0.0}, "tolerance_position is 0.0"),
    ],
)
def test_settings_out_of_range_are_refused_with_value_and_range(change, words):
    with pytest.raises(PlanningError, match=words):
        PlannerSettings(**change)
