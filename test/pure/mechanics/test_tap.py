"""The complete tap: planning and outcome are inverse functions, in any frame, for any body."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell import se2
from tapping_cell.mechanics import (
    Disk,
    Impact,
    InvalidParameterError,
    Polygon,
    Ring,
    Sliding,
    Striker,
    Tap,
    UnreachableDisplacementError,
)
from tapping_cell.mechanics.sensitivity import (
    PAPER_JACOBIAN,
    PAPER_STRIKER_ERROR,
    norm,
    paper_tap,
    sensitivity,
)

DISK = Disk(0.048, 0.2455, 0.012)
RING = Ring(0.03, 0.1, 0.01)
SQUARE = Polygon([(0, 0), (0.08, 0), (0.08, 0.08), (0, 0.08)], 0.2, 0.01)
TRIANGLE = Polygon([(0, 0), (0.1, 0), (0, 0.07)], 0.2, 0.01)


def make(body=DISK, friction=0.2, constraint="linear_bearings", kappa=3.64, mass=0.05):
    striker = Striker(mass, 0.0054, constraint)
    return Tap(Sliding(body, 0.17, kappa), Impact(body, striker, 0.86, friction))


PAPER = make()
coordinates = st.floats(-1, 1)
angles = st.floats(-3.1, 3.1)
poses = st.tuples(coordinates, coordinates, angles)
round_bodies = st.sampled_from([DISK, RING])


def backed(poses, travel):
    """Return the poses moved back by ``travel`` m along their own x axes."""
    back = np.zeros_like(poses)
    back[..., 0] = -travel
    return se2.compose(poses, back)


@given(
    round_bodies,
    st.sampled_from(["linear_bearings", "free"]),
    st.floats(0.05, 0.8),
    st.floats(0.2, 5.0),
    st.floats(0.01, 1.0),
    st.floats(0.0017, 0.2),
    angles,
    st.floats(-1, 1),
    poses,
    st.floats(0, 0.1),
)
def test_plan_then_outcome_is_the_identity(
    body, constraint, friction, kappa, mass, distance, direction, share, pose, standoff
):
    tap = make(body, friction, constraint, kappa, mass)
    wanted = np.array(
        [
            distance * math.cos(direction),
            distance * math.sin(direction),
            share * tap.cone_slope * distance,
        ]
    )
    plan = tap.plan(wanted, pose)
    for strike_pose in (plan.strike_pose, backed(plan.strike_pose, standoff)):
        moved = tap.outcome(pose, strike_pose, plan.striker_speed)
        assert np.abs(moved - wanted)[:2].max() < 1e-9 * distance
        assert abs(moved - wanted)[2] < 1e-9 * tap.cone_slope * distance


def test_plan_then_outcome_is_the_identity_for_arrays():
    generator = np.random.default_rng(0)
    n = 5000
    distance, direction = generator.uniform(0.0017, 0.1, n), generator.uniform(-4, 4, n)
    share = generator.uniform(-1, 1, n)
    share[:20], share[20:40], share[40:60] = 0.0, 1.0, -1.0
    wanted = np.stack(
        [
            distance * np.cos(direction),
            distance * np.sin(direction),
            share * PAPER.cone_slope * distance,
        ],
        axis=1,
    )
    held = generator.uniform(-1, 1, (n, 3)) * [0.3, 0.2, 3]
    plan = PAPER.plan(wanted, held)
    result = PAPER.strike(held, backed(plan.strike_pose, 0.015), plan.striker_speed)
    assert np.abs(result.displacement - wanted).max(axis=0) == pytest.approx(0, abs=1e-9 * 0.1)
    assert np.allclose(result.incidence, plan.incidence, atol=1e-9)
    assert np.allclose(result.twist, plan.twist, rtol=0, atol=1e-9)
    assert np.allclose(result.travel, 0.015, atol=1e-12)
    # The contact point is on the disk, at the planned angle in the object's frame.
    point = se2.transform_points(se2.inverse(held), result.point)
    assert np.allclose(np.hypot(*point.T), DISK.radius)
    assert np.allclose(np.arctan2(point[:, 1], point[:, 0]), plan.contact_angle)


@pytest.mark.parametrize(
    ("body", "constraint"),
    [(SQUARE, "linear_bearings"), (TRIANGLE, "free")],
    ids=["square", "triangle"],
)
def test_plan_then_outcome_is_the_identity_for_polygons(body, constraint):
    tap = make(body, 0.3, constraint, kappa=2.17)
    generator = np.random.default_rng(1)
    n = 20
    distance, direction = generator.uniform(0.002, 0.1, n), generator.uniform(-4, 4, n)
    rotation = generator.uniform(-1, 1, n) * tap.cone_slope * distance
    wanted = np.stack([distance * np.cos(direction), distance * np.sin(direction), rotation], 1)
    held = generator.uniform(-1, 1, (n, 3)) * [0.3, 0.2, 3]
    reachable = tap.reachable(wanted, held)
    assert 0 < reachable.sum() < n
    wanted, held = wanted[reachable], held[reachable]
    plan = tap.plan(wanted, held)
    moved = tap.outcome(held, backed(plan.strike_pose, 0.015), plan.striker_speed)
    assert (np.abs(moved - wanted)[:, :2].max(axis=1) < 1e-8 * distance[reachable]).all()
    assert np.abs(moved - wanted)[:, 2].max() < 1e-8 * tap.cone_slope * 0.1
    # The impulses are within the friction cone of the contact.
    result = tap.strike(held, backed(plan.strike_pose, 0.015), plan.striker_speed)
    assert (abs(result.tangential_impulse) <= 0.3 * result.normal_impulse * (1 + 1e-9)).all()


@given(poses, angles, st.floats(0.06, 0.3), st.floats(-0.05, 0.05), st.floats(0.05, 2), poses)
def test_moving_the_whole_scene_moves_the_outcome(held, direction, back, aside, speed, scene):
    strike = se2.compose(se2.compose(held, (0.0, 0.0, direction)), (-back, aside, 0.0))
    assert not PAPER.strike(held, strike, speed).missed
    here = PAPER.outcome(held, strike, speed)
    there = PAPER.outcome(se2.compose(scene, held), se2.compose(scene, strike), speed)
    turned = se2.transform_points((0, 0, scene[2]), here[:2])
    assert there[:2] == pytest.approx(turned, abs=1e-6 * np.abs(here).max())
    assert there[2] == pytest.approx(here[2], rel=1e-5, abs=1e-7)


@given(st.floats(-0.2, 0.2), angles, st.floats(0.05, 2), st.sampled_from([DISK, SQUARE]))
def test_a_mirrored_strike_has_a_mirrored_outcome(y, beta, speed, body):
    tap = make(body)
    here = tap.strike((0, 0, 0), (-0.1, y, beta), speed)
    there = tap.strike((0, 0, 0), (-0.1, -y, -beta), speed)
    assert bool(here.missed) == bool(there.missed)
    assert there.displacement == pytest.approx(here.displacement * [1, -1, -1], abs=1e-9)


def test_a_strike_beside_the_object_misses():
    for strike in ((-0.2, 0.054, 0.0), (-0.2, 0.0, math.pi), (0.2, 0.0, 0.0), (0.0, -0.3, 0.0)):
        result = PAPER.strike((0, 0, 0.4), strike, 1.0)
        assert result.missed and not result.displacement.any() and not result.twist.any()
    assert not PAPER.strike((0, 0, 0.4), (-0.2, 0.053, 0.0), 1.0).missed
    assert np.isfinite(PAPER.outcome((0, 0, 0), [(-0.2, 0.0, 0.0), (0.2, 0, 0)], 1.0)).all()


def test_a_polygon_is_hit_at_edges_and_corners():
    tap = make(SQUARE)
    face = tap.strike((0, 0, 0), (-0.2, 0.01, 0.0), 0.5)
    assert face.point == pytest.approx([-0.04, 0.01]) and face.normal == pytest.approx([1, 0])
    assert face.travel == pytest.approx(0.2 - 0.04 - 0.0054)
    corner = tap.strike((0, 0, 0), (-0.2, 0.042, 0.0), 0.5)
    assert corner.point == pytest.approx([-0.04, 0.04])
    assert corner.normal == pytest.approx([math.sqrt(0.0054**2 - 0.002**2) / 0.0054, -2 / 5.4])
    assert tap.strike((0, 0, 0), (-0.2, 0.0455, 0.0), 0.5).missed
    turned = tap.strike((0, 0, math.pi / 4), (-0.2, 0.0, 0.0), 0.5)
    assert turned.point == pytest.approx([-0.04 * math.sqrt(2), 0.0], abs=1e-9)


def test_the_displacement_scales_with_the_square_of_the_striker_speed():
    slow, fast = (PAPER.outcome((0, 0, 0), (-0.2, 0.01, 0.1), v) for v in (0.2, 0.4))
    assert fast == pytest.approx(4 * slow, rel=1e-12)
    assert not PAPER.outcome((0, 0, 0), (-0.2, 0.01, 0.1), 0.0).any()


def test_the_launch_velocity_slides_to_the_outcome():
    held, strike = (0.1, -0.05, 0.7), (-0.2, -0.04, 0.02)
    twist = PAPER.strike(held, strike, 0.4).twist
    rest = PAPER.sliding.rest(math.hypot(twist[0], twist[1]), float(twist[2]))
    moved = PAPER.outcome(held, strike, 0.4)
    assert math.hypot(moved[0], moved[1]) == pytest.approx(rest.distance)
    assert moved[2] == pytest.approx(rest.rotation)
    assert math.atan2(moved[1], moved[0]) == pytest.approx(math.atan2(twist[1], twist[0]))


def test_the_cone_of_the_paper_is_reproduced():
    """Section 4 of the paper: 10 degrees are three times the rotation that a tap over 10 mm can
    cause."""
    slope = math.degrees(PAPER.cone_slope) / 1e3
    assert slope == pytest.approx(0.333, rel=0.02)
    assert math.degrees(make(friction=math.tan(math.radians(11.5))).cone_slope) / 1e3 == (
        pytest.approx(0.3333, rel=2e-3)
    )


@given(round_bodies, st.floats(0.05, 1.0), st.floats(0.2, 5.0), st.floats(0.002, 0.5))
def test_the_cones_edge_is_the_same_at_any_distance(body, friction, kappa, distance):
    tap = make(body, friction, kappa=kappa)
    edge = tap.cone_slope * distance
    assert tap.reachable((distance, 0, edge)) and tap.reachable((0, distance, -edge))
    assert not tap.reachable((distance, 0, 1.0001 * edge))
    angle = tap.impact.largest_impulse_angle((-body.radius, 0.0))
    speed, spin = tap.sliding.launch(distance, edge)
    assert body.radius * spin / speed == pytest.approx(body.gamma * math.sin(angle), rel=1e-9)


def test_an_unreachable_displacement_is_refused_with_its_reason():
    with pytest.raises(UnreachableDisplacementError, match=r"9 degrees.*at most 3\.28.*two taps"):
        PAPER.plan((0.010, 0.0, math.radians(9)))
    with pytest.raises(UnreachableDisplacementError, match=r"1 mm long.*1\.7 mm"):
        PAPER.plan((0.001, 0.0, 0.0))
    with pytest.raises(UnreachableDisplacementError, match="shortest"):
        Tap(PAPER.sliding, PAPER.impact, smallest_distance=0.0).plan((0.0, 0.0, 0.0))
    with pytest.raises(UnreachableDisplacementError, match=r"11\.31\s+degrees|11\.31 degrees"):
        make(SQUARE).plan((0.01, 0.01, 0.0))
    assert not PAPER.reachable([(0.01, 0, 1.0), (0.001, 0, 0), (0, 0, 0)]).any()


@pytest.mark.parametrize(
    "call",
    [
        lambda: PAPER.plan((math.nan, 0, 0)),
        lambda: PAPER.plan((0.01, 0)),
        lambda: PAPER.plan(0.01),
        lambda: PAPER.plan((0.01, 0, 0), (0, math.inf, 0)),
        lambda: PAPER.outcome((0, 0, 0), (0, 0, math.nan), 1.0),
        lambda: PAPER.outcome((0, 0, 0), (-0.1, 0, 0), -1.0),
        lambda: PAPER.reachable((0.01, 0, math.nan)),
        lambda: Tap(PAPER.sliding, PAPER.impact, smallest_distance=-1.0),
        lambda: Tap(PAPER.sliding, make(RING).impact),
    ],
)
def test_invalid_input_is_refused(call):
    with pytest.raises(InvalidParameterError):
        call()


@pytest.mark.parametrize("rotation", [3.0, -2.0, 0.5])
def test_the_jacobian_predicts_small_errors(rotation):
    wanted = np.array([0.006, 0.008, math.radians(rotation)])
    jacobian, plan = PAPER.jacobian(wanted), PAPER.plan(wanted)
    pose, normal = plan.strike_pose, plan.strike_pose[2] - plan.incidence
    travel = math.atan2(wanted[1], wanted[0])
    for error in np.array([[2e-4, -1e-4, 1e-3], [-1e-4, 3e-4, -2e-3]]):
        i, j = error[:2]
        shift = [
            i * math.cos(normal) - j * math.sin(normal),
            i * math.sin(normal) + j * math.cos(normal),
            error[2],
        ]
        moved = PAPER.outcome((0, 0, 0), pose + shift, plan.striker_speed) - wanted
        along = se2.transform_points((0, 0, -travel), moved[:2])
        assert np.array([*along, moved[2]]) == pytest.approx(
            jacobian @ error, abs=0.03 * np.abs(jacobian @ error).max()
        )
    assert PAPER.jacobian(np.stack([wanted, wanted])).shape == (2, 3, 3)


def test_the_jacobian_of_the_paper_is_reproduced():
    """The x and theta rows of the Jacobian agree with section 5.1 of the paper within 10 % rms. The
    product of the Jacobian and the paper's striker error agrees with that in the paper within
    20 %."""
    both = sensitivity(paper_tap(), (0.010, 0.0, math.radians(3)))
    error = (both.printed - PAPER_JACOBIAN)[[0, 2]] / [[0.135], [0.0251]]
    assert np.sqrt((error**2).mean(axis=1)).max() < 0.10
    assert np.array_equal(both.physical[[0, 2]], both.printed[[0, 2]])
    product = both.printed @ PAPER_STRIKER_ERROR
    assert product == pytest.approx([1.1, 0.9, 0.2], rel=0.2)
    assert norm(both.printed) < 1 and norm(both.physical) < 1
    # Moving the striker along its own axis has no effect.
    incidence = paper_tap().plan((0.010, 0.0, math.radians(3))).incidence
    along = np.array([-math.cos(incidence), math.sin(incidence), 0])
    assert np.abs(both.physical @ along)[[0, 2]].max() < 1e-6
