"""Deletion of old runs, if it was asked for, and the list of refused goals."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tapping_cell.nodes.recorder.run_names import is_run_name

STARRED = "starred"
"""A run folder with a file of this name is never deleted."""
NEWEST = 10
"""Number of the newest runs that are never deleted."""
REFUSALS = "refused_goals.jsonl"
LONGEST_LIST = 1_000_000
"""Size in bytes at which the list of refused goals is renamed, replacing the previous one."""
DAY_S = 86_400.0
_DELETED = ".deleted-"


@dataclass(frozen=True, slots=True)
class Retention:
    """Which runs are deleted. With the defaults, none is."""

    most: int
    """Number of runs that are kept if runs are deleted at all."""
    free_share: float = 0.0
    """Share of the disk that is to be free; 0: any."""
    days: float = 0.0
    """Age in days from which runs are deleted; 0: never because of their age."""

    @property
    def deletes(self) -> bool:
        """Whether runs are deleted."""
        return self.free_share > 0 or self.days > 0

    def apply(self, parent: Path, free: Callable[[Path], float] | None = None) -> list[str]:
        """Delete runs until the rules are satisfied, and return their names: the oldest first,
        those that did not reach their goal after all others. Starred and the newest runs stay.

        Raises:
            OSError: the folder cannot be read, or a run cannot be deleted.
        """
        if not self.deletes or not parent.is_dir():
            return []
        free = free or free_share
        for rest in parent.glob(_DELETED + "*"):
            shutil.rmtree(rest)
        runs = sorted(_runs(parent), reverse=True)
        candidates = sorted(
            (not reached, changed, folder)
            for changed, folder, reached in runs[NEWEST:]
            if not (folder / STARRED).exists()
        )
        count, deleted = len(runs), []
        for _, changed, folder in candidates:
            old = self.days > 0 and time.time() - changed > self.days * DAY_S
            if old or count >= self.most or free(parent) < self.free_share:
                # A crash leaves no half of a run behind.
                away = folder.with_name(_DELETED + folder.name)
                folder.rename(away)
                shutil.rmtree(away)
                deleted.append(folder.name)
                count -= 1
        return deleted


def free_share(folder: Path) -> float:
    """Return the free share of the disk of a folder. Raises OSError."""
    usage = shutil.disk_usage(folder)
    return usage.free / usage.total


def _runs(parent: Path) -> Iterator[tuple[float, Path, bool]]:
    """Return time, folder and success of each run. A power cut leaves a bag without a summary; a
    folder with neither is no run."""
    with os.scandir(parent) as entries:
        for entry in entries:
            folder = Path(entry.path)
            if not is_run_name(entry.name) or not entry.is_dir(follow_symlinks=False):
                continue
            summary = folder / "summary.json"
            with contextlib.suppress(OSError):
                if summary.exists():
                    # The outcome is among the first keys. The whole file may be large.
                    with summary.open(encoding="utf-8", errors="replace") as file:
                        reached = '"outcome": "reached"' in file.read(2000)
                    yield summary.stat(follow_symlinks=False).st_mtime, folder, reached
                elif (folder / "bag").is_dir():
                    yield entry.stat(follow_symlinks=False).st_mtime, folder, False


def list_refusal(parent: Path, entry: dict[str, object]) -> None:
    """Append a refused goal to the list in the folder of the runs.

    Raises:
        OSError: the list cannot be written.
    """
    parent.mkdir(parents=True, exist_ok=True)
    path = parent / REFUSALS
    if path.exists() and path.stat().st_size > LONGEST_LIST:
        path.replace(path.with_suffix(".old.jsonl"))
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry, ensure_ascii=False) + "\n")
