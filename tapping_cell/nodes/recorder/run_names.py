"""What a run's folder may be called; the recorder and the page hold to the same rule."""

from __future__ import annotations

LONGEST_NAME = 120
"""Bytes in UTF-8: file systems take 255, and the recorder adds a number where a name is taken."""


def is_run_name(name: str) -> bool:
    """Whether a folder of this name, and of no other place, can hold a run."""
    return (
        bool(name)
        and name.isprintable()
        and len(name) <= LONGEST_NAME
        and len(name.encode("utf-8", "replace")) <= LONGEST_NAME
        and "/" not in name
        and not name.startswith(".")
    )
