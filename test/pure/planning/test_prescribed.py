"""Prescribed taps: the requested speed and incidence are used, and the object never leaves the
table or the view."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.mechanics import Disk, Impact, Polygon, Sliding, Striker, Tap
from tapping_cell.planning import (
    Done,
    FreeSpace,
    Gains,
    PlanningError,
    PrescribedSession,
    Prescription,
    Refusal,
    RefusalReason,
    Strike,
    StrikeSpace,
    Workspace,
    cautious,
)
from tapping_cell.se2 import wrap_angle

STRIKER = Striker(mass=0.1, tip_radius=0.0054)
WHOLE_TABLE = np.array([(-0.33, -0.25), (0.33, -0.25), (0.33, 0.25), (-0.33, 0.25)])


def make_tap(body, friction=0.17, restitution=0.86, torque_factor=3.64):
    return Tap(
        sliding=Sliding(body, friction=friction, torque_factor=torque_factor, gravity=9.81),
        impact=Impact(body, STRIKER, restitution=restitution, friction=0.20),
    )


DISK = Disk(radius=0.048, mass=0.2455, height=0.012)
SQUARE = Polygon(((0.04, -0.04), (0.04, 0.04), (-0.04, 0.04), (-0.04, -0.04)), 0.2, 0.012)


@pytest.fixture(scope="module", params=[DISK, SQUARE], ids=["disk", "square"])
def cell(request):
    """Return a strike space with the safety margins of experiments, its map, and the body."""
    plain = StrikeSpace(make_tap(request.param), Workspace())
    space = StrikeSpace(make_tap(request.param), Workspace(), scatter=cautious(plain))
    return space, FreeSpace(space), request.param


def session(cell, *prescription):
    space, free, _ = cell
    return PrescribedSession(Prescription(*prescription), space, free, Gains.start())


poses = st.tuples(st.floats(-0.15, 0.15), st.floats(-0.1, 0.1), st.floats(-math.pi, math.pi))


@given(
    pose=poses,
    speed=st.floats(0.1, 1.0),
    incidence=st.floats(-0.9, 0.9),
    wanted=st.none() | st.floats(-math.pi, math.pi),
)
def test_the_strike_has_the_requested_speed_and_incidence(cell, pose, speed, incidence, wanted):
    space, _, _ = cell
    decision = session(cell, speed, incidence, wanted).decide(pose, in_view=WHOLE_TABLE)
    if isinstance(decision, Refusal):
        assert decision.reason in (RefusalReason.TAP_LEAVES_TABLE, RefusalReason.NO_STRIKE)
        return
    hit = space.tap.strike(pose, decision.plan.strike_pose, decision.plan.striker_speed)
    assert decision.plan.striker_speed == speed
    assert float(hit.incidence) == pytest.approx(incidence, abs=1e-3)
    assert float(hit.travel) == pytest.approx(space.settings.standoff, abs=0.003)
    assert np.allclose(hit.displacement, decision.commanded)
    point = np.asarray(hit.point) - pose[:2]
    angle = math.atan2(point[1], point[0]) - pose[2]
    assert float(wrap_angle(angle - decision.plan.contact_angle)) == pytest.approx(0, abs=1e-3)


@given(
    pose=poses,
    speed=st.floats(0.3, 2.0),
    incidence=st.floats(-0.9, 0.9),
    friction=st.floats(0.85, 1.2),
    restitution=st.floats(0.8, 1.1),
    luck=st.floats(-2.0, 2.0),
)
def test_the_object_stays_on_the_table_despite_model_errors(
    cell, pose, speed, incidence, friction, restitution, luck
):
    """The true motion is computed with other values of friction and restitution than the planned
    motion. The slide is longest with the lowest friction and the highest restitution."""
    space, _, body = cell
    decision = session(cell, speed, incidence).decide(pose, in_view=WHOLE_TABLE)
    if not isinstance(decision, Strike):
        return
    truth = make_tap(body, 0.17 * friction, 0.86 * restitution)
    truth = replace(truth, sliding=truth.sliding.approximated())
    moved = truth.outcome(pose, decision.plan.strike_pose, speed)
    end = np.asarray(pose[:2]) + moved[:2] * (1 + 0.05 * luck)
    room = float(space.workspace.edge_distance(end))
    # If all errors of the model add up, the object may end closer to the edge than planned, by up
    # to a tenth of the slide's length.
    assert room >= body.bounding_radius - 0.1 * float(np.hypot(*moved[:2]))
    assert np.all(np.abs(end) < (0.33, 0.25))


def test_the_travel_is_as_close_as_possible_to_the_direction(cell):
    _, _, body = cell
    for wanted in np.linspace(-3, 3, 7):
        decision = session(cell, 0.5, 0.3, float(wanted)).decide((0.0, 0.0, 0.2))
        assert isinstance(decision, Strike)
        heading = math.atan2(decision.commanded.y, decision.commanded.x)
        off = abs(float(wrap_angle(heading - wanted)))
        # A disk can move in all directions; a square only in four.
        assert off < (1e-6 if isinstance(body, Disk) else math.radians(45.1))


def test_without_a_direction_the_object_moves_towards_the_middle(cell):
    decision = session(cell, 0.6, 0.2).decide((0.1, -0.08, 1.0))
    assert isinstance(decision, Strike)
    assert math.hypot(decision.predicted.x, decision.predicted.y) < math.hypot(0.1, 0.08)


def test_a_tap_beyond_the_table_is_refused_with_its_distance(cell):
    refusal = session(cell, 2.4, 0.2).decide((0.0, 0.0, 0.0))
    assert isinstance(refusal, Refusal)
    assert refusal.reason is RefusalReason.TAP_LEAVES_TABLE
    assert "lower striker speed" in refusal.sentence and "mm" in refusal.sentence


@pytest.mark.parametrize(
    "seen",
    [0.04 * WHOLE_TABLE, WHOLE_TABLE[:2], np.zeros((0, 2))],
    ids=["a small part", "a line", "nothing"],
)
def test_a_tap_out_of_the_cameras_view_is_refused(cell, seen):
    refusal = session(cell, 0.8, 0.2).decide((0.0, 0.0, 0.0), in_view=seen)
    assert isinstance(refusal, Refusal)
    assert refusal.reason is RefusalReason.TAP_LEAVES_VIEW
    assert "reference markers" in refusal.sentence


def test_an_impossible_direction_is_refused_without_slack():
    space = StrikeSpace(make_tap(DISK), Workspace(), lambda poses: np.cos(poses[..., 2]) > 0)
    free = FreeSpace(StrikeSpace(make_tap(DISK), Workspace()))
    session = PrescribedSession(
        Prescription(0.5, 0.0, math.pi, math.radians(30)), space, free, Gains.start()
    )
    refusal = session.decide((0.0, 0.0, 0.0))
    assert isinstance(refusal, Refusal) and refusal.reason is RefusalReason.NO_STRIKE
    assert "more slack" in refusal.sentence
    wide = replace(session.prescription, slack=math.pi)
    assert isinstance(
        PrescribedSession(wide, space, free, Gains.start()).decide((0.0, 0.0, 0.0)), Strike
    )


def test_the_task_is_done_after_the_tap_for_any_result(cell):
    made = session(cell, 0.6, 0.2)
    strike = made.decide((0.0, 0.0, 0.0))
    assert isinstance(strike, Strike)
    made.observe(strike, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert isinstance(made.decide((0.0, 0.0, 0.0)), Done)


@pytest.mark.parametrize(
    "numbers",
    [
        (0.0, 0.1),
        (math.nan, 0.1),
        (0.5, math.nan),
        (0.5, 1.2),
        (0.5, 0.1, math.inf),
        (0.5, 0.1, None, -0.1),
        (0.5, 0.1, None, math.nan),
    ],
    ids=str,
)
def test_impossible_values_are_refused(numbers):
    with pytest.raises(PlanningError):
        Prescription(*numbers)
