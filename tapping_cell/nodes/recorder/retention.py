"""Deletion of old runs, if it was asked for, and the list of refused goals."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tapping_cell.nodes.computer import disk_space
from tapping_cell.nodes.recorder.run_names import STARRED, is_run_name
from tapping_cell.report.run_reader import NOTES

NEWEST = 10
"""Number of the newest runs that are never deleted."""
MOST_DELETED = 20
"""Maximum number of runs that are deleted at once."""
MOST_USELESS = 3
"""Number of deletions without more free space after which none is made for the sake of space:
another program fills the disk, or its file system frees space later."""
BAG_FILE = "bag/bag.mcap"
REFUSALS = "refused_goals.jsonl"
LONGEST_LIST = 1_000_000
"""Size in bytes at which the list of refused goals is renamed, replacing the previous one."""
DAY_S = 86_400.0
_DELETED = ".deleted-"


@dataclass(slots=True)
class Deletion:
    """What was deleted, and what was not."""

    deleted: list[str] = field(default_factory=list)
    """Names of the deleted runs."""
    failed: list[str] = field(default_factory=list)
    """Names of the folders that could not be deleted, with the reason."""
    useless: bool = False
    """Whether the deletions did not free the disk, so that they were stopped."""

    def remove(self, folder: Path) -> bool:
        """Remove a folder that was renamed for its deletion; return whether it is gone. A symbolic
        link is not followed."""
        if folder.is_symlink() or not folder.is_dir():
            return False
        try:
            shutil.rmtree(folder)
        except OSError as error:
            self.failed.append(f"{folder.name} ({error.strerror})")
            return False
        return True


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

    def apply(self, parent: Path, free: Callable[[Path], float] | None = None) -> Deletion:
        """Delete runs until the rules are satisfied: the oldest first, those that did not reach
        their goal after all others. Starred and the newest runs stay. What cannot be deleted is
        skipped.

        Raises:
            OSError: the folder cannot be read.
        """
        done = Deletion()
        if not self.deletes or not parent.is_dir():
            return done
        free = free or (lambda folder: disk_space(folder)[1])
        for rest in parent.glob(_DELETED + "*"):
            done.remove(rest)
        runs = sorted(_runs(parent), reverse=True)
        candidates = sorted(
            (not reached, changed, folder)
            for changed, folder, reached in runs[NEWEST:]
            if not (folder / STARRED).exists()
        )
        count, attempts, useless = len(runs), 0, 0
        for _, changed, folder in candidates:
            if attempts >= MOST_DELETED:
                break
            before = free(parent)
            old = self.days > 0 and time.time() - changed > self.days * DAY_S
            surplus = count >= self.most
            full = before < self.free_share and not done.useless
            if not (old or surplus or full):
                continue
            attempts += 1
            # A crash leaves no half of a run behind.
            away = folder.with_name(_DELETED + folder.name)
            try:
                folder.rename(away)
            except OSError as error:
                done.failed.append(f"{folder.name} ({error.strerror})")
                continue
            count -= 1
            if done.remove(away):
                done.deleted.append(folder.name)
            if full and free(parent) <= before:
                useless += 1
                done.useless = useless >= MOST_USELESS
        return done


def count_runs(parent: Path) -> int:
    """Return the number of runs in a folder. Raises OSError."""
    return sum(1 for _ in _runs(parent))


def _runs(parent: Path) -> Iterator[tuple[float, Path, bool]]:
    """Return time, folder and success of each run. A run has a summary or a bag of the recorder: a
    power cut leaves a bag without a summary. Any other folder is no run, whatever its name."""
    with os.scandir(parent) as entries:
        for entry in entries:
            folder = Path(entry.path)
            if not is_run_name(entry.name) or not entry.is_dir(follow_symlinks=False):
                continue
            summary = folder / "summary.json"
            with contextlib.suppress(OSError):
                start = ""
                if summary.is_file():
                    # These keys are among the first ones. The whole file may be large.
                    with summary.open(encoding="utf-8", errors="replace") as file:
                        start = file.read(4000)
                if all(f'"{key}": ' in start for key in ("outcome", "began")):
                    reached = '"outcome": "reached"' in start
                    yield summary.stat(follow_symlinks=False).st_mtime, folder, reached
                elif _is_recorded(folder / BAG_FILE):
                    yield entry.stat(follow_symlinks=False).st_mtime, folder, False


def _is_recorded(file: Path) -> bool:
    """Return whether a file is a bag of the recorder; without rosbags, no file counts as one."""
    with contextlib.suppress(ModuleNotFoundError):
        from tapping_cell.report.bag import first_topics

        return any(name.endswith(f"/{NOTES}") for name in first_topics(file))
    return False


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
