"""Validity rule for run folder names, shared by the recorder and the page."""

from __future__ import annotations

STARRED = "starred"
"""A run folder with a file of this name is never deleted."""
LONGEST_NAME = 120
"""Maximum length in bytes of UTF-8. This limit is well below the 255 bytes that file systems allow,
because the recorder appends a number if the name is taken."""


def is_run_name(name: str) -> bool:
    """Return whether this name is valid for a run folder and cannot refer to another folder."""
    return (
        bool(name)
        and name.isprintable()
        and len(name) <= LONGEST_NAME
        and len(name.encode("utf-8", "replace")) <= LONGEST_NAME
        and "/" not in name
        and not name.startswith(".")
    )
