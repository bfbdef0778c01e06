"""Time that the host passes to the state machines."""

from __future__ import annotations

from dataclasses import dataclass

from tapping_cell.messages import Time

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Now:
    """Present time on both clocks of a host. The host reads ``steady`` first."""

    steady: float
    """Time of the host's steady clock, s. The host's drivers use the same clock."""
    ros: int
    """ROS time of the host, for comparison with stamps and expiries, ns."""


def to_nanoseconds(stamp: Time) -> int:
    """Convert a stamp to ns."""
    return stamp.sec * NANOSECONDS + stamp.nanosec


def to_seconds(stamp: Time) -> float:
    """Convert a stamp to s."""
    return stamp.sec + 1e-9 * stamp.nanosec


def to_stamp(nanoseconds: int) -> Time:
    """Convert a time in ns to a stamp."""
    sec, nanosec = divmod(nanoseconds, NANOSECONDS)
    return Time(sec=sec, nanosec=nanosec)
