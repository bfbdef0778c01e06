"""Blocking jobs on the arm's driver; a job can be abandoned between two moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmReading, HomingStrategy
from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.hardware.motion import (
    MotionSettings,
    Waypoint,
    speed_for,
    strike_path,
    withdraw_path,
)
from tapping_cell.hardware.scara import Joints, TipPose
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import JobContext

RETRY_S = 0.05
"""Time between two attempts to send a stop, s."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Read-back of the arm's position."""

    homed: bool
    """Whether the arm is homed, so that the joints are valid."""
    joints: Joints
    moving: bool
    stamp: float
    """Steady time at which the reading was requested, s."""


@dataclass(frozen=True, slots=True)
class MotionEnd:
    """Result of a motion. ``complete`` is False if the motion was abandoned or the tap had expired;
    ``reading`` is the read-back afterwards."""

    complete: bool
    reading: Reading


def reading_of(driver: ArmDriver) -> Reading:
    """Read back the arm's position."""
    return _make_reading(driver, driver.read())


def _make_reading(driver: ArmDriver, reading: ArmReading) -> Reading:
    """Convert a driver's reading, and add whether the arm is homed."""
    return Reading(driver.homed, reading.joints, reading.moving, reading.stamp)


def connect(context: JobContext, patience: float) -> Reading:
    """Open the port again and read back the arm's position."""
    driver: ArmDriver = context.driver
    driver.connect(timeout=patience)
    return reading_of(driver)


def read(context: JobContext) -> Reading:
    """Read back the arm's position."""
    return reading_of(context.driver)


def send_stop(context: JobContext, patience: float) -> None:
    """Send a stop that found the port closed, as soon as the port is open again."""
    driver: ArmDriver = context.driver
    while driver.stops_when_opened and not context.abandoned():
        # The fault is expected: after the stop was sent, it is the stop itself.
        with suppress(HardwareFault):
            driver.connect(timeout=patience)
        context.sleep(RETRY_S)


def clear(context: JobContext, is_stopped: Callable[[Now], bool]) -> Reading | None:
    """Clear a stop or a fault; return None if another stop was received since the job was queued.

    ``is_stopped``: query whether a stop is latched. Its answer waits until the host has carried out
    all effects of a stop: the driver is stopped before the job is abandoned.
    """
    driver: ArmDriver = context.driver
    if context.ask(is_stopped):
        return None
    driver.clear_fault()
    return reading_of(driver)


def home(
    context: JobContext,
    strategy: HomingStrategy,
    motion: MotionSettings,
    not_before: float,
    free_at: Callable[[Now], float],
) -> MotionEnd:
    """Home the arm, then park it. ``not_before`` and ``free_at``: see :func:`withdraw`."""
    driver: ArmDriver = context.driver
    _wait_until_free(context, not_before, free_at, lambda: None)
    if context.abandoned():
        return MotionEnd(False, reading_of(driver))
    driver.home(strategy)
    return _park(context, driver.read_joints(), motion)


def place(
    context: JobContext,
    tip: TipPose,
    motion: MotionSettings,
    expiry: int,
    not_before: float,
    hides: Callable[[Joints], bool] = lambda joints: False,
) -> MotionEnd:
    """Move the tip to a pose in ``arm_base`` and settle there. ``expiry``: ROS time in ns;
    ``hides``: see :func:`strike_path`.

    ``not_before``: earliest start, in s of the steady clock. Reports that the striker is charged
    for this tap do not delay the motion, because the tapper charges only above the strike pose, and
    from there the arm only moves down.
    """
    driver: ArmDriver = context.driver
    _wait(context, not_before)
    path = strike_path(driver.geometry, driver.read_joints(), tip, motion, hides)
    if not _move_along(context, path, expiry):
        return MotionEnd(False, _make_reading(driver, driver.read()))
    reading = driver.settle(path[-1].joints if path else None)
    return MotionEnd(not context.abandoned(), _make_reading(driver, reading))


def withdraw(
    context: JobContext,
    plan: Callable[[Joints], Sequence[Waypoint]],
    not_before: float,
    free_at: Callable[[Now], float],
) -> MotionEnd:
    """Leave the strike pose along the path that ``plan`` returns for the present joints.

    ``not_before``: earliest start, in s of the steady clock. ``free_at``: query for the earliest
    start of a motion that has waited since the given time; reports that the striker is charged may
    arrive during the wait.
    """
    driver: ArmDriver = context.driver
    path = plan(driver.read_joints())
    _wait_until_free(context, not_before, free_at, driver.read_joints)
    complete = _move_along(context, path)
    return MotionEnd(complete, _make_reading(driver, driver.read()))


def follow(
    context: JobContext,
    targets: Sequence[tuple[Joints, float]],
    scale: float,
    not_before: float,
    free_at: Callable[[Now], float],
) -> MotionEnd:
    """Follow a trajectory of joints with times in s from its start; the arm stops at every point.

    ``scale``: factor on the speed. ``not_before`` and ``free_at``: see :func:`withdraw`.
    """
    driver: ArmDriver = context.driver
    _wait_until_free(context, not_before, free_at, driver.read_joints)
    here, before, complete = driver.read_joints(), 0.0, True
    for target, at in targets:
        speed = speed_for(driver.geometry, here, target, at - before) if at > before else 1.0
        waypoint = Waypoint(target, scale * speed, "trajectory")
        if target != here and not _move_along(context, (waypoint,)):
            complete = False
            break
        here, before = target, at
    return MotionEnd(complete, _make_reading(driver, driver.settle(None)))


def _wait(context: JobContext, until: float) -> None:
    """Wait without moving until the given time of the steady clock."""
    left = until - context.now().steady
    if left > 0:
        context.sleep(left)


def _wait_until_free(
    context: JobContext,
    not_before: float,
    free_at: Callable[[Now], float],
    read: Callable[[], object],
) -> None:
    """Wait without moving until ``not_before`` and until ``free_at`` permits a motion.

    ``read`` refreshes the reading of the joints before each query, so that the driver need not read
    them between the last query and the start of the motion.
    """
    began = context.now()
    while True:
        read()
        until = max(not_before, context.ask(lambda _: free_at(began)))
        if until <= context.now().steady:
            return
        _wait(context, until)


def _park(context: JobContext, here: Joints, motion: MotionSettings) -> MotionEnd:
    driver: ArmDriver = context.driver
    complete = _move_along(context, withdraw_path(driver.geometry, here, motion))
    return MotionEnd(complete, _make_reading(driver, driver.read()))


def _move_along(context: JobContext, path: Sequence[Waypoint], expiry: int | None = None) -> bool:
    """Move along the waypoints; return False if the motion was abandoned."""
    driver: ArmDriver = context.driver
    for waypoint in path:
        if context.abandoned() or (expiry is not None and context.now().ros > expiry):
            return False
        reading = driver.move_to(
            waypoint.joints, waypoint.speed, via=waypoint.via, via_speed=waypoint.via_speed
        )
        context.post(_make_reading(driver, reading))
    return not context.abandoned()
