"""Small contents that a node keeps on disk over a crash: the goal under way, a stop."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

from tapping_cell.logic.effects import Content


class KeptContent:
    """One JSON file; its age is that of its last change or touch."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def keep(self, content: Content | None) -> None:
        """Write it, surviving a loss of power at any moment; None removes it. Raises OSError."""
        if content is None:
            self._path.unlink(missing_ok=True)
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        part = self._path.with_suffix(".part")
        with part.open("w", encoding="utf-8") as file:
            json.dump(dict(content), file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(self._path)

    def touch(self) -> None:
        """Make it young again, where there is one. Raises OSError."""
        if self._path.exists():
            os.utime(self._path)

    def recall(self) -> Content | None:
        """What was kept; None where nothing was, empty where it cannot be read."""
        try:
            found: Any = json.loads(self._path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    def age(self) -> float:
        """Seconds since the last change or touch; raises OSError where there is none."""
        return time.time() - self._path.stat().st_mtime
