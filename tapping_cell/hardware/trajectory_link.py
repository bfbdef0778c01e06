"""What the driver needs of an arm that has a driver of its own: joint states and trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from tapping_cell.hardware.joint_trajectory import TrajectoryPoint
from tapping_cell.hardware.transport import Connection


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

    ``stop`` ignores its bytes and makes the controller brake to rest.
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

    def progress(self) -> Progress:
        """What became of the trajectory that was sent last."""
