"""What can go wrong with a device: one exception with a reason to branch on and a sentence to
read."""

from __future__ import annotations

from enum import Enum


class FaultReason(Enum):
    """Why a device call failed; the value is the name used in diagnostics and in the hint table."""

    PORT_MISSING = "port_missing"
    PORT_BUSY = "port_busy"
    DISCONNECTED = "disconnected"
    TIMEOUT = "timeout"
    PROTOCOL = "protocol"
    UNKNOWN_FIRMWARE = "unknown_firmware"
    SETTINGS_MISMATCH = "settings_mismatch"
    BOARD_RESET = "board_reset"
    REJECTED = "rejected"
    ALARM = "alarm"
    STOPPED = "stopped"
    NOT_HOMED = "not_homed"
    HOMING_FAILED = "homing_failed"
    NOT_ENABLED = "not_enabled"
    OUT_OF_RANGE = "out_of_range"
    UNREACHABLE = "unreachable"
    POSITION_MISMATCH = "position_mismatch"
    POSITION_LOST = "position_lost"
    STRIKER_AWAY = "striker_away"
    INTERLOCK = "interlock"
    SHOT_SPENT = "shot_spent"
    NEEDS_PERSON = "needs_person"


class HardwareFault(RuntimeError):
    """A device call that failed; ``reason`` to branch on, ``str()`` is the sentence for people.

    The sentence names the value, the limit and what to do.
    """

    def __init__(self, reason: FaultReason, sentence: str) -> None:
        super().__init__(sentence)
        self.reason = reason

    @property
    def sentence(self) -> str:
        """What happened and what to do, in words."""
        return str(self)
