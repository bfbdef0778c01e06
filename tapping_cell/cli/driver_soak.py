"""Soak test: hours of taps over faulty serial lines in simulated time, to detect memory growth."""

from __future__ import annotations

import gc
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

from tapping_cell.cli.fault_trials import Dialect, TrialCell

MARKS = 4
"""Number of memory measurements, evenly spaced over the run. The first is the reference."""
ALLOWED_BLOCKS = 1000
"""Maximum increase in the number of memory blocks that Python has allocated, from the first to the
last measurement. Some increase is normal, because caches fill up."""
ALLOWED_RESIDENT = 2_000_000
"""Maximum increase of the resident memory in bytes. Some increase is normal, because the memory of
the allocator becomes fragmented."""


@dataclass(frozen=True, slots=True)
class Soak:
    """Result for one dialect."""

    dialect: str
    hours: float
    taps: int
    blocks: tuple[int, ...]
    """Allocated blocks of Python at each measurement, after the test has discarded its own
    records."""
    resident: tuple[int, ...]
    """Resident memory in bytes at each measurement."""
    threads: tuple[int, int]
    """Number of threads at the first and at the last measurement."""
    descriptors: tuple[int, int]
    clean: bool
    """Whether nothing was fired twice or unsafely, nothing hung, and every report was true."""

    @property
    def steady(self) -> bool:
        """Whether memory grew within the limits, and threads and file descriptors did not
        change."""
        return (
            self.blocks[-1] - self.blocks[0] <= ALLOWED_BLOCKS
            and self.resident[-1] - self.resident[0] <= ALLOWED_RESIDENT
            and self.threads[0] == self.threads[1]
            and self.descriptors[0] == self.descriptors[1]
        )


def soak(dialect: Dialect, hours: float, seed: int) -> Soak:
    """Make taps over faulty serial lines for ``hours`` of simulated time."""
    cell = TrialCell(dialect, seed)
    taps = 0
    samples: list[tuple[int, int, int, int]] = []
    for mark in range(1, MARKS + 1):
        while cell.clock.now < 3600 * hours * mark / MARKS:
            cell.plan_faults()
            cell.tap()
            taps += 1
        cell.check_reports()
        cell.forget()
        gc.collect()
        samples.append(
            (
                sys.getallocatedblocks(),
                int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"),
                threading.active_count(),
                len(os.listdir("/proc/self/fd")),
            )
        )
    blocks, resident, threads, descriptors = zip(*samples, strict=True)
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
