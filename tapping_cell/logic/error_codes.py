"""Mapping from the reasons of hardware faults to the numbers of ``ErrorCode``."""

from __future__ import annotations

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.messages import ErrorCode

_ARM = {
    FaultReason.PORT_MISSING: ErrorCode.ARM_NOT_CONNECTED,
    FaultReason.PORT_BUSY: ErrorCode.ARM_NOT_CONNECTED,
    FaultReason.DISCONNECTED: ErrorCode.ARM_NOT_CONNECTED,
    FaultReason.TIMEOUT: ErrorCode.ARM_TIMEOUT,
    FaultReason.PROTOCOL: ErrorCode.ARM_REPLY_GARBLED,
    FaultReason.UNKNOWN_FIRMWARE: ErrorCode.ARM_FIRMWARE_UNKNOWN,
    FaultReason.SETTINGS_MISMATCH: ErrorCode.CONFIGURATION_CONFLICT,
    FaultReason.BOARD_RESET: ErrorCode.ARM_NOT_HOMED,
    FaultReason.REJECTED: ErrorCode.ARM_ALARM,
    FaultReason.ALARM: ErrorCode.ARM_ALARM,
    FaultReason.NEEDS_PERSON: ErrorCode.ARM_ALARM,
    FaultReason.STOPPED: ErrorCode.ARM_STOPPED,
    FaultReason.NOT_HOMED: ErrorCode.ARM_NOT_HOMED,
    FaultReason.HOMING_FAILED: ErrorCode.ARM_NOT_HOMED,
    FaultReason.OUT_OF_RANGE: ErrorCode.ARM_JOINT_LIMIT,
    FaultReason.UNREACHABLE: ErrorCode.ARM_OUT_OF_REACH,
    FaultReason.POSITION_MISMATCH: ErrorCode.ARM_POSITION_MISMATCH,
    FaultReason.POSITION_LOST: ErrorCode.ARM_POSITION_MISMATCH,
}
_TAPPER = {
    FaultReason.PORT_MISSING: ErrorCode.TAPPER_NOT_CONNECTED,
    FaultReason.PORT_BUSY: ErrorCode.TAPPER_NOT_CONNECTED,
    FaultReason.DISCONNECTED: ErrorCode.TAPPER_NOT_CONNECTED,
    FaultReason.TIMEOUT: ErrorCode.TAPPER_TIMEOUT,
    FaultReason.PROTOCOL: ErrorCode.TAPPER_REPLY_GARBLED,
    FaultReason.UNKNOWN_FIRMWARE: ErrorCode.TAPPER_FIRMWARE_UNKNOWN,
    FaultReason.BOARD_RESET: ErrorCode.TAPPER_RESET,
    FaultReason.REJECTED: ErrorCode.TAPPER_FAULT,
    FaultReason.STOPPED: ErrorCode.TAPPER_STOPPED,
    FaultReason.OUT_OF_RANGE: ErrorCode.TAPPER_SPEED_OUT_OF_RANGE,
    FaultReason.NOT_ENABLED: ErrorCode.ENABLING_RELEASED,
    FaultReason.INTERLOCK: ErrorCode.TAPPER_INTERLOCK_OPEN,
    FaultReason.SHOT_SPENT: ErrorCode.TAPPER_SPENT,
    FaultReason.NEEDS_PERSON: ErrorCode.TAPPER_STOPPED,
    FaultReason.HOMING_FAILED: ErrorCode.TAPPER_FAULT,
    FaultReason.POSITION_LOST: ErrorCode.TAPPER_FAULT,
    FaultReason.STRIKER_AWAY: ErrorCode.TAPPER_STRIKER_AWAY,
    FaultReason.OTHER_ACTIVE: ErrorCode.TAPPER_OTHER_ACTIVE,
    FaultReason.SETTINGS_MISMATCH: ErrorCode.CONFIGURATION_CONFLICT,
}


def of_arm(fault: HardwareFault) -> int:
    """Return the error code of a fault of the arm."""
    return _ARM.get(fault.reason, ErrorCode.INTERNAL)


def of_tapper(fault: HardwareFault) -> int:
    """Return the error code of a fault of the tapper."""
    return _TAPPER.get(fault.reason, ErrorCode.INTERNAL)
