import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.planning import CameraNoise, Gains, PlanningError, Scatter, keep_gains, load_gains
from tapping_cell.planning.gains import HIGHEST, LOWEST, NAMES, Slid, plan_rotation
from tapping_cell.planning.kept_gains import gains_file

SCATTER, CAMERA = Scatter(), CameraNoise(1e-4, math.radians(0.1))
FILE = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0)
"""Gains (corrections of the model) of an object that behaves as its file says, in the order of
``NAMES``."""
BOX = math.radians(1.0)


def answer(true, commanded, orientation, rng, scatter=SCATTER, camera=CAMERA):
    """Return the motion that the camera measures after a tap. This simulation does not use the code
    under test."""
    noise = rng.standard_normal(3)
    length = math.hypot(commanded[0], commanded[1])
    slope = commanded[2] / length
    heading = math.atan2(commanded[1], commanded[0]) + true[2] + true[3] * slope
    travel = heading - orientation
    drift = -true[4] * math.sin(travel) + true[5] * math.cos(travel)
    went = length * true[0]
    turn = went * (true[1] * slope + drift) * (1 + scatter.rotation * noise[2])
    went *= 1 + scatter.distance * noise[0]
    heading += scatter.direction * noise[1]
    measurement = math.sqrt(2) * np.array([camera.position, camera.position, camera.angle])
    moved = np.array([went * math.cos(heading), went * math.sin(heading), turn])
    return moved + measurement * rng.standard_normal(3)


def learn(true, taps, seed=0, gains=None):
    rng = np.random.default_rng(seed)
    gains = Gains.start() if gains is None else gains
    for _ in range(taps):
        length, heading = rng.uniform(0.005, 0.03), rng.uniform(-3, 3)
        orientation, slope = rng.uniform(-3, 3), rng.uniform(-5, 5)
        asked = [length * math.cos(heading), length * math.sin(heading), slope * length]
        moved = answer(true, asked, orientation, rng)
        gains = gains.observe(asked, moved, orientation, SCATTER, CAMERA)
    return gains


@pytest.mark.parametrize(
    "true",
    [
        FILE,
        (1.06, 0.9, 0.02, 0.0, 0.0, 0.0),
        (0.27, 1.5, -0.03, 0.0, 0.0, 0.0),
        (3.75, 0.5, 0.0, 0.004, 0.0, 0.0),
        (1.0, 1.0, 0.0, 0.0, 1.5, -0.8),
        (0.5, 2.5, 0.1, 0.0, -1.0, 2.0),
    ],
)
def test_steady_gains_are_learnt_within_their_own_deviation(true):
    gains = learn(true, 60)
    assert np.all(np.abs(gains.value - true) < 4.5 * gains.deviation + 1e-3)
    assert gains.deviation[0] / gains.value[0] < 0.012


def test_the_error_matches_the_estimated_uncertainty():
    """The true gains differ from the file by errors with the standard deviations of the narrow
    prior."""
    rng = np.random.default_rng(5)
    squares = []
    for seed in range(100):
        true = np.array(FILE) + rng.standard_normal(6) * [0.04, 0.06, 0.01, 0.001, 0.03, 0.03]
        gains = learn(true, 6, seed)
        squares.append((gains.value - true) ** 2 / gains.deviation**2)
    # For most gains, the stated deviation is larger than the actual one, because the priors also
    # contain wide distributions.
    mean = np.mean(squares, axis=0)
    assert np.all(mean < 1.35) and np.all(mean[:3] > 0.5)


@pytest.mark.parametrize("friction", [0.25, 0.4, 2.5, 4.0])
def test_a_friction_far_from_the_file_is_learnt_after_two_taps(friction):
    for seed in range(20):
        gains = learn((1 / friction, 1.0, 0.0, 0.0, 0.0, 0.0), 2, seed)
        assert gains.value[0] == pytest.approx(1 / friction, rel=0.25)


def test_one_improbable_component_does_not_prevent_learning_of_the_others():
    """An improbable direction of motion does not prevent learning from the distance of the same
    tap."""
    gains = learn(FILE, 10)
    before = gains.value[0]
    for _ in range(3):
        gains = gains.observe([0.02, 0, 0.05], [0.0, 0.024, 0.06], 0.0, SCATTER, CAMERA)
    assert gains.value[0] > before + 0.03


def test_a_disturbed_object_does_not_change_the_gains():
    gains = learn(FILE, 10)
    after = gains.observe([0.01, 0.0, 0.05], [-0.02, 0.03, 1.0], 0.0, SCATTER, CAMERA)
    assert np.allclose(after.value, gains.value, atol=0.02)
    assert bool(after.surprised) and float(after.outliers) == float(gains.outliers) + 1
    # Until further taps are as expected, much longer slides than before are considered possible.
    asked = np.array([0.01, 0.0, 0.0])
    assert after.spread(asked, SCATTER, 3.0).longest > 2 * gains.spread(asked, SCATTER, 3.0).longest
    calm = learn(FILE, 2, 3, after)
    assert not bool(calm.surprised)
    assert calm.spread(asked, SCATTER, 3.0).longest < 1.4


@pytest.mark.parametrize("changed", [0.4, 2.0, 3.0])
def test_two_consistent_taps_change_the_estimate(changed):
    gains = learn(FILE, 12)
    for _ in range(2):
        gains = gains.observe(
            [0.02, 0.0, 0.1], [0.02 * changed, 0, 0.1 * changed], 0, SCATTER, CAMERA
        )
    assert gains.value[0] == pytest.approx(changed, rel=0.1)


def test_two_inconsistent_disturbances_do_not_change_the_estimate():
    gains = learn(FILE, 12)
    for moved in (0.008, 0.07):
        gains = gains.observe([0.02, 0.0, 0.1], [moved, 0.0, moved * 5], 0.0, SCATTER, CAMERA)
    assert gains.value[0] == pytest.approx(1.0, abs=0.1)


def test_a_tap_without_rotation_gives_no_information_about_rotation():
    start = Gains.start()
    gains = start.observe([0.02, 0.0, 0.0], [0.02, 0.0, 0.0], 0.0, SCATTER, CAMERA)
    index = NAMES.index("rotation")
    assert gains.value[index] == pytest.approx(start.value[index], abs=1e-6)


@given(
    st.lists(st.tuples(*[st.floats(-0.2, 0.2)] * 6), min_size=1, max_size=12), st.floats(0.0, 0.3)
)
def test_the_gains_stay_within_bounds_for_any_measurement(taps, scatter):
    gains = Gains.start()
    for numbers in taps:
        noise = Scatter(scatter, scatter, 0.02)
        gains = gains.observe(numbers[:3], numbers[3:], 0.3, noise, CAMERA)
        assert np.all(gains.value >= LOWEST) and np.all(gains.value <= HIGHEST)
        assert np.all(gains.deviation >= 0.0) and np.all(np.isfinite(gains.deviation))
        spread = gains.spread([0.02, 0.0, 0.05], noise, 3.0)
        assert np.isfinite(spread.longest) and np.all(np.isfinite(spread.aside))


def test_an_unknown_pose_gives_no_information():
    start = Gains.start()
    gains = start.observe([0.01, 0, 0], [math.nan] * 3, 0.0, SCATTER, CAMERA)
    assert float(gains.outliers) == 1
    assert np.allclose(gains.value, start.value, atol=1e-3)


@given(*[st.floats(-0.1, 0.1)] * 3, st.floats(-3, 3))
def test_command_and_predict_are_inverse(dx, dy, turn, orientation):
    if math.hypot(dx, dy) < 1e-6:
        return
    gains = learn((1.3, 0.8, 0.05, 0.002, 0.5, -0.3), 8)
    distance, planned, heading = gains.to_plan([dx, dy, turn], BOX)
    rotation = gains.from_plan([dx, dy, turn], planned, BOX)
    commanded = gains.command(distance, rotation, heading, orientation)
    assert np.allclose(gains.predict(commanded, orientation), [dx, dy, turn], atol=1e-9)
    back = gains.command(-distance, rotation, heading, orientation)
    assert np.allclose(gains.predict(back, orientation), [-dx, -dy, turn], atol=1e-9)


@given(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(0.1, 10.0), st.floats(0.001, 0.1))
def test_a_plan_and_the_object_agree_on_which_rotations_are_in_the_box(turn, other, gain, box):
    planned = float(plan_rotation(turn, gain, box))
    assert (abs(planned) <= box) == (abs(turn) <= box)
    assert float(plan_rotation(-turn, gain, box)) == -planned
    assert float(plan_rotation(planned, 1.0 / gain, box)) == pytest.approx(turn, abs=1e-9)
    if turn < other:
        assert planned <= float(plan_rotation(other, gain, box))


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.sampled_from([0.6, 1.0, 1.7]))
def test_after_a_planned_tap_the_plan_sees_the_planned_rotation(turn, planned_turn, gain):
    gains = learn((1.0, gain, 0.0, 0.0, 0.0, 0.0), 20)
    left = np.array([0.01, 0.02, turn])
    _, planned, heading = gains.to_plan(left, BOX)
    rotation = gains.from_plan(left, planned_turn, BOX)
    commanded = gains.command(0.05, rotation, heading, 0.3)
    after = left - gains.predict(commanded, 0.3)
    assert float(gains.to_plan(after, BOX)[1]) == pytest.approx(float(planned) - planned_turn)


def test_no_rotation_beyond_the_cone_is_commanded():
    gains = learn((1.0, 1.0, 0.0, 0.0, 3.0, 0.0), 20)
    commanded = gains.command(0.02, -0.1, 0.3, 1.0, cone_slope=5.0)
    assert abs(commanded[2]) <= 5.0 * math.hypot(commanded[0], commanded[1]) + 1e-12


def test_many_objects_at_once_give_the_same_result_as_each_alone():
    rng = np.random.default_rng(2)
    asked, seen = rng.normal(0, 0.02, (50, 3)), rng.normal(0, 0.02, (50, 3))
    angle = rng.normal(0, 1, 50)
    together = Gains.start((50,)).observe(asked, seen, angle, SCATTER, CAMERA)
    for row in range(50):
        alone = Gains.start().observe(asked[row], seen[row], angle[row], SCATTER, CAMERA)
        assert np.allclose(alone.value, together.value[row])
        assert np.allclose(alone.deviation, together.deviation[row])


@pytest.mark.parametrize("friction", [0.2, 0.5, 1.0, 2.0, 5.0])
def test_the_spread_covers_999_of_1000_first_slides_for_any_prior(friction):
    spread = Gains.start().spread([0.02, 0.0, 0.05], SCATTER, 3.0)
    rng = np.random.default_rng(1)
    slides = (1 / friction) * (1 + SCATTER.distance * rng.standard_normal(100_000))
    assert np.mean(slides > spread.longest) <= 1e-3


@given(st.lists(st.floats(-5.8, 5.8), min_size=1, max_size=8))
def test_the_spread_holds_each_slide_of_an_object_with_a_contact_without_friction(slopes):
    # The object moves along the normal of the contact: in the paper's disk, the normal is turned by
    # 0.034 rad for each rad/m of the requested rotation. The contact does not turn the object.
    normal, gains = 0.034, Gains.start()
    for slope in slopes:
        asked = [0.02, 0.0, 0.02 * slope]
        expected = gains.predict(asked, 0.0)
        right, left = gains.spread(asked, SCATTER, 3.0).aside
        deviation = normal * slope - math.atan2(expected[1], expected[0])
        assert right <= deviation <= left
        moved = [0.012 * math.cos(normal * slope), 0.012 * math.sin(normal * slope), 0.0]
        gains = gains.observe(asked, moved, 0.0, SCATTER, CAMERA)


@pytest.mark.parametrize(
    "names", [("чашка", "блюдце"), ("Tasse ä", "Tasse ö"), ("cup 1", "cup_1"), ("a.", "a")]
)
def test_gains_of_objects_with_similar_names_are_kept_apart(names):
    one, other = names
    keep_gains(one, "domain0", learn((1.8, 0.6, 0.01, 0.0, 1.0, 0.0), 12))
    assert np.array_equal(load_gains(other, "domain0").value, Gains.start().value)
    keep_gains(other, "domain0", Gains.start())
    assert load_gains(one, "domain0").value[0] == pytest.approx(1.8, rel=0.06)


def test_saved_gains_are_restored_and_a_damaged_file_is_named():
    name = "my disk / no. 3"
    assert np.array_equal(load_gains(name, "domain0").value, Gains.start().value)
    gains = learn((1.8, 0.6, 0.01, 0.0, 1.0, 0.0), 12)
    path = keep_gains(name, "domain0", gains)
    assert path == gains_file(name, "domain0") and path.parent.name == "domain0"
    assert np.array_equal(load_gains(name, "domain0.left").value, Gains.start().value)
    loaded = load_gains(name, "domain0")
    again = learn((1.8, 0.6, 0.01, 0.0, 1.0, 0.0), 1, 9, loaded)
    assert np.allclose(again.value[:3], gains.value[:3], rtol=0.06, atol=0.01)
    unknown = Gains.start().spread([0.01, 0, 0], SCATTER, 3.0).longest
    assert loaded.spread([0.01, 0, 0], SCATTER, 3.0).longest < 0.4 * unknown
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "distance": 17.0}))
    with pytest.raises(PlanningError, match=r"no\._3-\w+\.json.*distance is 17\.0.*0\.1 to 10"):
        load_gains(name, "domain0")
    path.write_text("{")
    with pytest.raises(PlanningError, match="delete it"):
        load_gains(name, "domain0")


def test_saved_gains_keep_what_belongs_to_the_impact_and_to_the_slide():
    """After a tap with a track, the parts are known better than before; both parts and their
    anticorrelation after taps without one are restored. A file without parts is read as before."""
    asked = np.array([0.02, 0.0, math.radians(5.0)])
    gains = Gains.start()
    for track in (None, Slid(*np.array([0.016, 4.0, 0.02, 0.02]))):
        gains = gains.observe(asked, 1.5 * asked, 0.3, SCATTER, CameraNoise(), track)
        numbers = gains.as_numbers()
        loaded = Gains.from_numbers(numbers)
        for kept, belief in ((loaded.distance, gains.distance), (loaded.rotation, gains.rotation)):
            assert np.allclose(kept.mean[0], belief.expected())
            assert np.allclose(np.sqrt(np.diagonal(kept.covariance[0])), belief.deviation())
        sums = [np.sqrt(loaded.distance.covariance[0].sum()) * numbers["distance"]]
        sums.append(np.sqrt(loaded.rotation.covariance[0][:2, :2].sum()))
        assert np.allclose(sums, gains.deviation[:2])
    old = {key: value for key, value in numbers.items() if not key.startswith(("impact", "slide"))}
    assert np.allclose(Gains.from_numbers(old).value, loaded.value)
    with pytest.raises(PlanningError, match=r"slide_distance is 70\.0.*0\.1 to 10"):
        Gains.from_numbers({**numbers, "slide_distance": 70.0})


def test_a_track_tells_the_torque_factor_from_the_scatter_of_the_impact():
    """One tap whose impact turned the object 30 % too much: without a track, the planner attributes
    a part of it to the object; with a track, nothing."""
    asked = np.array([0.02, 0.0, math.radians(5.0)])
    moved = np.array([0.02, 0.0, 1.3 * asked[2]])
    gains = Gains.start()
    gains.rotation.weight[:] = [0.0, 1.0, 0.0, 0.0, 0.0]  # certainly a wrong torque factor
    as_launched = Slid(
        np.array(0.02), np.array(1.3 * asked[2] / 0.02), np.array(0.01), np.array(0.01)
    )
    without = gains.observe(asked, moved, 0.0, SCATTER, CAMERA)
    tracked = gains.observe(asked, moved, 0.0, SCATTER, CAMERA, as_launched)
    assert without.value[1] > 1.2
    assert tracked.value[1] == pytest.approx(1.0, abs=0.09)
    assert tracked.deviation[1] < 0.6 * without.deviation[1]


def test_a_track_without_a_measured_launch_is_the_same_as_no_track():
    asked, moved = np.array([0.01, 0.005, 0.05]), np.array([0.015, 0.008, 0.1])
    nothing = Slid(*(np.array(math.nan),) * 4)
    with_it = Gains.start().observe(asked, moved, 0.3, SCATTER, CAMERA, nothing)
    without = Gains.start().observe(asked, moved, 0.3, SCATTER, CAMERA)
    assert with_it.value == pytest.approx(without.value, rel=0.02)
    assert with_it.deviation == pytest.approx(without.deviation, rel=0.05)
