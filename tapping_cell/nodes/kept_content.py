"""Small records that a node stores on disk, so that they survive a crash: the goal, a stop."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

from tapping_cell.durable_file import part_of, replace_text
from tapping_cell.logic.effects import Content

BOOT = "\nboot"
"""Key of the start of the computer in which the content was stored. It is not printable, so no name
of a goal is equal to it."""


def boot_id() -> str:
    """Return an id of this start of the computer; empty if the system has none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""


class KeptContent:
    """One JSON file. The age of the file is the time since its last change or touch."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def keep(self, content: Content | None) -> None:
        """Write the content. A power loss at any moment leaves either the old or the new content.
        None removes the file. Raises OSError."""
        if content is None:
            self._path.unlink(missing_ok=True)
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        replace_text(self._path, json.dumps({**content, BOOT: boot_id()}))

    def require_writable(self) -> None:
        """Raise OSError if content could not be stored."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        part = part_of(self._path)
        part.write_text("{}", encoding="utf-8")
        part.unlink()

    def touch(self) -> None:
        """Reset the age of the file if it exists. Raises OSError."""
        if self._path.exists():
            os.utime(self._path)

    def recall(self) -> Content | None:
        """Return the stored content: None if there is no file, empty if it is unreadable."""
        found = self._read()
        return found and {key: value for key, value in found.items() if key != BOOT}

    def is_of_earlier_boot(self) -> bool:
        """Return whether the computer was started again since the content was stored."""
        return bool((self._read() or {}).get(BOOT, boot_id()) != boot_id())

    def _read(self) -> dict[str, Any] | None:
        try:
            found: Any = json.loads(self._path.read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    def age(self) -> float:
        """Return the seconds since the last change or touch. Raises OSError if there is no file."""
        return time.time() - self._path.stat().st_mtime
