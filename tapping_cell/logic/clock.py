"""Time as the machines get it from their host."""

from __future__ import annotations

from dataclasses import dataclass

from tapping_cell.messages import Time

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Now:
    """One moment on both clocks of a host. The host reads ``steady`` first."""

    steady: float
    """s, the host's steady clock: also the clock of its drivers."""
    ros: int
    """ns, the host's ROS time: what stamps and expiries are compared with."""


def to_nanoseconds(stamp: Time) -> int:
    """A stamp in ns."""
    return stamp.sec * NANOSECONDS + stamp.nanosec


def to_seconds(stamp: Time) -> float:
    """A stamp in s."""
    return stamp.sec + 1e-9 * stamp.nanosec


def to_stamp(nanoseconds: int) -> Time:
    """A time in ns as a stamp."""
    sec, nanosec = divmod(nanoseconds, NANOSECONDS)
    return Time(sec=sec, nanosec=nanosec)
