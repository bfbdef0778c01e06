"""The enabling device of set-up mode: the page's key or the foot switch at the tapper's board.

While one is held the arm may move, slowly, and the tapper may charge and fire, weakly. Each says so
again and again; whatever ends that (released, a page without focus, a lost connection, a process
that hangs) ends the motion (ISO 10218-1, 5.8.3; ISO 12100, 6.2.11.9).
"""

from __future__ import annotations

import math

from tapping_cell.logic.clock import Now
from tapping_cell.logic.tap_commands import Trouble
from tapping_cell.messages import ErrorCode

TOPIC = "enabling"
SOURCE = "enabling device released"
"""What a stop by it is called in ``stop_state``."""
HEARTBEAT_S = 0.35
"""A key or switch that was last heard held this long ago counts as released."""
RELEASED: Trouble = (
    ErrorCode.ENABLING_RELEASED,
    "set-up mode: no enabling device is held; hold the page's key or the foot switch",
)
STOPPED: Trouble = (
    ErrorCode.ENABLING_RELEASED,
    "set-up mode: the enabling device was released while the arm worked; clear the stop, then hold"
    " it again",
)


class EnablingDevice:
    """Both devices; one that is held suffices."""

    def __init__(self) -> None:
        self._key_at = self._switch_at = -math.inf

    def hear_key(self, held: bool, now: Now) -> None:
        """Hear the topic ``enabling``."""
        self._key_at = now.steady if held else -math.inf

    def hear_switch(self, held: bool, now: Now) -> None:
        """Hear of the switch at the tapper's board."""
        self._switch_at = now.steady if held else -math.inf

    def held(self, now: Now) -> bool:
        """Whether a device is held now."""
        return now.steady - max(self._key_at, self._switch_at) <= HEARTBEAT_S
