"""The enabling device of set-up mode: the page's key or the foot switch at the tapper's board.

While one of them is held, the arm may move slowly, and the tapper may charge and fire with little
energy. Each device repeats its message while it is held. When the messages end (key released, page
without focus, lost connection, hung process), the motion ends (ISO 10218-1, 5.8.3; ISO 12100,
6.2.11.9).
"""

from __future__ import annotations

import math

from tapping_cell.logic.clock import Now
from tapping_cell.logic.peer_clock import PeerClock
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.messages import ErrorCode, Time

TOPIC = "enabling"
SOURCE = "enabling device released"
"""Source in ``stop_state`` of a stop by the enabling device."""
HEARTBEAT_S = 0.35
"""Message timeout of the enabling device, s. The device counts as released if no message within
this time reports that the device is held."""
RELEASED: CodedError = (
    ErrorCode.ENABLING_RELEASED,
    "set-up mode: no enabling device is held; hold the page's key or the foot switch",
)
STOPPED: CodedError = (
    ErrorCode.ENABLING_RELEASED,
    "set-up mode: the enabling device was released while the arm worked; clear the stop, then hold"
    " it again",
)


class EnablingDevice:
    """State of the key and the switch. Motion is allowed while at least one of the two is held."""

    def __init__(self) -> None:
        self._key_at = self._switch_at = -math.inf
        self._tapper_clock = PeerClock()

    def on_key(self, held: bool, now: Now) -> None:
        """Process a message on the topic ``enabling``."""
        self._key_at = now.steady if held else -math.inf

    def on_switch(self, held: bool, now: Now) -> None:
        """Process the state of the switch that the tapper's board has just reported."""
        self._switch_at = now.steady if held else -math.inf

    def on_reported_switch(self, held: bool, stamp: Time, now: Now) -> None:
        """Process the state of the switch in a message of the tapper's node.

        The switch was held at the time of the message's stamp, so a late or repeated message does
        not count from its arrival, except the first message in 10 s. A message without a stamp does
        not enable motion. If the clock of the tapper's computer is set back, the switch counts as
        released for up to 10 s.
        """
        self._tapper_clock.receive(stamp, now)
        if not held:
            self._switch_at = -math.inf
        elif stamp.sec or stamp.nanosec:
            self._switch_at = max(self._switch_at, self._tapper_clock.to_steady(stamp, now))

    def switch_held(self, now: Now) -> bool:
        """Return whether the switch is held now."""
        return now.steady - self._switch_at <= HEARTBEAT_S

    def held(self, now: Now) -> bool:
        """Return whether a device is held now."""
        return now.steady - max(self._key_at, self._switch_at) <= HEARTBEAT_S
