"""Device errors: one exception class with a machine-readable reason and a message for people."""

from __future__ import annotations

from enum import Enum


class FaultReason(Enum):
    """Reason of a failed device call; ``logic/error_codes.py`` maps it to an ``ErrorCode``."""

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
    OTHER_ACTIVE = "other_active"
    INTERLOCK = "interlock"
    SHOT_SPENT = "shot_spent"
    NEEDS_PERSON = "needs_person"


LINE_LOST = (FaultReason.DISCONNECTED, FaultReason.PORT_MISSING, FaultReason.PORT_BUSY)
"""Faults after which the connection is tried again automatically, without action by a person."""


class HardwareFault(RuntimeError):
    """Failed device call. ``reason`` is for decisions in code; ``str()`` returns the message for
    people.

    The message states the value, the limit and what to do.
    """

    def __init__(self, reason: FaultReason, sentence: str) -> None:
        super().__init__(sentence)
        self.reason = reason

    @property
    def sentence(self) -> str:
        """Message that states what happened and what to do."""
        return str(self)
