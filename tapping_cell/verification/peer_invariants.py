"""Invariants of the age of the messages that the tapper has received when it fires."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from tapping_cell.logic.clock import to_seconds
from tapping_cell.messages import Time
from tapping_cell.verification.host import HostClock
from tapping_cell.verification.scheduler import Scheduler

CAMERA = "the camera's topics"
"""All topics from which the tapper estimates the clock of the camera's computer."""
KNOWN_S = 10.0
"""Time for which the tapper uses the delay of a message to estimate another computer's clock, s."""
MARGIN_S = 0.6
"""Additional time after which a delay is certainly not used any more, s."""
BEHIND_S = 0.51
"""Delay of all messages of a node, including the difference of the clocks, with which the tapper
must not fire, s. The limit is 0.5 s."""
IMAGE_S = 0.45
"""Maximum age of the last usable image at the last check before FIRE, s."""
WINDOW_S = 0.1
"""Maximum time from the last check before FIRE to the release, s."""


@dataclass(slots=True)
class PeerChecker:
    """Checks the stamps of the messages that the tapper's process has received. Times are in s from
    the start of the run."""

    scheduler: Scheduler
    violate: Callable[[str, str], None]
    tapper_clock: HostClock
    camera_clock: HostClock
    _behind: dict[str, deque[tuple[float, float, float]]] = field(default_factory=dict)
    """For each topic, and for all topics of the camera together, the messages of the last
    ``KNOWN_S``: time of receipt, time by which the stamp was behind the tapper's clock, and offset
    of this clock."""
    _newest: float = math.inf
    """Exposure of the newest usable image that the tapper's process has received; inf: none."""
    _delays: deque[tuple[float, float, float]] = field(default_factory=deque)
    """Usable images of the last ``KNOWN_S``: time of receipt, time from exposure to receipt, and
    offset of the camera's clock."""

    def on_stamp_received(self, topic: str, stamp: Time) -> None:
        """Process the stamp of a message that the tapper's process has handled. ``topic``: its
        topic, or ``CAMERA``. A stamp of zero belongs to an object that was never measured."""
        if not (stamp.sec or stamp.nanosec):
            return
        now = self.scheduler.now
        behind = 1e-9 * self.tapper_clock.now().ros - to_seconds(stamp)
        known = self._behind.setdefault(topic, deque())
        known.append((now, behind, self.tapper_clock.offset))
        while known[0][0] < now - KNOWN_S - MARGIN_S:
            known.popleft()

    def on_image_received(self, exposed: float) -> None:
        """Process a usable image that the tapper's process has handled; ``exposed``: time of its
        exposure, -inf if it was never exposed."""
        now = self.scheduler.now
        if math.isinf(exposed):
            return
        self._newest = exposed if math.isinf(self._newest) else max(self._newest, exposed)
        self._delays.append((now, now - exposed, self.camera_clock.offset))
        while self._delays[0][0] < now - KNOWN_S - MARGIN_S:
            self._delays.popleft()

    def on_release(self, shot: int) -> None:
        """Check the ages of the messages at a release."""
        now = self.scheduler.now
        for topic, known in self._behind.items():
            recent = [entry for entry in known if entry[0] > now - KNOWN_S - MARGIN_S]
            at_check = [entry for entry in recent if entry[0] < now - WINDOW_S]
            stepped = any(offset != self.tapper_clock.offset for _, _, offset in recent)
            if at_check and not stepped and all(behind > BEHIND_S for _, behind, _ in recent):
                self.violate(
                    "late stamps",
                    f"shot {shot} was released, but all messages on {topic} of the last"
                    f" {KNOWN_S:g} s were more than {BEHIND_S:g} s behind the tapper's clock",
                )
        stepped = any(offset != self.camera_clock.offset for _, _, offset in self._delays)
        if stepped or not self._delays:
            return
        age = now - self._newest - min(delay for _, delay, _ in self._delays)
        if age > IMAGE_S + WINDOW_S:
            self.violate(
                "fired on an old image",
                f"shot {shot} was released {age:.2f} s after the newest image that the tapper had"
                f" received was taken (limit {IMAGE_S + WINDOW_S:g} s)",
            )

    def on_process_lost(self) -> None:
        """Process the end of the tapper's process."""
        self._behind.clear()
        self._delays.clear()
        self._newest = math.inf
