"""Access of the page to the recorder's run folders: list, find by name, compare, and pack for
download.

A requested name can select only a folder directly in the recorder's folder. Links are not followed,
and a folder without ``summary.json`` is not served.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from tapping_cell.nodes.recorder.run_names import STARRED, is_run_name
from tapping_cell.report.run_comparison import comparison_page
from tapping_cell.report.run_folder import TAPS, RunError, read_run

SUMMARY = "summary.json"
REPORT = "report.html"
MAX_ROWS = 40
LARGEST_SUMMARY = 4_000_000
"""Maximum number of bytes of a summary."""
UNREADABLE = (
    OSError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    OverflowError,
    RecursionError,
)
"""Exceptions that can occur while a damaged summary is read."""


class Runs:
    """The runs in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.expanduser().absolute()
        self._rows: dict[str, tuple[int, dict[str, object]]] = {}

    def rows(self) -> list[dict[str, object]]:
        """Return the latest runs, newest first: name, time, outcome, goal, objects, taps, residual,
        error, report, kept (it is never deleted).

        Times are in s, poses are [mm, mm, degrees] and residuals [mm, degrees]; unknown values are
        None. ``objects``: number of objects with a goal; ``goal`` is None if there are several.
        """
        found = []
        for name, changed in self._summaries():
            if name not in self._rows or self._rows[name][0] != changed:
                self._rows[name] = (changed, self._row(name))
            kept = (self.folder / name / STARRED).exists()
            report = self.report(name) is not None
            found.append({**self._rows[name][1], "report": report, "kept": kept})
        listed = {str(row["name"]) for row in found}
        self._rows = {name: row for name, row in self._rows.items() if name in listed}
        return found

    def find(self, name: str) -> Path | None:
        """Return the folder of a run, or None if there is no run of this name."""
        if not is_run_name(name):
            return None
        path = self.folder / name
        try:
            own = path.is_dir() and not path.is_symlink()
            return path if own and self._summary(path) is not None else None
        except OSError:
            return None

    def report(self, name: str) -> Path | None:
        """Return the report of a run, or None if the run has no report."""
        run = self.find(name)
        report = run / REPORT if run is not None else None
        return report if report and report.is_file() and not report.is_symlink() else None

    def keep(self, name: str, keep: bool) -> bool:
        """Set whether a run is never deleted. Return False if there is no such run.

        Raises:
            OSError: the folder cannot be written.
        """
        run = self.find(name)
        if run is None:
            return False
        if keep:
            (run / STARRED).touch()
        else:
            (run / STARRED).unlink(missing_ok=True)
        return True

    def comparison(self, names: Sequence[str]) -> str:
        """Return the page that compares these runs.

        Raises:
            RunError: fewer than two or too many names are given, or a run is missing or unreadable.
        """
        if not 2 <= len(set(names)) == len(names) <= MAX_ROWS:
            raise RunError(f"{len(names)} runs were chosen; choose 2 to {MAX_ROWS} different runs")
        runs = []
        for name in names:
            folder = self.find(name)
            if folder is None or (folder / TAPS).is_symlink():
                raise RunError(f"there is no run '{name}'")
            runs.append(read_run(folder))
        return comparison_page(runs, [f"{quote(name)}/{REPORT}" for name in names])

    def archive(self, name: str) -> Path | None:
        """Create a ZIP file of a run and return its path, or None if there is no such run. The
        caller must delete the file.

        Links are always omitted. Bags are already compressed, so they are stored without further
        compression. Times that the ZIP format cannot express (before 1980, after 2107) are replaced
        by the nearest possible time.

        Raises:
            OSError: the run is unreadable, or the disk is full.
        """
        run = self.find(name)
        if run is None:
            return None
        handle, made = tempfile.mkstemp(prefix="tapping_cell-run-", suffix=".zip")
        archive = Path(made)
        try:
            with (
                os.fdopen(handle, "wb") as stream,
                zipfile.ZipFile(stream, "w", strict_timestamps=False) as packed,
            ):
                for place, folders, files in os.walk(run, followlinks=False):
                    folders.sort()
                    for file in sorted(Path(place, each) for each in files):
                        if file.is_file() and not file.is_symlink():
                            how = (
                                zipfile.ZIP_STORED
                                if file.suffix == ".mcap"
                                else zipfile.ZIP_DEFLATED
                            )
                            packed.write(file, Path(name) / file.relative_to(run), how)
        except BaseException:
            archive.unlink(missing_ok=True)
            raise
        return archive

    @staticmethod
    def _summary(folder: Path) -> Path | None:
        """Return the summary of a run, or None if the folder holds none."""
        path = folder / SUMMARY
        return path if path.is_file() and not path.is_symlink() else None

    def _summaries(self) -> list[tuple[str, int]]:
        """Return names and modification times of the latest runs, newest first."""
        found = []
        try:
            with os.scandir(self.folder) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False) and is_run_name(entry.name):
                        summary = self._summary(Path(entry.path))
                        if summary is not None:
                            found.append((entry.name, os.lstat(summary).st_mtime_ns))
        except OSError:
            return []
        found.sort(key=lambda each: each[1], reverse=True)
        return found[:MAX_ROWS]

    def _row(self, name: str) -> dict[str, object]:
        row: dict[str, object] = {
            "name": name,
            "began": None,
            "outcome": "unreadable",
            "goal": None,
            "objects": 1,
            "taps": None,
            "residual": None,
            "error": "",
        }
        run = self.find(name)
        summary = None if run is None else self._summary(run)
        if summary is None:
            return row
        try:
            with summary.open(encoding="utf-8") as file:
                content = json.loads(file.read(LARGEST_SUMMARY))
            goal, residual = content["goal"], content["measured_residual"]
            row |= {
                "began": _number(content["began"]),
                "objects": sum(one["goal"] is not None for one in content.get("objects", ())) or 1,
                "goal": goal and [_number(goal[key]) for key in ("x_mm", "y_mm", "theta_deg")],
                "taps": int(content["taps"]),
                "residual": residual
                and [_number(residual[key]) for key in ("distance_mm", "rotation_deg")],
                "error": str(content["error_msg"])[:500],
                "outcome": str(content["outcome"])[:40],
            }
        except UNREADABLE:
            return row
        return row


def _number(value: object) -> float | None:
    """Return a finite number; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return None
    return round(float(value), 3)
