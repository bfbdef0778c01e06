"""Adapter that lets an arm of any kinematics act as the SCARA that the cell plans for.

The cell file describes a SCARA. The real arm must be able to reach every tip pose of this SCARA
with its striker upright. This link connects the SCARA's driver with the real arm's trajectory
controller. Inverse kinematics converts a trajectory of the SCARA's joints point by point to the
real joints, starting from their current position, so that the tip follows the same path. Forward
kinematics converts the measured real joint states to the SCARA's joints, so every check of the
driver (in position, at rest, moved externally) uses the real joint states. A straight move of the
SCARA's quill is a straight vertical move of the striker.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.joint_trajectory import Course, TrajectoryPoint
from tapping_cell.hardware.scara import Branch, ReachCode, ScaraGeometry
from tapping_cell.hardware.serial_chain import Array, SerialChain
from tapping_cell.hardware.trajectory_link import JointSample, Progress, TrajectoryLink

STEP = 0.02
"""Time between two points of a trajectory, s."""
MIN_STEP = 0.005
"""Minimum time between an intermediate point and a corner, s; intermediate points that are closer
are left out."""
LONGEST_STRETCH = 1.4
LONGEST_DELAY = 1.5
"""Limits on slowing a trajectory down to respect the joint speeds. A trajectory may take at most
``LONGEST_STRETCH`` times its planned duration plus ``LONGEST_DELAY`` s. This is less than the
driver's deadline, which is 1.5 times the planned duration plus 2 s."""
SPEED_STEP = 1e-3
"""Time step, s, of the finite difference that converts the real arm's joint speeds to those of the
SCARA."""
TURNS = 12.6
"""Limit, rad, of the rotary joints of the cell file's SCARA while the pose of the real arm is
converted to SCARA joints: two turns in each direction. The limit is wide, because the driver
checks the actual joint limits."""


@dataclass(frozen=True, slots=True)
class ChainSettings:
    """Park pose, and limits of the striker's pose."""

    park: tuple[float, ...]
    """SCARA joints of the park pose: rad, rad, m, rad. If several SCARA poses match the first
    measured pose of the real arm, the one nearest to the park pose is used."""
    tilt: float = 0.01
    """Largest angle between the striker's z axis and the vertical, rad."""
    travel_height: float = 0.06
    """Minimum tip height, m, of a path on which the tip may make an extra full turn about its
    vertical axis. The extra turn can keep a joint within its limits."""


class ChainLink:
    """A :class:`~tapping_cell.hardware.trajectory_link.TrajectoryLink` in SCARA joints."""

    def __init__(
        self,
        link: TrajectoryLink,
        chain: SerialChain,
        geometry: ScaraGeometry,
        settings: ChainSettings,
    ) -> None:
        self._link = link
        self._chain = chain
        self._geometry = geometry
        self._settings = settings
        self._wide = replace(
            geometry,
            singularity_margin=0.0,
            lower=(-TURNS, -TURNS, -10.0, -TURNS),
            upper=(TURNS, TURNS, 10.0, TURNS),
        )
        self._near: Array = np.array(settings.park, dtype=np.float64)
        self._course: tuple[float, float, Course] | None = None
        self._converted: dict[float, JointSample] = {}

    @property
    def name(self) -> str:
        """The controller's name."""
        return self._link.name

    @property
    def is_open(self) -> bool:
        """True if the controller was available at the last ``open``."""
        return self._link.is_open

    @property
    def interface(self) -> str:
        """Interface through which trajectories are sent: topic or action."""
        return self._link.interface

    @property
    def other_names(self) -> Sequence[str]:
        """Joint names in the last message in which some of the arm's joints were missing."""
        return self._link.other_names

    @property
    def other_commanders(self) -> Sequence[str]:
        """Other nodes that could send trajectories to the controller."""
        return self._link.other_commanders

    @property
    def samples(self) -> Sequence[JointSample]:
        """Joint states received in the last second, as SCARA joints, newest last."""
        samples = self._link.samples
        kept = self._converted
        self._converted = {}
        for sample in samples:
            known = kept.get(sample.received)
            self._converted[sample.received] = self._scara(sample) if known is None else known
        return tuple(self._converted.values())

    def now(self) -> float:
        """Return the time of the steady clock, s."""
        return self._link.now()

    def open(self, timeout: float) -> None:
        """Wait until the controller accepts trajectories."""
        self._course = None
        self._near = np.array(self._settings.park, dtype=np.float64)
        self._converted = {}
        self._link.open(timeout)

    def close(self) -> None:
        """Disconnect from the controller."""
        self._link.close()

    def stop(self, data: bytes) -> bool:
        """Latch the stop and brake; from any thread."""
        return self._link.stop(data)

    def release(self) -> None:
        """Release the latch of ``stop``."""
        self._link.release()

    def wait(self, duration: float) -> None:
        """Wait for the next sample for up to ``duration`` s."""
        self._link.wait(duration)

    def brake(self) -> bool:
        """Brake the arm to rest immediately; from any thread."""
        return self._link.brake()

    def progress(self) -> Progress:
        """Return the state of the last trajectory."""
        return self._link.progress()

    def send(self, points: Sequence[TrajectoryPoint]) -> None:
        """Move the real arm along the path of the SCARA's tip.

        Raises HardwareFault UNREACHABLE if a joint would exceed its limit or greatly exceed its
        speed; nothing is then sent. Also raises the faults of the real link.
        """
        start = self.samples[-1]
        course = Course(start.positions, points)
        real = self._link.samples[-1]
        times = _times(points)
        joints = self._along(course, times, np.array(real.positions))
        stretch = self._stretch(times, joints)
        if stretch * times[-1] > LONGEST_STRETCH * times[-1] + LONGEST_DELAY:
            raise HardwareFault(
                FaultReason.UNREACHABLE,
                f"a joint of {self.name} would have to move at {stretch:.1f} times its maximum "
                "speed: the path passes near a singular pose, or arm.max_speed is too high "
                "for this arm",
            )
        times = times * stretch
        speeds = np.gradient(joints, times, axis=0)
        speeds[0] = speeds[-1] = 0.0
        for corner in points:
            if not any(corner.velocities):
                speeds[np.abs(times - corner.time * stretch) < 1e-9] = 0.0
        self._link.send(
            [
                TrajectoryPoint(float(time), tuple(place), tuple(speed))
                for time, place, speed in zip(
                    times[1:], joints[1:].tolist(), speeds[1:].tolist(), strict=True
                )
            ]
        )
        self._course = (self.now(), stretch, course)

    def _along(self, course: Course, times: Array, real: Array) -> Array:
        """Return the real arm's joints at each of ``times``, starting at its current position
        ``real``. An initial tilt of the striker is removed gradually along the path."""
        tips = self._geometry.forward_many(course.at(times)[0])
        high = bool(np.min(tips[:, 2]) > self._settings.travel_height - 1e-3)
        part = times / times[-1]
        fault: HardwareFault | None = None
        for turns in (0, -1, 1) if high else (0,):
            turned = tips.copy()
            turned[:, 3] += turns * math.tau * part**2 * (3 - 2 * part)
            try:
                joints = self._solved_all(turned, real)
            except HardwareFault as met:
                fault = fault or met
            else:
                left = (1 - part)[:, None]
                return np.asarray(joints + left * (real - joints[0]))
        assert fault is not None
        raise fault

    def _solved_all(self, tips: Array, real: Array) -> Array:
        found = [self._solved(tips[0], real)]
        for tip in tips[1:]:
            found.append(self._solved(tip, found[-1]))
        return np.array(found)

    def _solved(self, tip: Array, seed: Array) -> Array:
        solution = self._chain.inverse(upright(tip), seed)
        if not solution.success:
            raise HardwareFault(
                FaultReason.UNREACHABLE,
                f"{self.name} cannot bring the striker to {solution.reason}; choose another pose,"
                " or move the arm's base",
            )
        return solution.joints

    def _stretch(self, times: Array, joints: Array) -> float:
        """Return the factor (at least 1) by which the planned duration must be extended."""
        speeds = np.abs(np.diff(joints, axis=0)) / np.diff(times)[:, None]
        return max(1.0, float(np.max(speeds / self._chain.max_speed)))

    def _scara(self, sample: JointSample) -> JointSample:
        """Convert a sample of the real joints to SCARA joints."""
        near = self._expected(sample.measured)
        place, problem = self._converted_place(np.array(sample.positions), near)
        if not problem:
            self._near = place
        speeds = None
        if sample.velocities is not None:
            ahead = np.array(sample.positions) + SPEED_STEP * np.array(sample.velocities)
            beyond, beyond_problem = self._converted_place(ahead, place)
            if not (problem or beyond_problem):
                speeds = tuple(((beyond - place) / SPEED_STEP).tolist())
        return JointSample(
            sample.measured,
            sample.received,
            tuple(place.tolist()),
            speeds,
            sample.ahead,
            problem or sample.problem,
        )

    def _expected(self, time: float) -> Array:
        """Return the SCARA's planned joints at ``time``, or its last joints if no trajectory was
        sent."""
        if self._course is None:
            return self._near
        began, stretch, course = self._course
        place, _ = course.at(np.array([(time - began) / stretch], dtype=np.float64))
        return np.asarray(place[0])

    def _converted_place(self, joints: Array, near: Array) -> tuple[Array, str]:
        """Return the SCARA joints that put the SCARA's tip at the real striker, and the reason why
        they cannot be trusted (empty if they can). Of several solutions, the one nearest to
        ``near`` is returned."""
        pose = self._chain.forward(joints)
        if not np.all(np.isfinite(pose)):
            return np.full(4, np.nan), ""
        tip = np.array([*pose[:3, 3], math.atan2(pose[1, 0], pose[0, 0])])
        lean = math.acos(min(1.0, max(-1.0, float(pose[2, 2]))))
        problem = ""
        if lean > self._settings.tilt:
            problem = (
                f"the striker leans by {math.degrees(lean):.1f} deg (limit "
                f"{math.degrees(self._settings.tilt):.1f} deg): turn it upright with the "
                "arm's own panel, over the table and near its park pose, or correct "
                "arm.ros2_control.chain.tool"
            )
        found = [
            solution.joints
            for branch in Branch
            if int((solution := self._wide.inverse_many(tip, branch, near)).code)
            == ReachCode.REACHED
        ]
        if not found:
            return near, problem or (
                f"the striker is at x {tip[0] * 1e3:.0f} mm, y {tip[1] * 1e3:.0f} mm from "
                "arm_base, where the SCARA of the cell file cannot reach: with the arm's own "
                "panel, move the striker to a place that this SCARA can reach, or correct "
                "arm.upper_arm, arm.forearm and arm.ros2_control.chain"
            )
        return min(found, key=lambda place: float(np.sum(np.abs(place - near)))), problem


def upright(tip: Array) -> Array:
    """Return the 4 x 4 matrix of a tip pose x, y, z, yaw in ``arm_base``."""
    x, y, z, yaw = tip
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array(
        [[cos, -sin, 0.0, x], [sin, cos, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]]
    )


def _times(points: Sequence[TrajectoryPoint]) -> Array:
    """Return the times, in s from the start, of the trajectory's corners and of the points between
    them."""
    corners = np.array([0.0, *(point.time for point in points)])
    between = np.arange(STEP, corners[-1], STEP)
    apart = np.min(np.abs(between[:, None] - corners), axis=1) > MIN_STEP
    return np.sort(np.concatenate([corners, between[apart]]))
