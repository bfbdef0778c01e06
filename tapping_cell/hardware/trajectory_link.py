"""Interface to an arm with its own ROS driver: joint states and trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from tapping_cell.hardware.joint_trajectory import Course, TrajectoryPoint, brake_point
from tapping_cell.hardware.transport import Connection

LONGEST_EXTRAPOLATION = 0.1
"""Maximum time, s, by which the motion of an arm without a known trajectory is extrapolated beyond
its newest joint state."""


@dataclass(frozen=True, slots=True)
class JointSample:
    """Joint positions measured by the arm's own driver; rad and m, in joint order."""

    measured: float
    """Latest possible time of the measurement on the link's steady clock, s."""
    received: float
    """Time when the sample was received, s."""
    positions: tuple[float, ...]
    velocities: tuple[float, ...] | None = None
    """Joint speeds, rad/s and m/s; None if the arm's driver does not report them."""
    ahead: float = 0.0
    """Time by which the sample's stamp is ahead of this computer's clock, s."""
    problem: str = ""
    """Reason why the positions cannot be trusted; empty if they can."""


def braking_point(
    samples: Sequence[JointSample],
    course: Course | None,
    now: float,
    max_acceleration: Sequence[float],
) -> TrajectoryPoint | None:
    """Return the point at which an arm that brakes now comes to rest; None without any sample.

    If the last joint state lies on ``course``, the arm is assumed to have followed it since then.
    Otherwise the last speed is extrapolated for up to ``LONGEST_EXTRAPOLATION``.
    """
    if not samples:
        return None
    newest = samples[-1]
    age = max(now - newest.measured, 0.0)
    on_course = course.after(newest.positions, age) if course is not None else None
    if on_course is not None:
        return brake_point(*on_course, max_acceleration)
    speeds = _speeds(samples)
    ahead = min(age, LONGEST_EXTRAPOLATION)
    place = tuple(p + v * ahead for p, v in zip(newest.positions, speeds, strict=True))
    return brake_point(place, speeds, max_acceleration)


def _speeds(samples: Sequence[JointSample]) -> tuple[float, ...]:
    """Return the joint speeds: as reported, or computed from the last two samples."""
    newest, before = samples[-1], samples[-2] if len(samples) > 1 else samples[-1]
    if newest.velocities is not None:
        return newest.velocities
    span = newest.measured - before.measured
    if span <= 0:
        return (0.0,) * len(newest.positions)
    pairs = zip(before.positions, newest.positions, strict=True)
    return tuple((b - a) / span for a, b in pairs)


class GoalState(Enum):
    """Reported state of the last trajectory that was sent."""

    UNREPORTED = "unreported"
    """Not reported, because the controller accepts trajectories by topic."""
    ACTIVE = "active"
    SUCCEEDED = "succeeded"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Progress:
    """State of the last trajectory, with the controller's error message if it failed."""

    state: GoalState
    words: str = ""


class TrajectoryLink(Connection, Protocol):
    """Connection to a trajectory controller. ``open`` waits until the controller accepts
    trajectories.

    ``stop`` brakes the arm and ignores the bytes that are passed to it.
    """

    @property
    def interface(self) -> str:
        """Interface through which trajectories are sent: topic or action."""

    @property
    def samples(self) -> Sequence[JointSample]:
        """Joint states received in the last second, newest last."""

    @property
    def other_names(self) -> Sequence[str]:
        """Joint names in the last message in which some of the arm's joints were missing; empty if
        there was no such message."""

    @property
    def other_commanders(self) -> Sequence[str]:
        """Other nodes that could send trajectories to this controller."""

    def wait(self, duration: float) -> None:
        """Wait for the next sample for up to ``duration`` s."""

    def send(self, points: Sequence[TrajectoryPoint]) -> None:
        """Send a trajectory, which replaces the current one."""

    def brake(self) -> bool:
        """Brake the arm to rest immediately, from any thread; return whether this was sent."""

    def progress(self) -> Progress:
        """Return the state of the last trajectory."""
