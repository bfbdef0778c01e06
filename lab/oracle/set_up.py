"""Oracle of set-up mode: nothing moves or fires unless a person holds an enabling device."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from lab.virtual_cell.physical_cell import PhysicalCell, Release
from lab.virtual_cell.scheduler import Scheduler

HEARTBEAT_S = 0.35
"""Time after the last message of the key from which the key counts as released."""
SWITCH_S = 0.5
"""Maximum time from the release of the switch until the tapper's node counts it as released."""
REPORTED_S = 1.0
"""Maximum time from the release of the switch until the arm's node counts it as released."""
WINDOW_S = 0.1
"""Longest firing window of the board."""
BEGIN_S, STOP_S = 0.2, 1.5
"""Maximum times from the release until the arm begins no motion, and until it is at rest."""
SPEED = 0.25
"""Maximum speed in set-up mode, as a fraction of the maximum joint speeds."""
ENERGY_J, ENERGY_SHARE = 0.005, 0.03
"""Maximum energy of a shot while the switch is not held, and the tolerance of this energy."""
ROUNDING = 1e-6
"""Tolerance for the rounding of times (s) and of speeds (fraction)."""


@dataclass(slots=True)
class SetUpOracle:
    """Checks set-up mode. Times are in s from the start of the run.

    ``arm_runs_since``: time since which the arm's node runs, connected and without a freeze; inf
    while it does not. ``tapper_frozen_until``: end of the last freeze of the tapper's process.
    """

    scheduler: Scheduler
    physical: PhysicalCell
    violate: Callable[[str, str], None]
    arm_runs_since: Callable[[], float]
    tapper_frozen_until: Callable[[], float]
    _key: dict[str, float] = field(default_factory=dict)
    """Time until which each process counts the key as held."""
    _switch_until: float = math.inf
    """Time of the release of the switch; inf while it is held."""
    _lapsed: bool = False
    _commanded_until: float = -math.inf
    """Time by which the arm's line has delivered what was sent before the release."""
    _moves: bool = False

    def on_key(self, process: str, held: bool) -> None:
        """Record a message of the key that a process has handled."""
        now = self.scheduler.now
        before = self._key.get(process, -math.inf)
        self._key[process] = max(before, now + HEARTBEAT_S) if held else min(before, now)

    def on_switch(self, held: bool) -> None:
        """Record that a person holds or releases the switch at the tapper's board."""
        self._switch_until = math.inf if held else self.scheduler.now

    def check_release(self, release: Release) -> None:
        """Check that a device was held, and that the energy was small without the switch."""
        enabled = max(self._key.get("tapper_trigger", -math.inf), self._switch_until + SWITCH_S)
        if release.time > enabled + WINDOW_S:
            self.violate(
                "fired without enabling",
                f"shot {release.shot} was released {release.time - enabled:.3f} s after the"
                " enabling device was released",
            )
        limit = (1.0 + ENERGY_SHARE) * ENERGY_J
        if release.energy > limit and release.time > self._switch_until + ROUNDING:
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
        now, before = self.scheduler.now, self._moves
        self._moves = self.physical.moving(now)
        switch = max(self._switch_until, self.tapper_frozen_until()) + REPORTED_S
        end = max(self._key.get("scara_arm", -math.inf), switch)
        if now <= end:
            self._lapsed = False
            return
        if not self._lapsed:
            self._lapsed = True
            self._commanded_until = self.physical.arm_line.layer.delivered_by(now)
        since = now - max(end, self.arm_runs_since())
        if not self._moves or since <= BEGIN_S:
            return
        if since > STOP_S or (not before and now > self._commanded_until + ROUNDING):
            self.violate(
                "moved without enabling",
                f"the arm moves {since:.2f} s after the enabling device was released",
            )
