"""Invariants of set-up mode: nothing moves unless a person holds an enabling device, and the arm is
slow and the striker weak."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from tapping_cell.messages import ArmState, TapperState
from tapping_cell.verification.people import KEY, SWITCH
from tapping_cell.verification.physical_cell import PhysicalCell, Release
from tapping_cell.verification.scheduler import Scheduler

# The limits are written here and not imported from ``logic``, so that a wrong limit in the product
# is detected.
HEARTBEAT_S = 0.35
"""Time after the last message of a device from which this device counts as released, s."""
SWITCH_S = 0.5
"""Maximum time from the release of the switch until the tapper's process counts it as released, s:
``HEARTBEAT_S`` after the board's last reply, and the time of this reply on the line."""
WINDOW_S = 0.1
"""Maximum time from the release of the device to a release of the striker, s. The command FIRE may
already have been sent, so this maximum is the board's longest firing window."""
REPORTED_S = 1.0
"""Maximum time from the release of the switch until the arm's process counts it as released, s:
``SWITCH_S``, one period of the tapper's state, ``HEARTBEAT_S``, and the error of the clocks. After
a freeze of the tapper's process, the time begins at the end of the freeze."""
BEGIN_S = 0.2
"""Maximum time from the release of the device until the arm begins a further part of a motion, s:
two periods of the node's timer and the time on the line."""
STOP_S = 1.5
"""Maximum time from the release of the device until the arm is at rest, s. This time includes the
delivery of the stop to the controller and the braking."""
CONNECTION_S = 4.0
"""The same time, s, if the arm's node was started during the motion and still tries to connect: it
sends the stop at the beginning of an attempt, 1 s after the end of the last one."""
SPEED = 0.25
"""Maximum speed in set-up mode, as a fraction of the maximum joint speeds."""
ENERGY_J, ENERGY_SHARE = 0.005, 0.03
"""Maximum energy of a release while the switch is not held, J, and the tolerance of this energy."""
ROUNDING = 1e-6
"""Tolerance for the rounding of times (s) and of speeds (fraction)."""
WORKS = (ArmState.HOMING, ArmState.MOVING)
"""States of the arm that a command begins."""


@dataclass(slots=True)
class SetUpChecker:
    """Checks the invariants of set-up mode. Times are in s from the start of the run.

    ``violate`` records a violation. ``arm_runs_since`` returns the time since which the arm's
    process runs without a freeze; inf while it does not run. ``arm_connected`` returns whether the
    arm's node has connected since its start.
    """

    scheduler: Scheduler
    physical: PhysicalCell
    violate: Callable[[str, str], None]
    arm_runs_since: Callable[[], float]
    arm_connected: Callable[[], bool]
    has_arm: bool = True
    tapper_frozen_until: Callable[[], float] = lambda: -math.inf
    """Return the time until which the tapper's process is or was frozen."""
    arm_knows_clock: Callable[[], bool] = lambda: True
    """Return whether the arm's node knows the clock of the tapper's computer."""
    _until: dict[tuple[str, str], float] = field(default_factory=dict)
    """For each process and device: time until which the device counts as held."""
    _switch_released: float = -math.inf
    """Time at which the switch was last released; inf while it is held."""
    _arm: int = ArmState.DISCONNECTED
    _tapper: int = TapperState.DISCONNECTED
    _moving: bool = False
    _lapsed: bool = False
    """Whether the arm's process counts every device as released."""
    _told: bool = False
    """Whether a violation was recorded since the devices were released."""
    _commanded_until: float = -math.inf
    """Time by which the arm's line has delivered all commands sent before the release."""

    def on_device(self, process: str, device: str, held: bool, sent_at: float) -> None:
        """Process a message of a device (the page's key, or the switch in the tapper's state) that
        a process has handled.

        ``sent_at``: time at which the message was sent. A message of the key has no stamp, so it
        counts from its arrival."""
        before = self._until.get((process, device), -math.inf)
        end = sent_at + HEARTBEAT_S
        self._until[process, device] = max(before, end) if held else min(before, self.scheduler.now)

    def on_switch(self, held: bool) -> None:
        """Process that a person holds or releases the switch at the tapper's board."""
        self._switch_released = math.inf if held else self.scheduler.now

    def on_state(self, message: ArmState | TapperState) -> None:
        """Check that arm and tapper begin to work only while a device is held."""
        now = self.scheduler.now
        if isinstance(message, ArmState):
            begins = message.state in WORKS and self._arm not in WORKS
            self._arm = message.state
            since = now - self.enabled_until("scara_arm")
        else:
            begins = message.state == TapperState.CHARGING != self._tapper
            self._tapper = message.state
            since = now - self.enabled_until("tapper_trigger")
        if begins and since > ROUNDING:
            part = "arm" if isinstance(message, ArmState) else "tapper"
            self.violate(
                "work without enabling",
                f"the {part} began to work (state {message.state}) {since:.2f} s after the enabling"
                " device was released",
            )

    def on_asked(self, job: str, answer: object | None) -> None:
        """Check that the tapper's state machine lets a job charge or fire only while a device is
        held. ``answer``: why the job must end, or None."""
        since = self.scheduler.now - self.enabled_until("tapper_trigger")
        if job in ("charge", "fire") and answer is None and since > ROUNDING:
            self.violate(
                "work without enabling",
                f"the tapper's check allowed to {job} {since:.2f} s after the enabling device was"
                " released",
            )

    def enabled_until(self, process: str) -> float:
        """Return the time at which a process counts every device as released; a time in the future
        if no further message arrives until then."""
        key, switch = (self._until.get((process, name), -math.inf) for name in (KEY, SWITCH))
        if process == "tapper_trigger":
            switch = self._switch_released + SWITCH_S
        elif self.arm_knows_clock():
            # The state that the tapper reports must be true.
            released = max(self._switch_released, self.tapper_frozen_until())
            switch = min(switch, released + REPORTED_S)
        return max(key, switch)

    def check_release(self, release: Release) -> None:
        """Check that a device was held, and that the energy was small without the switch."""
        late = release.time - self.enabled_until("tapper_trigger")
        if late > WINDOW_S:
            self.violate(
                "fired without enabling",
                f"shot {release.shot} was released {late:.3f} s after the enabling device was"
                " released",
            )
        limit = (1.0 + ENERGY_SHARE) * ENERGY_J
        if release.energy > limit and release.time > self._switch_released + ROUNDING:
            self.violate(
                "too much energy for set-up",
                f"shot {release.shot} was released with {1e3 * release.energy:.2f} mJ while the"
                f" enabling switch was not held (limit {1e3 * limit:.2f} mJ)",
            )

    def check_speed(self, speed: float) -> None:
        """Check the speed of a move, as a fraction of the maximum joint speeds."""
        if speed > SPEED * (1.0 + ROUNDING):
            self.violate(
                "too fast for set-up",
                f"a move has {speed:.2f} of the maximum joint speeds (limit {SPEED:g})",
            )

    def check_motion(self) -> None:
        """Check that the arm neither begins nor continues a motion without a device."""
        if not self.has_arm:
            return
        now, moving = self.scheduler.now, self.physical.moving(self.scheduler.now)
        begins, self._moving = moving and not self._moving, moving
        end = self.enabled_until("scara_arm")
        if now <= end:
            self._lapsed = self._told = False
            return
        if not self._lapsed:
            self._lapsed = True
            self._commanded_until = self.physical.arm_line.layer.delivered_by(now)
        since = now - max(end, self.arm_runs_since())
        if not moving or self._told or since <= BEGIN_S:
            return
        if begins and now > self._commanded_until + ROUNDING:
            self.violate(
                "moved without enabling",
                f"the arm began to move {since:.2f} s after the enabling device was released",
            )
            self._told = True
        elif since > (STOP_S if self.arm_connected() else CONNECTION_S):
            self.violate(
                "moves on without enabling",
                f"the arm still moves {since:.2f} s after the enabling device was released",
            )
            self._told = True
