"""A CSV file to which each measurement is appended immediately, so that no measurement is lost."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from tapping_cell.calibration.csv_table import RecordError


class GrowingCsv:
    """Rows of numbers with a header; each row is on the disk when ``append`` returns.

    ``rows`` is the number of rows in the file.

    Raises:
        RecordError: the file exists and ``resume`` is False, or the file has other columns or is
            not UTF-8 text.
    """

    def __init__(self, path: Path, header: Sequence[str], resume: bool) -> None:
        self._path = path
        self._columns = len(header)
        self.rows = 0
        line = ",".join(header)
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._write(line + "\n", "x")
            return
        if not resume:
            raise RecordError(
                f"{path} exists already and is not overwritten; give --resume to continue it, "
                "or another name"
            )
        try:
            text = path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise RecordError(
                f"{path}: cannot be continued, because it is not UTF-8 text; save it as CSV in "
                "UTF-8, or give another name"
            ) from error
        first, *rows = [
            row.strip() for row in text.splitlines() if row.strip() and not row.startswith("#")
        ] or [""]
        if first != line:
            raise RecordError(
                f"{path}: cannot be continued, because its columns are {first or '(none)'}, but "
                f"this recording writes {line}; give another name"
            )
        self.rows = len(rows)
        if not text.endswith("\n"):
            self._write("\n", "a")

    def append(self, values: Sequence[float]) -> None:
        """Append a row of values, in the order and units of the header.

        Raises:
            OSError: the file cannot be written, for example because the disk is full.
        """
        if len(values) != self._columns:
            raise ValueError(f"{len(values)} values for {self._columns} columns")
        self._write(",".join(f"{value:.9g}" for value in values) + "\n", "a")
        self.rows += 1

    def _write(self, text: str, mode: str) -> None:
        with self._path.open(mode, encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
