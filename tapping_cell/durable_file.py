"""Files whose content survives a loss of power."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def replace_text(path: Path, text: str) -> None:
    """Write a text file so that a failure or a loss of power at any moment leaves either the old or
    the new content. The text is first written to ``path`` with a leading dot and ``.part``.

    Raises:
        OSError: the file cannot be written; an existing file is unchanged.
    """
    part = part_of(path)
    with part.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Write the names in a folder to the disk. Otherwise, a loss of power within some seconds may
    give a replaced file its old content again, such as a stop that was stored. File systems without
    this operation are left alone."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def part_of(path: Path) -> Path:
    """Return the path of the incomplete file while ``path`` is being replaced."""
    return path.with_name(f".{path.name}.part")
