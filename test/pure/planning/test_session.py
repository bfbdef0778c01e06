import math
from dataclasses import replace

import numpy as np
import pytest

from tapping_cell.logic.goal_validation import REFUSALS
from tapping_cell.mechanics import Impact, Polygon, Sliding, Striker, Tap
from tapping_cell.messages import ErrorCode
from tapping_cell.planning import (
    CameraNoise,
    CircleArea,
    Done,
    FreeSpace,
    Gains,
    PlannerSettings,
    PositioningSession,
    Refusal,
    RefusalReason,
    Strike,
    StrikeSpace,
    Workspace,
    check_goal,
    make_planner,
)
from tapping_cell.planning.stopping import LONG_OBSERVATION
from tapping_cell.se2 import Pose, wrap_angle

FINE = np.diag([1e-10, 1e-10, 1e-10])


@pytest.fixture(scope="module")
def planner(settings):
    return make_planner("exact", settings)


def slide(strike, pose, rng, gain=(1.0, 1.0), scatter=(0.05, 0.15, 0.017)):
    """Return the pose after a tap of an object with the given gains and scatter."""
    command = strike.commanded
    noise = rng.standard_normal(3) * scatter
    length = math.hypot(command.x, command.y) * gain[0] * (1 + noise[0])
    heading = math.atan2(command.y, command.x) + noise[2]
    turn = command.theta * gain[1] * (1 + noise[1])
    step = np.array([length * math.cos(heading), length * math.sin(heading), turn])
    after = np.asarray(pose) + step
    after[2] = wrap_angle(after[2])
    return after


def run(session, pose, rng, gain=(1.0, 1.0), most=60):
    for _ in range(most):
        decision = session.decide(pose, FINE)
        if not isinstance(decision, Strike):
            return decision, pose
        after = slide(decision, pose, rng, gain)
        session.observe(decision, pose, after, FINE)
        pose = after
    return decision, pose


@pytest.mark.parametrize("name", ["exact", "conservative", "multi", "optimal"])
def test_random_goals_with_biased_gains_end_at_the_goal(name, settings, space, free):
    planner = make_planner(name, settings)
    rng = np.random.default_rng(11)
    for _ in range(5):
        goal = rng.uniform([-0.24, -0.16, -3.1], [0.24, 0.16, 3.1])
        pose = rng.uniform([-0.24, -0.16, -3.1], [0.24, 0.16, 3.1])
        session = PositioningSession(goal, planner, space, free)
        decision, end = run(session, pose, rng, rng.choice([0.85, 1.15], 2))
        assert isinstance(decision, Done), decision
        assert math.hypot(*(goal - end)[:2]) <= 0.001
        assert abs(float(wrap_angle(goal[2] - end[2]))) <= math.radians(1.0)


def test_deciding_twice_gives_the_same_decision(planner, space, free):
    session = PositioningSession((0.05, 0.02, 1.0), planner, space, free)
    assert session.decide((0.0, 0.0, 0.0)) == session.decide((0.0, 0.0, 0.0))


def test_a_goal_is_done_only_if_the_covariance_allows_it(planner, space, free):
    session = PositioningSession((0.0, 0.0, 0.0), planner, space, free)
    pose = (0.0009, 0.0, 0.0)
    assert isinstance(session.decide(pose, FINE), Done)
    coarse = np.diag([1e-8, 1e-8, 1e-6])
    assert isinstance(session.decide(pose, coarse, observe_again=False), Strike)
    assert isinstance(session.decide((0.0005, 0.0, 0.0), coarse), Done)
    blind = np.diag([1e-6, 1e-6, 1e-4])
    refusal = session.decide(pose, blind, observe_again=False)
    assert isinstance(refusal, Refusal) and refusal.reason is RefusalReason.CAMERA_TOO_COARSE
    assert isinstance(session.decide((0.02, 0.0, 0.0), blind), Strike)


def test_the_covariance_of_the_worse_axis_counts_whatever_its_direction(planner, space, free):
    session = PositioningSession((0.0, 0.0, 0.0), planner, space, free)
    cos, sin = math.cos(0.7), math.sin(0.7)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    along = np.diag([1e-8, 1e-12, 1e-8])
    assert session.stopping(turn @ along @ turn.T) == pytest.approx(session.stopping(along))


@pytest.mark.parametrize(
    ("goal", "reason", "words"),
    [
        ((math.nan, 0, 0), RefusalReason.GOAL_NOT_FINITE, "not three finite numbers"),
        ((0.0, math.inf, 0), RefusalReason.GOAL_NOT_FINITE, "not three finite numbers"),
        ((0.28, 0, 0), RefusalReason.GOAL_OFF_TABLE, r"20\.0 mm.*53\.0 mm.*247\.0 mm in x"),
        ((0.1, 0.04, 0), RefusalReason.GOAL_IN_KEEP_OUT, "keep-out"),
    ],
)
def test_invalid_goals_are_refused_before_the_first_tap(tap, planner, goal, reason, words):
    space = StrikeSpace(tap, Workspace(keep_outs=(CircleArea(0.1, 0.05, 0.02),)))
    session = PositioningSession(goal, planner, space)
    refusal = session.decide((-0.1, 0.0, 0.0))
    assert isinstance(refusal, Refusal) and refusal.reason is reason
    assert refusal == check_goal(goal, space)
    import re

    assert re.search(words, refusal.sentence)


def test_a_goal_behind_a_wall_is_refused_before_the_first_tap(tap, planner):
    wall = tuple(CircleArea(0.0, y, 0.02) for y in np.arange(-0.22, 0.23, 0.03))
    session = PositioningSession((0.2, 0, 0), planner, StrikeSpace(tap, Workspace(keep_outs=wall)))
    refusal = session.decide((-0.2, 0, 0))
    assert isinstance(refusal, Refusal) and refusal.reason is RefusalReason.NO_PATH_TO_GOAL


def test_a_path_around_a_keep_out_is_found(tap, settings):
    wall = tuple(CircleArea(0.0, y, 0.02) for y in np.arange(-0.22, 0.0, 0.03))
    space = StrikeSpace(tap, Workspace(keep_outs=wall))
    free = FreeSpace(space)
    rng = np.random.default_rng(2)
    for name in ("exact", "optimal"):
        session = PositioningSession((0.2, -0.1, 0.5), make_planner(name, settings), space, free)
        decision, _ = run(session, np.array([-0.2, -0.1, 0.0]), rng)
        assert isinstance(decision, Done)


def test_an_object_at_the_edge_is_tapped_away_from_it(planner, space, free):
    rng = np.random.default_rng(3)
    session = PositioningSession((0.0, 0.0, 0.0), planner, space, free)
    pose = np.array([0.249, 0.0, 0.0])
    strike = session.decide(pose)
    assert isinstance(strike, Strike) and strike.wanted.x < 0
    decision, _ = run(session, pose, rng)
    assert isinstance(decision, Done)


def test_an_object_that_has_fallen_off_or_is_not_known_is_refused(planner, space, free):
    session = PositioningSession((0.0, 0.0, 0.0), planner, space, free)
    off = session.decide((0.31, 0.0, 0.0))
    assert isinstance(off, Refusal) and off.reason is RefusalReason.OBJECT_OFF_TABLE
    unknown = session.decide((math.nan, 0.0, 0.0))
    assert isinstance(unknown, Refusal)
    assert unknown.reason is RefusalReason.OBJECT_POSE_NOT_FINITE


def test_an_object_that_cannot_be_struck_anywhere_is_refused(tap, planner):
    """The arm reaches the goal, but no strike pose near the object."""
    space = StrikeSpace(
        tap, Workspace(), lambda poses: np.hypot(poses[..., 0] - 0.15, poses[..., 1]) < 0.12
    )
    refusal = PositioningSession((0.15, 0, 0), planner, space).decide((-0.2, 0.0, 0.0))
    assert isinstance(refusal, Refusal) and refusal.reason is RefusalReason.NO_STRIKE
    assert "by hand" in refusal.sentence


def test_after_a_miss_the_next_tap_is_another(planner, space, free):
    session = PositioningSession((0.05, 0.0, 0.0), planner, space, free)
    first = session.decide((0.0, 0.0, 0.0))
    session.observe(first, (0, 0, 0), (0.00001, 0, 0))
    second = session.decide((0.00001, 0.0, 0.0))
    between = math.atan2(second.commanded.y, second.commanded.x)
    assert abs(between) > math.radians(15.0) and second.detour
    session.observe(second, (0, 0, 0), second.predicted)
    assert session.gains.outliers == 1


def test_misses_are_not_repeated_until_every_direction_was_tried(planner, space, free):
    session = PositioningSession((0.05, 0.0, 0.0), planner, space, free)
    headings = []
    for _ in range(6):
        strike = session.decide((0.0, 0.0, 0.0))
        headings.append(math.atan2(strike.commanded.y, strike.commanded.x))
        session.observe(strike, (0, 0, 0), (0, 0, 0))
    between = wrap_angle(np.subtract.outer(headings, headings))[np.triu_indices(6, 1)]
    assert np.min(np.abs(between)) > math.radians(15.0)
    for _ in range(12):
        strike = session.decide((0.0, 0.0, 0.0))
        assert isinstance(strike, Strike)
        session.observe(strike, (0, 0, 0), (0, 0, 0))


def test_the_number_of_taps_is_limited(planner, space, free):
    session = PositioningSession((0.05, 0.0, 0.0), planner, space, free, most_taps=3)
    rng = np.random.default_rng(0)
    decision, _ = run(session, np.zeros(3), rng, gain=(0.02, 0.0))
    assert isinstance(decision, Refusal) and decision.reason is RefusalReason.TOO_MANY_TAPS
    assert session.taps == 3


def test_without_adaptation_nothing_is_learnt(planner, space, free):
    rng = np.random.default_rng(0)
    session = PositioningSession((0.05, 0, 0.3), planner, space, free, adapt=False)
    run(session, np.zeros(3), rng, gain=(1.15, 0.9))
    assert np.array_equal(session.gains.value, Gains.start().value)


def test_gains_of_an_earlier_run_are_used_at_once(planner, space, free, known):
    gains = known(distance=1.25, rotation=0.8, direction=0.1)
    session = PositioningSession((0.05, 0.0, 0.1), planner, space, free, gains)
    strike = session.decide((0.0, 0.0, 0.0))
    assert math.hypot(strike.commanded.x, strike.commanded.y) == pytest.approx(0.04)
    assert math.atan2(strike.commanded.y, strike.commanded.x) == pytest.approx(-0.1)
    # the desired rotation of 0.1 rad divided by the gains 1.25 * 0.8
    assert strike.commanded.theta == pytest.approx(0.1)
    assert np.allclose(strike.predicted, (0.05, 0.0, 0.1))


def test_plans_use_the_stopping_box_of_a_long_observation(tap, space, free):
    settings = PlannerSettings.for_tap(tap, camera=CameraNoise(1e-4, math.radians(0.1)))
    session = PositioningSession((0.0, 0.0, 0.0), make_planner("exact", settings), space, free)
    assert session.stopping(settings.camera.covariance / LONG_OBSERVATION) == settings.stopping
    assert settings.stopping.distance == pytest.approx(0.000897, abs=1e-6)


def with_friction(strike, pose, friction, rng):
    """Return the true result of a tap if the friction differs from that in the file."""
    return slide(strike, pose, rng, (1 / friction, 1 / friction))


@pytest.mark.parametrize("friction", [0.25, 0.35, 0.6, 1.7, 4.0])
@pytest.mark.parametrize("probe", [False, True])
def test_with_any_friction_the_object_stays_on_the_table_and_reaches_its_goal(
    planner, space, free, friction, probe
):
    rng = np.random.default_rng(int(100 * friction))
    table = space.workspace
    for _ in range(4):
        pose = np.append(rng.uniform((-0.2, -0.14), (0.2, 0.14)), rng.uniform(-3, 3))
        goal = np.append(rng.uniform((-0.2, -0.14), (0.2, 0.14)), rng.uniform(-3, 3))
        session = PositioningSession(goal, planner, space, free, probe=probe)
        decision = session.decide(pose)
        while isinstance(decision, Strike):
            after = with_friction(decision, pose, friction, rng)
            assert table.edge_distance(after[:2]) >= space.object_radius
            session.observe(decision, pose, after)
            pose = after
            decision = session.decide(pose)
        assert isinstance(decision, Done), decision


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("gain", [0.0, 0.02, 0.05, 0.2, 1.0])
def test_an_object_that_taps_cannot_turn_is_refused_and_any_other_reaches_its_goal(
    planner, space, free, gain, seed
):
    rng = np.random.default_rng([seed, int(100 * gain)])
    session = PositioningSession((0.05, 0.02, 0.3), planner, space, free)
    end, pose = run(session, np.array([-0.05, -0.02, 0.0]), rng, (1.0, gain))
    if gain > 0.1:
        assert isinstance(end, Done), end
        return
    assert isinstance(end, Refusal) and end.reason is RefusalReason.TAP_WITHOUT_ROTATION
    assert REFUSALS[end.reason] == ErrorCode.TAP_WITHOUT_ROTATION
    assert 3 <= session.taps <= 10
    assert "contact_friction" in end.sentence and "degrees from the goal" in end.sentence
    # The position can still be corrected if the goal has the object's current angle.
    kept = (*session.goal[:2], pose[2])
    again = PositioningSession(kept, planner, space, free, session.gains)
    end, _ = run(again, pose, rng, (1.0, gain))
    assert isinstance(end, Done), end


def test_an_object_that_taps_cannot_turn_is_detected_despite_an_off_centre_mass(
    planner, space, free
):
    taps = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        pose = np.array([-0.05, -0.02, 0.0])
        session = PositioningSession((0.05, 0.02, 0.3), planner, space, free)
        decision = session.decide(pose, FINE)
        while isinstance(decision, Strike):
            after = slide(decision, pose, rng, (1.0, 0.07))
            move = after - pose
            travel = math.atan2(move[1], move[0]) - pose[2]
            twist = 1.1 * math.sin(travel) + 0.9 * math.cos(travel)
            twist *= math.hypot(move[0], move[1]) * (1 + 0.15 * rng.standard_normal())
            after[2] = wrap_angle(after[2] + twist)
            session.observe(decision, pose, after, FINE)
            pose = after
            decision = session.decide(pose, FINE)
        if isinstance(decision, Refusal):
            assert decision.reason is RefusalReason.TAP_WITHOUT_ROTATION
        taps.append(session.taps)
    assert np.mean(taps) <= 12, taps


def test_a_probe_begins_with_the_smallest_taps_and_ends_when_the_object_is_known(
    planner, space, free
):
    rng = np.random.default_rng(4)
    session = PositioningSession((0.15, 0.0, 0.5), planner, space, free, probe=True)
    pose, sizes = np.array([-0.15, 0.0, 0.0]), []
    decision = session.decide(pose)
    while isinstance(decision, Strike) and "probe" in decision.detour:
        sizes.append(math.hypot(decision.wanted.x, decision.wanted.y))
        after = with_friction(decision, pose, 0.4, rng)
        session.observe(decision, pose, after)
        pose = after
        decision = session.decide(pose)
    assert 1 <= len(sizes) <= 3
    assert sizes[0] < 2 * planner.settings.smallest_distance
    assert session.gains.value[0] == pytest.approx(2.5, rel=0.15)


def test_a_rejected_or_missed_probe_is_not_proposed_again(planner, space, free):
    session = PositioningSession((0.15, 0.0, 0.5), planner, space, free, probe=True)
    pose, headings = (-0.05, 0.02, 0.1), []
    for skipped in (True, True, False):
        decision = session.decide(pose)
        assert isinstance(decision, Strike) and "probe" in decision.detour
        heading = math.atan2(decision.commanded.y, decision.commanded.x)
        assert all(abs(wrap_angle(heading - other)) > math.radians(10) for other in headings)
        headings.append(heading)
        if skipped:
            session.skip(decision)
        else:
            session.observe(decision, pose, pose)
    missed, again = headings[-1], session.decide(pose)
    assert isinstance(again, Strike)
    heading = math.atan2(again.commanded.y, again.commanded.x)
    assert abs(wrap_angle(heading - missed)) > math.radians(10)


def test_near_an_edge_an_unknown_object_is_refused_until_it_is_probed(planner, tap, known):
    """On this table even the smallest tap might be too long."""
    table = Workspace(length=0.118, width=0.118)
    space = StrikeSpace(tap, table)
    free = FreeSpace(space)
    goal, start = (0.003, 0.0, 0.0), (0.0, 0.0, 0.0)
    refusal = PositioningSession(goal, planner, space, free).decide(start)
    assert isinstance(refusal, Refusal) and refusal.reason is RefusalReason.PROBE_NEEDED
    assert "goal --probe" in refusal.sentence and "times as far" in refusal.sentence
    sure = PositioningSession(goal, planner, space, free, known()).decide(start)
    assert isinstance(sure, Strike)


def test_an_object_over_the_edge_is_reported_and_never_struck_further_out(planner, space, free):
    session = PositioningSession((0.0, 0.0, 0.0), planner, space, free)
    assert session.edge_warning((0.1, 0.0, 0.0)) == ""
    assert "from the table's edge" in session.edge_warning((0.249, 0.0, 0.0))
    for y in (0.19, 0.2, 0.21):
        pose = np.array([0.05, y, 0.0])
        assert "bring it back" in session.edge_warning(pose)
        decision = session.decide(pose)
        if isinstance(decision, Strike):
            rng = np.random.default_rng(1)
            for friction in (0.25, 1.0, 4.0):
                after = with_friction(decision, pose, friction, rng)
                assert abs(after[1]) <= y + 1e-9


def test_the_tap_after_an_unexplained_slide_is_short(planner, space, free, known):
    session = PositioningSession((0.2, 0.0, 0.0), planner, space, free, known())
    pose = np.array([-0.15, 0.0, 0.0])
    usual = session.decide(pose)
    assert isinstance(usual, Strike)
    short = replace(usual, commanded=Pose(0.03, 0, 0), wanted=Pose(0.03, 0, 0))
    session.observe(short, pose, (-0.06, 0.0, 0.0))  # three times as far as commanded
    after = session.decide((-0.15, 0.0, 0.0))
    assert isinstance(after, Strike)
    assert math.hypot(after.wanted.x, after.wanted.y) < 0.5 * math.hypot(
        usual.wanted.x, usual.wanted.y
    )


def square_tap(contact_friction=0.2):
    side = 0.04
    corners = ((-side, -side), (side, -side), (side, side), (-side, side))
    body = Polygon(corners, mass=0.207, height=0.012)
    striker = Striker(mass=0.1, tip_radius=0.0054)
    return Tap(
        sliding=Sliding(body, friction=0.25, torque_factor=2.17),
        impact=Impact(body, striker, restitution=0.8, friction=contact_friction),
    )


def test_a_polygon_without_a_contact_for_the_safe_taps_is_refused_with_that_reason(known):
    """The table is a corridor along x, and the edges of the square transmit only impulses at 45
    degrees to it."""
    tap = square_tap()
    space = StrikeSpace(tap, Workspace(length=0.6, width=0.1299))
    planner = make_planner("exact", PlannerSettings.for_tap(tap, CameraNoise()))
    session = PositioningSession((0.1, 0.0, math.pi / 4), planner, space, None, known())
    refusal = session.decide((0.0, 0.0, math.pi / 4))
    assert isinstance(refusal, Refusal) and refusal.reason is RefusalReason.NO_CONTACT
    assert REFUSALS[refusal.reason] == ErrorCode.NO_CONTACT_FOUND
    assert "no contact point allows any of the safe slides" in refusal.sentence
    assert "the arm" not in refusal.sentence


def test_a_slippery_polygon_is_struck_along_its_normals_whatever_its_orientation():
    tap = square_tap(contact_friction=0.01)
    space = StrikeSpace(tap, Workspace(length=1.0, width=1.0))
    planner = make_planner("exact", PlannerSettings.for_tap(tap, CameraNoise()))
    for degrees in (7.0, 22.0, 38.0):
        session = PositioningSession((0.05, 0.0, 0.0), planner, space)
        assert isinstance(session.decide((0.0, 0.0, math.radians(degrees))), Strike)
