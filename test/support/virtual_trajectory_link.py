"""Link to an emulated trajectory controller, in externally controlled time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from trajectory_controller import TrajectoryController, stamps

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.joint_trajectory import Course, TrajectoryPoint
from tapping_cell.hardware.trajectory_link import (
    GoalState,
    JointSample,
    Progress,
    braking_point,
)

KEPT = 1.0


@dataclass(slots=True)
class LinkFaults:
    """Faults of the network and the arm's computer."""

    present: bool = True
    """Whether the controller is available."""
    silent: bool = False
    """Whether no joint states are received."""
    lost_trajectories: int = 0
    """Number of trajectories, beginning with the next one, that are lost."""
    late: float = 0.0
    """Delay of the joint states after their measurement, in s."""
    ahead: float = 0.0
    """Time by which the arm's clock is ahead, in s."""
    foreign_names: bool = False
    """Whether the joint states contain joint names that differ from those of the arm."""
    no_velocities: bool = False


class VirtualTrajectoryLink:
    """A :class:`~tapping_cell.hardware.trajectory_link.TrajectoryLink` in virtual time.

    ``now``: returns the time, in s. ``sleep``: lets time pass for the driver.
    """

    name = "/scara_controller"
    other_commanders: Sequence[str] = ()

    def __init__(
        self,
        controller: TrajectoryController,
        max_acceleration: Sequence[float],
        now: Callable[[], float],
        sleep: Callable[[float], None],
        rate: float = 50.0,
        by_action: bool = False,
    ) -> None:
        self.controller = controller
        self.faults = LinkFaults()
        self._max_acceleration = tuple(max_acceleration)
        self._now = now
        self._sleep = sleep
        self._rate = rate
        self._by_action = by_action
        self._samples: deque[JointSample] = deque()
        self._received_until = now()
        self._course: Course | None = None
        self._open = False
        self._stopped = False

    @property
    def interface(self) -> str:
        """Interface through which trajectories are sent: topic or action."""
        return "action" if self._by_action else "topic"

    @property
    def is_open(self) -> bool:
        """Whether the controller was available at the last ``open``."""
        return self._open

    @property
    def other_names(self) -> Sequence[str]:
        """Joint names of the last message that lacked some of the arm's joints."""
        return ("gripper",) if self.faults.foreign_names else ()

    @property
    def samples(self) -> Sequence[JointSample]:
        """Joint states received in the last second, newest last."""
        self._listen()
        return tuple(self._samples)

    def now(self) -> float:
        """Return the time of the clock, in s."""
        return self._now()

    def open(self, timeout: float) -> None:
        """Wait until the controller is available."""
        self._open = False
        deadline = self.now() + timeout
        while not self.faults.present:
            if self.now() >= deadline:
                raise HardwareFault(FaultReason.PORT_MISSING, f"{self.name} is not there")
            self._sleep(0.05)
        self._listen()
        self._samples.clear()
        self._open = True

    def close(self) -> None:
        """Disconnect from the controller."""
        self._open = False

    def stop(self, data: bytes) -> bool:
        """Latch the stop and brake."""
        self._stopped = True
        return self.brake()

    def brake(self) -> bool:
        """Send a trajectory that brings the arm to rest; return whether it was sent."""
        self._listen()
        course, self._course = self._course, None
        point = braking_point(self._samples, course, self.now(), self._max_acceleration)
        if point is None or not self.faults.present:
            return False
        self.controller.take(self.controller.settings.names, [point], self.now())
        return True

    def release(self) -> None:
        """Release the latch of ``stop``."""
        self._stopped = False

    def wait(self, duration: float) -> None:
        """Let time pass until the next sample is due, at most ``duration`` s."""
        self._require()
        self._sleep(min(max(duration, 1e-3), 1 / self._rate))
        self._require()

    def send(self, points: Sequence[TrajectoryPoint]) -> None:
        """Send a trajectory."""
        self._require()
        if not self.faults.present:
            self._open = False
            raise HardwareFault(FaultReason.DISCONNECTED, f"{self.name} has gone")
        self._course = Course(self.samples[-1].positions, points)
        if self.faults.lost_trajectories > 0:
            self.faults.lost_trajectories -= 1
            return
        self.controller.take(
            self.controller.settings.names, points, self.now(), as_goal=self._by_action
        )

    def progress(self) -> Progress:
        """Return the state of the last trajectory."""
        progress = self.controller.progress(self.now())
        return progress if self._by_action else Progress(GoalState.UNREPORTED)

    def _listen(self) -> None:
        """Receive the states published since the last call."""
        until = self.now() - self.faults.late
        for measured in stamps(self._received_until, until, self._rate):
            self._received_until = measured
            if self.faults.silent or self.faults.foreign_names or not self.faults.present:
                continue
            positions, speeds = self.controller.state(measured)
            self._samples.append(
                JointSample(
                    measured,
                    measured + self.faults.late,
                    positions,
                    None if self.faults.no_velocities else speeds,
                    self.faults.ahead,
                )
            )
        while self._samples and self._samples[0].received < self.now() - KEPT:
            self._samples.popleft()

    def _require(self) -> None:
        if self._stopped:
            raise HardwareFault(FaultReason.STOPPED, f"{self.name}: a stop is latched")
        if not self._open:
            raise HardwareFault(FaultReason.DISCONNECTED, f"{self.name} is not open")
