"""Invariants of the stops of the tapper's boards: the node and its boards know of each other's
stops."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from tapping_cell.messages import ErrorCode, TapperState
from tapping_cell.simulation.fault_layer import Direction
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.verification.scheduler import Scheduler
from tapping_cell.verification.serial_line import SerialLine

NOTICED_S = 1.0
"""Maximum time from a stop at a board until the tapper's node reports it, s."""
PASSED_ON_S = 0.5
"""Maximum time from when the tapper's node keeps and reports a stop until its boards are stopped,
s."""
AT_WORK = (TapperState.SAFE, TapperState.CHARGING, TapperState.CHARGED, TapperState.FIRING)


@dataclass(slots=True)
class BoardChecker:
    """Compares the stops of the tapper's node with those of its boards. Times are in s from the
    start of the run."""

    scheduler: Scheduler
    violate: Callable[[str, str], None]
    boards: Sequence[tuple[TapperEmulator, SerialLine]]
    runs_since: Callable[[], float]
    """Return the time since which the tapper's process has run without a freeze, s."""
    power_lost_at: Callable[[], float]
    """Return the time at which a board last lost its power, s."""
    _stopped_since: list[float] = field(default_factory=list)
    """For each board, the time since which it has been stopped; inf while it is not."""
    _latched_since: float = math.inf
    """Time since which the node has kept a stop; inf while it keeps none."""
    _reported_since: float = math.inf
    """Time since which the node has reported that it is stopped; inf while it does not."""

    def __post_init__(self) -> None:
        self._stopped_since = [math.inf] * len(self.boards)

    def on_tapper_state(self, message: TapperState, latched_since: float) -> None:
        """Process a state that the tapper's node has published. ``latched_since``: time since which
        the node has kept a stop, s; inf while it keeps none."""
        now = self.scheduler.now
        kept = math.isfinite(latched_since)
        self._latched_since = min(self._latched_since, latched_since) if kept else math.inf
        stopped = message.state == TapperState.STOPPED
        self._reported_since = min(self._reported_since, now) if stopped else math.inf
        if message.state == TapperState.FAULT and message.error_code == ErrorCode.TAPPER_STOPPED:
            self.violate("stop reported as a fault", "the tapper reports a stop as a fault")
        for number, (board, line) in enumerate(self.boards):
            is_stopped = board.state == "STOPPED"
            since = min(self._stopped_since[number], now) if is_stopped else math.inf
            self._stopped_since[number] = since
            if not self._is_reached(line):
                continue
            if now > since + NOTICED_S and message.state in AT_WORK:
                self.violate(
                    "stop at the cell not reported",
                    f"a board has been stopped for {now - since:.1f} s, but the tapper reports"
                    f" state {message.state}",
                )
            kept_since = max(self._latched_since, self._reported_since)
            # A board that restarts loses its stop. The node learns of this when it is cleared.
            restarted = max(self.power_lost_at(), line.failed_at)
            lost = restarted > self._latched_since - NOTICED_S
            if now > kept_since + PASSED_ON_S and not is_stopped and not lost:
                self.violate(
                    "board not stopped",
                    f"the tapper's node has kept a stop for {now - kept_since:.1f} s, but its board"
                    f" is in state {board.state}",
                )

    def _is_reached(self, line: SerialLine) -> bool:
        """Return whether the node can reach the board of a line."""
        now = self.scheduler.now
        runs = now > self.runs_since() + NOTICED_S
        disturbed = any(line.layer.disturbs(way) for way in Direction)
        return line.is_open and runs and not line.failed_since(now) and not disturbed
