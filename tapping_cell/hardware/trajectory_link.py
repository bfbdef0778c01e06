"""What the driver needs of an arm that has a driver of its own: joint states and trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from tapping_cell.hardware.joint_trajectory import Course, TrajectoryPoint, brake_point
from tapping_cell.hardware.transport import Connection

LONGEST_EXTRAPOLATION = 0.1
"""Beyond the newest joint state of an arm on no known course, s."""


@dataclass(frozen=True, slots=True)
class JointSample:
    """Where the joints were, as the arm's own driver measured it; rad and m, joints in order."""

    measured: float
    """Time of the link's steady clock at which it was measured at the latest, s."""
    received: float
    """When it came, s."""
    positions: tuple[float, ...]
    velocities: tuple[float, ...] | None = None
    """None where the arm's driver does not tell them."""
    ahead: float = 0.0
    """By how much its stamp lies in the future by this computer's clock, s."""
    doubt: str = ""
    """Why the positions are not to be believed; empty where they are."""


def braking_point(
    samples: Sequence[JointSample],
    course: Course | None,
    now: float,
    max_acceleration: Sequence[float],
) -> TrajectoryPoint | None:
    """Where an arm that is stopped now comes to rest; None where nothing was heard of it.

    An arm on its ``course`` is taken to have followed it since its last state; without one, to have
    gone on for a little at the speed that it had.
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
    """How fast the joints move, told or by the last two samples."""
    newest, before = samples[-1], samples[-2] if len(samples) > 1 else samples[-1]
    if newest.velocities is not None:
        return newest.velocities
    span = newest.measured - before.measured
    if span <= 0:
        return (0.0,) * len(newest.positions)
    pairs = zip(before.positions, newest.positions, strict=True)
    return tuple((b - a) / span for a, b in pairs)


class GoalState(Enum):
    """What the controller told of the trajectory that was sent last."""

    UNTOLD = "untold"
    """It takes trajectories by topic and tells nothing."""
    ACTIVE = "active"
    SUCCEEDED = "succeeded"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Progress:
    """What became of the last trajectory, with the controller's own words where it failed."""

    state: GoalState
    words: str = ""


class TrajectoryLink(Connection, Protocol):
    """The way to a trajectory controller. ``open`` waits until it takes trajectories.

    ``stop`` ignores its bytes, and brakes.
    """

    @property
    def interface(self) -> str:
        """How trajectories are sent: topic or action."""

    @property
    def samples(self) -> Sequence[JointSample]:
        """What was heard in the last second, the newest last."""

    @property
    def other_names(self) -> Sequence[str]:
        """Joint names of the last message that lacked some of ours; empty if there was none."""

    @property
    def rivals(self) -> Sequence[str]:
        """Other nodes that could send this controller trajectories."""

    def wait(self, duration: float) -> None:
        """Wait for the next sample, for up to ``duration`` s."""

    def send(self, points: Sequence[TrajectoryPoint]) -> None:
        """Send a trajectory, which replaces the one under way."""

    def brake(self) -> bool:
        """From any thread: have the arm come to rest at once; returns whether that went out."""

    def progress(self) -> Progress:
        """What became of the trajectory that was sent last."""
