"""Mapping from the error code of a goal to the injected faults that explain it.

The error code must name a true cause. A fault of one device does not explain a code of the other
device. Kinds of faults that can affect both devices are therefore recorded with the name of the
affected device or node. If none of the faults that explain the code can still act, the cell has
reported a wrong cause; this counts as a violation.
"""

from __future__ import annotations

from collections.abc import Iterable

from tapping_cell.messages import ErrorCode

BRIEFLY_OPEN = "guard open briefly"
"""Kind of fault: the guard is opened so briefly that the tapper's node may not notice it. The board
may discharge because of the open guard without reporting this reason."""
BRIEFLY_RELEASED = "enabling switch released briefly"
"""Kind of fault: the switch is released so briefly that the tapper's node may not notice it."""
AT_ONCE_S = 10.0
"""Maximum time from the end of a fault to the end of a goal, if the planner does not wait before it
ends the goal (see ``WAITS_S``). This maximum allows for a planner that is frozen for 5 s and for a
late message."""
LASTING_S = {
    "freeze": 5.0,
    "freeze before a write": 8.0,
    "freeze at a write": 3.0,
    "freeze after the last check": 3.0,
    "kill": 30.0,
    "end of scara_arm": 30.0,
    "end of tapper_trigger": 30.0,
    "end of tap_planner": 30.0,
    "restart": 10.0,
    "deactivate": 5.0,
    "slow topic": 8.0,
    "slow answer": 12.0,
    "duplicates": 8.0,
    "foreign command": 30.0,
    "foreign trajectory": 10.0,
    "unreported trajectory": 10.0,
    "second node": 20.0,
    "second arm": 6.0,
    "clock step": 40.0,
    "serial line of the arm": 20.0,
    "serial line of the tapper": 20.0,
    "line at a shot": 8.0,
    "cable at a shot": 3.0,
    "loss of power of the arm": 4.0,
    "loss of power of the tapper": 4.0,
    "power at a shot": 2.0,
    "motors off at the arm": 4.0,
    "motors off at the tapper": 4.0,
    "camera": 8.0,
    "object moved": 2.0,
    "unknown object": 60.0,
    "object turned": 2.0,
    "object creeps": 2.0,
    "other object moved": 2.0,
    "other object turned": 2.0,
    "other object hidden": 4.0,
    "other object removed": 60.0,
    "late object states": 8.0,
    "emergency stop": 5.0,
    "guard": 4.0,
    BRIEFLY_OPEN: 0.3,
    BRIEFLY_RELEASED: 0.3,
    "enabling device released": 5.0,
    "enabling messages delayed": 8.0,
    "late answer": 20.0,
    "no answer": 15.0,
    "ask changed": 8.0,
}
"""Maximum time for which a fault of each kind has an effect, s; 0 for kinds that are not listed.
Depending on the kind, this time includes the restart of a process, the time until a foreign command
expires, or the time until the line transmits the byte at which it fails."""

FREEZES = frozenset(
    {
        "freeze",
        "freeze at a shot",
        "freeze before a write",
        "freeze at a write",
        "freeze after the last check",
    }
)
ENDS = frozenset({"kill", "restart"})
LINKS = frozenset({"slow topic", "slow answer", "received by one", "duplicates"})
FOREIGN = frozenset(
    {
        "replay",
        "foreign command",
        "foreign withdrawal",
        "foreign outcome",
        "foreign hold",
        "foreign flood",
        "foreign state",
        "repeated command",
        "second node",
    }
)
ARM_LINE = frozenset({"serial line of the arm"})
TAPPER_LINE = frozenset({"serial line of the tapper", "line at a shot", "cable at a shot"})
LINES = ARM_LINE | TAPPER_LINE
ARM_POWER = frozenset({"loss of power of the arm", "motors off at the arm"})
TAPPER_POWER = frozenset(
    {"loss of power of the tapper", "power at a shot", "motors off at the tapper"}
)
POWER = ARM_POWER | TAPPER_POWER
ARM_ENDS, TAPPER_ENDS = frozenset({"end of scara_arm"}), frozenset({"end of tapper_trigger"})
ARM_EXCEPTION = "exception in scara_arm"
EXCEPTIONS = frozenset({"exception in tap_planner", ARM_EXCEPTION, "exception in tapper_trigger"})
ARM_STOPS = frozenset({"emergency stop", "stop of scara_arm"})
TAPPER_STOPS = frozenset({"emergency stop", "stop of tapper_trigger"})
DELAYS = FREEZES | ENDS | LINKS | LINES | {"deactivate", "second node"}
"""Kinds of faults that delay or suppress messages."""
COVERED = "the arm covers the object"
"""Condition that is not an injected fault but can also explain an error code of a goal."""
KEY_ONLY = "the person of set-up mode holds only the key"
"""Condition in which the tapper's board refuses more than its set-up energy."""
SHORT_TIME_LIMIT = "the goal has a short time limit"
FEW_TAPS = "the goal may have only a few taps"
SWITCH_UNKNOWN = (
    ENDS | LINKS | TAPPER_LINE | TAPPER_POWER | FOREIGN | TAPPER_ENDS | {"deactivate", "clock step"}
)
"""Kinds of faults after which arm or tapper may not know that the enabling switch is held: the
board reports it to the tapper's node, and this node to the arm, which needs the time of the report.
The key does not depend on them."""
UNANSWERED = frozenset({"no answer", "late answer"})
CAMERA = frozenset({"camera", "object moved", "object turned", "object creeps"})

EXPLAINED_BY: dict[int, frozenset[str]] = {
    ErrorCode.GOAL_REPLACED: frozenset({"second client", "second node"}),
    ErrorCode.GOAL_CANCELED: frozenset({"cancel"}),
    ErrorCode.NOT_ACTIVE: frozenset({"deactivate", "restart", "kill"}),
    ErrorCode.EMERGENCY_STOP: frozenset({"emergency stop"}),
    ErrorCode.ARM_STOPPED: ARM_STOPS | ARM_LINE,
    ErrorCode.TAPPER_STOPPED: TAPPER_STOPS | TAPPER_LINE,
    ErrorCode.ARM_NOT_HOMED: ARM_STOPS
    | ARM_LINE
    | ARM_POWER
    | ARM_ENDS
    | FREEZES
    | {ARM_EXCEPTION},
    ErrorCode.CONFIGURATION_CONFLICT: frozenset(
        {"second arm", "foreign state", "foreign flood", "replay"}
    ),
    ErrorCode.ARM_NOT_CONNECTED: ARM_LINE | ARM_POWER | ARM_ENDS | {"second node"},
    ErrorCode.ARM_FIRMWARE_UNKNOWN: ARM_LINE | ARM_POWER | ARM_ENDS,
    ErrorCode.ARM_ALARM: ARM_LINE | ARM_POWER | FREEZES,
    ErrorCode.ARM_REPLY_GARBLED: ARM_LINE,
    # A withdrawal that arrives just before a tap begins a motion, so the arm refuses the tap.
    ErrorCode.ARM_TIMEOUT: DELAYS
    | POWER
    | {"foreign trajectory", "unreported trajectory", "foreign withdrawal"},
    # Grbl's lines have no checksum: a changed digit of a move line truly moves the arm elsewhere.
    ErrorCode.ARM_POSITION_MISMATCH: ARM_LINE | ARM_POWER | FREEZES,
    ErrorCode.ARM_SILENT: FREEZES | ENDS | LINKS,
    ErrorCode.ARM_BUSY: DELAYS | FOREIGN | {"foreign trajectory", "unreported trajectory"},
    ErrorCode.ARM_COMMAND_EXPIRED: DELAYS | FOREIGN | {"clock step"},
    ErrorCode.TAPPER_NOT_CONNECTED: TAPPER_LINE | TAPPER_POWER | TAPPER_ENDS | {"second node"},
    ErrorCode.TAPPER_FIRMWARE_UNKNOWN: TAPPER_LINE | TAPPER_POWER | TAPPER_ENDS,
    ErrorCode.TAPPER_REPLY_GARBLED: TAPPER_LINE,
    ErrorCode.TAPPER_TIMEOUT: TAPPER_LINE | TAPPER_POWER | FREEZES | {"slow topic"},
    ErrorCode.TAPPER_RESET: TAPPER_LINE | TAPPER_POWER,
    # A board discharges automatically if it receives nothing for 0.5 s, or if its guard was opened
    # or its enabling switch released briefly.
    ErrorCode.TAPPER_FAULT: TAPPER_LINE | TAPPER_POWER | FREEZES | {BRIEFLY_OPEN, BRIEFLY_RELEASED},
    ErrorCode.TAPPER_INTERLOCK_OPEN: frozenset({"guard"}),
    ErrorCode.TAPPER_SILENT: FREEZES | ENDS | LINKS,
    ErrorCode.TAPPER_SPENT: FOREIGN | ENDS | {"clock step"},
    ErrorCode.TAPPER_COMMAND_EXPIRED: DELAYS | FOREIGN | {"clock step"},
    ErrorCode.TAPPER_ARM_NOT_IN_POSITION: DELAYS | FOREIGN | POWER,
    ErrorCode.TAPPER_BUSY: DELAYS | FOREIGN,
    ErrorCode.COMMAND_REPEATED: FOREIGN | {"clock step"},
    ErrorCode.STAMP_INVALID: frozenset({"clock step", "second node", "camera"}),
    ErrorCode.CAMERA_NOT_CALIBRATED: frozenset({"camera"}),
    ErrorCode.IMAGE_INVALID: frozenset({"camera"}),
    ErrorCode.TRAJECTORY_INVALID: frozenset({"invalid trajectory"}),
    ErrorCode.CLOCKS_DIFFER: frozenset({"clock step"}) | LINKS | FREEZES,
    ErrorCode.OBJECT_NOT_SEEN: CAMERA | {COVERED},
    ErrorCode.OBJECT_MOVED: CAMERA,
    ErrorCode.OBJECT_NOT_AT_REST: CAMERA,
    ErrorCode.TOO_FEW_FRAMES: CAMERA | FREEZES | LINKS | ENDS,
    ErrorCode.CAMERA_SILENT: FREEZES | ENDS | LINKS | {"camera", "clock step"},
    ErrorCode.NOT_READY: DELAYS | FOREIGN,
    ErrorCode.DEADLINE_EXCEEDED: DELAYS
    | FOREIGN
    | POWER
    | CAMERA
    | UNANSWERED
    | {"clock step", "guard", "reject", SHORT_TIME_LIMIT},
    ErrorCode.ENABLING_RELEASED: FREEZES
    | SWITCH_UNKNOWN
    | {"enabling device released", "enabling messages delayed", KEY_ONLY},
    ErrorCode.INTERNAL: EXCEPTIONS,
    ErrorCode.TAP_NOT_CONFIRMED: UNANSWERED,
    ErrorCode.TAP_WITHOUT_EFFECT: CAMERA | POWER,
    ErrorCode.TAP_LIMIT_REACHED: CAMERA | FOREIGN | {FEW_TAPS},
    ErrorCode.TAP_WITHOUT_ROTATION: CAMERA | FOREIGN,
}
"""For each error code of a goal, the kinds of faults that can cause this code. When a goal ends
with the code, at least one fault of these kinds must have been injected."""
CONDITIONS = frozenset(
    {
        ErrorCode.NONE,
        ErrorCode.NO_TAP_FOUND,
        ErrorCode.NO_CONTACT_FOUND,
        ErrorCode.PROBE_NEEDED,
        ErrorCode.OBJECT_OFF_TABLE,
        ErrorCode.GOAL_OFF_TABLE,
        ErrorCode.GOAL_OUT_OF_REACH,
        ErrorCode.ARM_OUT_OF_REACH,
    }
)
"""Codes caused by the poses of object and goal, not by a fault."""


READY_S = 30.0
"""Time for which the planner waits until the cell is ready. After this time a goal ends with the
error code of the part that is not ready."""
WAITS_S = {
    **dict.fromkeys(
        (
            ErrorCode.GOAL_REPLACED,
            ErrorCode.GOAL_CANCELED,
            ErrorCode.EMERGENCY_STOP,
            ErrorCode.STAMP_INVALID,
            ErrorCode.OBJECT_MOVED,
        ),
        0.0,
    ),
    ErrorCode.OBJECT_NOT_SEEN: 10.0,
    ErrorCode.OBJECT_NOT_AT_REST: 10.0,
    ErrorCode.TOO_FEW_FRAMES: 10.0,
    ErrorCode.TAP_LIMIT_REACHED: 60.0,
    ErrorCode.DEADLINE_EXCEEDED: 120.0,
}
"""Time for which the planner waits before it ends a goal with each of these codes, s; ``READY_S``
for codes that are not listed."""


def longest_effect(kind: str, code: int) -> float:
    """Return the maximum time from a fault to the end of a goal with this code, s."""
    return LASTING_S.get(kind, 0.0) + WAITS_S.get(code, READY_S) + AT_ONCE_S


def explains(code: int, struck: Iterable[str]) -> bool:
    """Return whether one of the injected kinds of faults, ``struck``, explains this code."""
    if code in CONDITIONS:
        return True
    return not EXPLAINED_BY.get(code, frozenset()).isdisjoint(struck)
