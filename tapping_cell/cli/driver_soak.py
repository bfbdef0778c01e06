"""Hours of taps over bad lines in the emulated devices' own time: does anything grow?"""

from __future__ import annotations

import gc
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

from tapping_cell.cli.fault_trials import Dialect, TrialCell

MARKS = 4
"""Looks at memory, evenly over the hours; the first is the base."""
ALLOWED_BLOCKS = 1000
"""Blocks of Python's allocator between the first look and the last: caches that still fill."""
ALLOWED_RESIDENT = 2_000_000
"""The same of resident memory, bytes: fragments of the allocator's arenas."""


@dataclass(frozen=True, slots=True)
class Soak:
    """One dialect's run."""

    dialect: str
    hours: float
    taps: int
    blocks: tuple[int, ...]
    """Blocks of Python's allocator in use at each look, after the witness has forgotten its
    records."""
    resident: tuple[int, ...]
    """Resident memory at each look, bytes."""
    threads: tuple[int, int]
    """At the first look and at the last."""
    descriptors: tuple[int, int]
    clean: bool
    """Nothing fired twice or unsafely, nothing hung, every report true."""

    @property
    def steady(self) -> bool:
        """Whether nothing grew."""
        return (
            self.blocks[-1] - self.blocks[0] <= ALLOWED_BLOCKS
            and self.resident[-1] - self.resident[0] <= ALLOWED_RESIDENT
            and self.threads[0] == self.threads[1]
            and self.descriptors[0] == self.descriptors[1]
        )


def soak(dialect: Dialect, hours: float, seed: int) -> Soak:
    """Tap over bad lines for ``hours`` of the devices' time."""
    cell = TrialCell(dialect, seed)
    taps = 0
    looks: list[tuple[int, int, int, int]] = []
    for mark in range(1, MARKS + 1):
        while cell.clock.now < 3600 * hours * mark / MARKS:
            cell.plan_faults()
            cell.tap()
            taps += 1
        cell.check_reports()
        cell.forget()
        gc.collect()
        looks.append(
            (
                sys.getallocatedblocks(),
                int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"),
                threading.active_count(),
                len(os.listdir("/proc/self/fd")),
            )
        )
    blocks, resident, threads, descriptors = zip(*looks, strict=True)
    return Soak(
        dialect.value,
        round(cell.clock.now / 3600, 3),
        taps,
        blocks,
        resident,
        (threads[0], threads[-1]),
        (descriptors[0], descriptors[-1]),
        cell.tally.clean,
    )
