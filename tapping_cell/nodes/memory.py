"""How a process that handles pictures keeps its memory."""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Of mallopt(3): M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of glibc's malloc.h."""
_KEPT = 64 * 1024 * 1024
_LARGEST = 32 * 1024 * 1024
"""Bytes of free memory that are kept, and of the largest piece that is (glibc's own greatest)."""


def keep_memory() -> None:
    """Have freed memory stay with the process, up to 64 MB: to be called once, at its start.

    Otherwise glibc gives a picture's megabytes back to the kernel when they are freed, and every
    picture meets some thousand pages that must be cleared anew: half of what it costs to receive
    it. Does nothing with another C library.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGEST)
        mallopt(_TRIM_THRESHOLD, _KEPT)
