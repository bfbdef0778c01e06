"""The cell's driver for an arm that has its own ROS driver, with an emulated controller in virtual
time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from event_clock import EventClock
from hardware_faults import expect_fault
from hypothesis import example, given
from hypothesis import strategies as st
from trajectory_controller import ControllerSettings, TrajectoryController
from virtual_trajectory_link import VirtualTrajectoryLink

from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmSettings, HomingStrategy
from tapping_cell.hardware.dialect import StraightMove
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.joint_trajectory import MIN_PIECE, brake_point, straight_points
from tapping_cell.hardware.motion import move_duration
from tapping_cell.hardware.ros2_control_dialect import Ros2ControlDialect, Ros2ControlSettings
from tapping_cell.hardware.scara import Joints, ScaraGeometry

NAMES = ("j1", "j2", "z", "j4")
START = (0.3, 1.2, -0.030, 0.0)
GOAL = Joints(-0.4, 1.6, -0.010, 0.5)
GEOMETRY = ScaraGeometry()


class Cell(EventClock):
    """An emulated controller and the driver, in virtual time."""

    def __init__(self, by_action: bool = False, rate: float = 50.0, **settings: float) -> None:
        super().__init__(100.0)
        self.controller = TrajectoryController(
            ControllerSettings(NAMES, **settings), START, self.time
        )
        self.link = VirtualTrajectoryLink(
            self.controller,
            GEOMETRY.max_acceleration,
            lambda: self.time,
            self.sleep,
            rate,
            by_action,
        )
        dialect = Ros2ControlDialect(
            self.link,
            Ros2ControlSettings(NAMES, GEOMETRY.max_acceleration, (1e-3, 1e-3, 1e-4, 1e-3)),
        )
        self.driver = ArmDriver(self.link, dialect, GEOMETRY, ArmSettings())

    def ready(self) -> ArmDriver:
        self.driver.connect()
        self.driver.home(HomingStrategy.NONE)
        return self.driver

    def truth(self) -> Joints:
        return Joints(*self.controller.state(self.time)[0])


@pytest.fixture(params=[False, True], ids=["topic", "action"])
def cell(request: pytest.FixtureRequest) -> Cell:
    return Cell(by_action=request.param)


def close(first: Joints, second: Joints) -> bool:
    return bool(np.allclose(first, second, atol=1e-4))


joints = st.tuples(*(st.floats(a, b) for a, b in zip(GEOMETRY.lower, GEOMETRY.upper, strict=True)))
speeds = st.floats(0.05, 1.0)


@given(joints, joints, speeds)
def test_a_move_respects_the_limits_and_takes_the_least_time(start, goal, speed):
    """Check samples of the motion that the emulated controller interpolates between the points of
    the driver. The samples are computed independently of the driver's formulas."""
    duration = move_duration(GEOMETRY, start, goal, speed)
    if duration < 0.05:
        return
    length = math.dist(start, goal)
    ratios = zip(start, goal, GEOMETRY.max_speed, strict=True)
    slowest = max(abs(b - a) / (v * speed) for a, b, v in ratios)
    points = straight_points(
        start, [StraightMove(goal, 60 * length / slowest)], GEOMETRY.max_acceleration
    )
    assert points[-1].time == pytest.approx(duration, rel=1e-6)
    controller = TrajectoryController(ControllerSettings(NAMES, lag=0.0), start)
    assert controller.take(NAMES, points, 0.0) == ""
    times = np.linspace(0, duration, 200)
    track = np.array([controller.state(t)[0] for t in times])
    step = times[1]
    rates = np.diff(track, axis=0) / step
    assert np.all(np.abs(rates) <= np.array(GEOMETRY.max_speed) * speed * (1 + 1e-6) + 1e-9)
    pulls = np.abs(np.diff(rates, axis=0)) / step
    assert np.all(pulls <= np.array(GEOMETRY.max_acceleration) * 1.001 + 1e-6)
    # The motion is a straight line in joint space.
    way = (np.array(goal) - np.array(start)) / length
    beside = (track - np.array(start)) - np.outer((track - np.array(start)) @ way, way)
    assert np.max(np.abs(beside)) < 1e-9
    assert controller.state(duration + 0.1)[0] == pytest.approx(goal, abs=1e-12)


@example(0.0625, 0.0625, 0.0518036, 0.05)
@given(st.floats(0.02, 0.12), st.floats(0.02, 0.12), st.floats(0.05, 0.25), st.floats(0.05, 0.25))
def test_collinear_moves_are_joined_without_a_stop_at_maximum_speed(first, second, fast, slow):
    pull = GEOMETRY.max_acceleration[2]
    start = (0.1, 0.2, 0.0, 0.3)
    via = (0.1, 0.2, -first, 0.3)
    goal = (0.1, 0.2, -first - second, 0.3)
    moves = [StraightMove(via, 60 * fast), StraightMove(goal, 60 * slow)]
    points = straight_points(start, moves, GEOMETRY.max_acceleration)
    # Reference: the maximum speed at each position of a fine grid, limited by the acceleration from
    # both ends.
    places = np.linspace(0.0, first + second, 1001)
    bound = np.where(places < first, fast, slow)
    bound[0] = bound[-1] = 0.0
    gain = 2 * pull * float(places[1])
    for n in range(1, len(places)):
        bound[n] = min(bound[n], math.sqrt(bound[n - 1] ** 2 + gain))
    for n in range(len(places) - 2, -1, -1):
        bound[n] = min(bound[n], math.sqrt(bound[n + 1] ** 2 + gain))
    least = float(np.sum(2 * places[1] / (bound[:-1] + bound[1:])))
    assert points[-1].time == pytest.approx(least, rel=5e-3, abs=3e-3)
    controller = TrajectoryController(ControllerSettings(NAMES, lag=0.0), start)
    assert controller.take(NAMES, points, 0.0) == ""
    times = np.arange(0.0, points[-1].time, 4e-3)
    heights = np.array([controller.state(time)[0][2] for time in times])
    speeds = np.abs(np.diff(heights)) / 4e-3
    beyond = heights[:-1] < -first
    # A change of speed within less than MIN_PIECE has no points of its own. The cubic through its
    # neighbours exceeds the speed by up to a third of this change.
    excess = pull * MIN_PIECE / 3 + 1e-6
    assert np.all(speeds[beyond] <= slow * 1.001 + excess)
    assert np.all(speeds[heights[1:] > -first] <= fast * 1.001 + excess)
    assert np.all(np.abs(np.diff(speeds)) / 4e-3 <= 1.05 * pull + 1e-3)
    assert points[-1].positions == pytest.approx(goal) and not any(points[-1].velocities)


def test_the_arm_stops_at_a_corner() -> None:
    moves = [StraightMove((0.1, 0.2, -0.1, 0.3), 15.0), StraightMove((0.4, 0.2, -0.1, 0.3), 60.0)]
    points = straight_points((0.1, 0.2, 0.0, 0.3), moves, GEOMETRY.max_acceleration)
    (corner,) = [p for p in points if p.positions == pytest.approx((0.1, 0.2, -0.1, 0.3))]
    assert not any(corner.velocities)


def test_the_descent_does_not_stop_where_it_slows_down() -> None:
    cell = Cell()
    driver = cell.ready()
    slow_from, goal = Joints(0.3, 1.2, -0.100, 0.0), Joints(0.3, 1.2, -0.115, 0.0)
    began = cell.time
    driver.move_to(goal, 0.4, via=slow_from, via_speed=0.8)
    times = np.arange(began, cell.time, 0.005)
    moving = [abs(cell.controller.state(float(time))[1][2]) > 0.01 for time in times]
    first, last = moving.index(True), len(moving) - moving[::-1].index(True)
    assert all(moving[first:last]), "it stopped on its way down"
    assert close(cell.truth(), goal)


@given(joints, st.tuples(*(st.floats(-v, v) for v in GEOMETRY.max_speed)))
def test_braking_respects_the_deceleration_limit(place, speed):
    point = brake_point(place, speed, GEOMETRY.max_acceleration)
    assert point.velocities == (0.0,) * 4
    for v, way, a in zip(
        speed, np.array(point.positions) - np.array(place), GEOMETRY.max_acceleration, strict=True
    ):
        assert way == pytest.approx(v * point.time / 2, abs=1e-12)
        assert abs(v) / point.time <= a * (1 + 1e-9)


def test_the_arm_moves_to_its_target_and_rests_there(cell: Cell) -> None:
    driver = cell.ready()
    for goal in (GOAL, Joints(*START), GOAL):
        reading = driver.move_to(goal)
        assert close(reading.joints, goal) and not reading.moving and reading.measured
        assert close(cell.truth(), goal) and not cell.controller.moving(cell.time)
        assert reading.stamp <= cell.time
    assert driver.counters.moves == 3 and driver.counters.retries == 0


def test_nothing_moves_before_it_is_homed(cell: Cell) -> None:
    cell.driver.connect()
    with expect_fault(FaultReason.NOT_HOMED):
        cell.driver.move_to(GOAL)
    assert cell.controller.taken == 0


def test_a_path_passes_through_its_via_point(cell: Cell) -> None:
    driver, via = cell.ready(), Joints(0.1, 1.3, -0.030, 0.2)
    seen: list[float] = []

    def check() -> None:
        seen.append(math.dist(cell.truth(), via))
        cell.after(0.002, check)

    check()
    driver.move_to(GOAL, via=via)
    assert min(seen) < 1e-3


def test_a_lost_trajectory_is_sent_again_while_the_arm_is_at_rest() -> None:
    cell = Cell()
    driver = cell.ready()
    cell.link.faults.lost_trajectories = 1
    assert close(driver.move_to(GOAL).joints, GOAL)
    assert driver.counters.retries == 1


@pytest.mark.parametrize("after", [0.02, 0.1, 0.2, 0.4])
def test_a_stop_brakes_and_latches(cell: Cell, after: float) -> None:
    driver = cell.ready()
    stops: list[tuple[float, bool]] = []
    cell.after(after, lambda: stops.append((cell.time, driver.stop())))
    with expect_fault(FaultReason.STOPPED):
        driver.move_to(GOAL)
    ((at, sent),) = stops
    assert sent
    longest = max(v / a for v, a in zip(GEOMETRY.max_speed, GEOMETRY.max_acceleration, strict=True))
    cell.sleep(longest + 0.1)
    here = cell.truth()
    assert not cell.controller.moving(cell.time) and not close(here, GOAL)
    with pytest.raises(HardwareFault):
        driver.move_to(GOAL)
    driver.clear_fault()
    with expect_fault(FaultReason.NOT_HOMED):
        driver.move_to(GOAL)
    assert close(cell.truth(), here), "something moved before it was homed again"
    driver.home(HomingStrategy.NONE)
    assert close(driver.move_to(GOAL).joints, GOAL)


@pytest.mark.parametrize("when", [-1.0, 0.2], ids=["at rest", "in motion"])
def test_a_joint_state_timeout_is_a_fault_with_a_message(cell: Cell, when: float) -> None:
    driver = cell.ready()
    began = cell.time
    if when < 0:
        cell.link.faults.silent = True
    else:
        cell.after(when, lambda: setattr(cell.link.faults, "silent", True))
    with expect_fault(FaultReason.DISCONNECTED, "joint_state_broadcaster"):
        driver.move_to(GOAL)
    assert cell.time - began - max(when, 0) < 0.6
    assert not driver.connected


def test_old_stamps_are_distinguished_from_a_timeout(cell: Cell) -> None:
    driver = cell.ready()
    cell.link.faults.late = 0.6
    cell.sleep(1.0)
    with pytest.raises(HardwareFault, match="synchronise the clocks"):
        driver.read()


def test_a_clock_that_is_ahead_is_refused_at_connect(cell: Cell) -> None:
    cell.link.faults.ahead = 0.4
    with expect_fault(FaultReason.SETTINGS_MISMATCH, "synchronise the clocks"):
        cell.driver.connect()


def test_slow_joint_states_are_refused_at_connect() -> None:
    with pytest.raises(HardwareFault, match=r"10 Hz, must be at least 20 Hz"):
        Cell(rate=10.0).driver.connect()


def test_unexpected_joints_are_named(cell: Cell) -> None:
    cell.link.faults.foreign_names = True
    with pytest.raises(HardwareFault, match=r"j1, j2, z, j4 .*gripper"):
        cell.driver.connect()


def test_a_missing_controller_is_reported(cell: Cell) -> None:
    cell.link.faults.present = False
    with expect_fault(FaultReason.PORT_MISSING):
        cell.driver.connect(timeout=1.0)


def test_an_obstacle_stops_the_arm(cell: Cell) -> None:
    driver = cell.ready()
    cell.after(0.2, lambda: cell.controller.block(cell.time))
    with pytest.raises(HardwareFault) as caught:
        driver.move_to(GOAL)
    assert caught.value.reason in (FaultReason.REJECTED, FaultReason.POSITION_MISMATCH)
    assert not close(cell.truth(), GOAL)


def test_a_joint_off_its_commanded_position_is_not_a_success(cell: Cell) -> None:
    cell.controller = cell.link.controller = TrajectoryController(
        ControllerSettings(NAMES, offset=0.003), START, cell.time
    )
    driver = cell.ready()
    with pytest.raises(HardwareFault):
        driver.move_to(GOAL)


def test_a_motion_by_another_program_at_rest_is_detected(cell: Cell) -> None:
    driver = cell.ready()
    driver.move_to(GOAL)
    cell.controller.push((0.01, 0.0, 0.0, 0.0), cell.time)
    cell.sleep(0.2)
    with expect_fault(FaultReason.POSITION_LOST, "it was moved"):
        driver.move_to(Joints(*START))


def test_the_move_fails_if_another_program_takes_the_controller() -> None:
    for by_action in (False, True):
        cell = Cell(by_action)
        driver = cell.ready()
        elsewhere = straight_points(
            START, [StraightMove((0.8, 1.0, -0.03, 0.0), 60.0)], GEOMETRY.max_acceleration
        )

        def rival(cell: Cell = cell, points: object = elsewhere) -> None:
            cell.controller.take(NAMES, points, cell.time)  # type: ignore[arg-type]

        cell.after(0.2, rival)
        with pytest.raises(HardwareFault):
            driver.move_to(GOAL)
        assert driver.counters.moves == 0


def test_a_reduced_speed_override_is_waited_for_with_a_limit(cell: Cell) -> None:
    slow = Cell(speed_scaling=0.7)
    assert close(slow.ready().move_to(GOAL).joints, GOAL)
    slower = Cell(speed_scaling=0.1)
    driver = slower.ready()
    with expect_fault(FaultReason.TIMEOUT, "had not ended"):
        driver.move_to(GOAL)
    slower.sleep(4.0)
    assert not slower.controller.moving(slower.time)


def test_rest_is_detected_without_velocities(cell: Cell) -> None:
    cell.link.faults.no_velocities = True
    driver = cell.ready()
    assert "no velocities" in " ".join(driver.firmware.remarks if driver.firmware else ())
    assert close(driver.move_to(GOAL).joints, GOAL)


def test_a_moving_arm_is_not_homed(cell: Cell) -> None:
    cell.driver.connect()
    points = straight_points(START, [StraightMove(GOAL, 60.0)], GEOMETRY.max_acceleration)
    cell.controller.take(NAMES, points, cell.time)
    cell.sleep(0.2)
    with pytest.raises(HardwareFault, match="wait until it stops"):
        cell.driver.home(HomingStrategy.NONE)


def test_a_nan_joint_value_is_a_lost_position(cell: Cell) -> None:
    driver = cell.ready()
    cell.controller.push((math.nan, 0.0, 0.0, 0.0), cell.time)
    cell.sleep(0.2)
    with expect_fault(FaultReason.POSITION_LOST, "hardware is not active"):
        driver.read()
    assert not driver.homed


@given(
    st.booleans(),
    st.lists(
        st.tuples(
            joints,
            speeds,
            st.sampled_from(["", "lose", "silence", "block", "push", "stop", "rival", "absent"]),
            st.floats(0.0, 1.0),
        ),
        min_size=1,
        max_size=3,
    ),
)
def test_success_always_means_at_the_target_and_at_rest(by_action, plan):
    cell = Cell(by_action)
    driver = cell.ready()
    faults = cell.link.faults
    actions: dict[str, Callable[[], object]] = {
        "lose": lambda: setattr(faults, "lost_trajectories", 1),
        "silence": lambda: setattr(faults, "silent", True),
        "block": lambda: cell.controller.block(cell.time),
        "push": lambda: cell.controller.push((0.02, 0.0, 0.0, 0.0), cell.time),
        "stop": driver.stop,
        "rival": lambda: cell.controller.take(
            NAMES, [brake_point(START, (0.0,) * 4, (1.0,) * 4)], cell.time
        ),
        "absent": lambda: setattr(faults, "present", False),
    }
    for goal, speed, fault, when in plan:
        if fault:
            cell.after(when, actions[fault])
        try:
            reading = driver.move_to(Joints(*goal), speed)
        except HardwareFault as caught:
            assert len(caught.sentence) > 20
        else:
            assert np.all(np.abs(np.subtract(cell.truth(), goal)) <= (2e-3, 2e-3, 2e-4, 2e-3))
            assert close(reading.joints, Joints(*goal)) or fault
        cell.sleep(1.5)
        cell.events.clear()
        # An arm whose controller cannot be reached finishes its trajectory.
        while fault == "absent" and cell.controller.moving(cell.time):
            cell.sleep(0.5)
        faults.silent, faults.present, faults.lost_trajectories = False, True, 0
        cell.controller.unblock(cell.time)
        cell.sleep(1.0)
        driver.clear_fault()
        driver.home(HomingStrategy.NONE)
