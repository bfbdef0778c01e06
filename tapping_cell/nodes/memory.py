"""Memory that a process keeps and returns."""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt(3): M_TRIM_THRESHOLD and M_MMAP_THRESHOLD from glibc's malloc.h."""
_KEPT = 64 * 1024 * 1024
_LARGEST = 32 * 1024 * 1024
"""``_KEPT`` is the trim threshold (free memory to keep) and ``_LARGEST`` the mmap threshold (the
maximum that glibc accepts), both in bytes."""


def keep_memory() -> None:
    """Keep up to 64 MB of freed memory in the process. Call once at the start of the process.

    By default, glibc returns an image's memory to the kernel as soon as it is freed. Each new image
    then needs about a thousand newly zeroed pages. Providing these pages takes half of the time
    that is needed to receive an image. With another C library, the function does nothing.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGEST)
        mallopt(_TRIM_THRESHOLD, _KEPT)


def release_memory() -> None:
    """Return the freed memory to the kernel. Call once after the start, which needs more memory
    than the rest of the run. With another C library, the function does nothing."""
    malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if malloc_trim is not None:
        malloc_trim(0)
