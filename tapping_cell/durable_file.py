"""Files whose content survives a loss of power."""

from __future__ import annotations

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


def part_of(path: Path) -> Path:
    """Return the path of the incomplete file while ``path`` is being replaced."""
    return path.with_name(f".{path.name}.part")
