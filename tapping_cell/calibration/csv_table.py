"""Strict reading of measurements from CSV files; every error names file and row.

The first line that is not a comment (``#``) names the columns. A column is in SI units unless its
name ends in another unit: ``x`` and ``x_m`` are in m, ``x_mm`` in mm, ``shoulder_deg`` in degrees.
Cells are separated by commas, semicolons or tabs. With semicolons or tabs, numbers may have decimal
commas. A row in which a cell is not a number or is out of range is rejected and listed in
``faults``. If many rows are out of range, the file is rejected, and the message suggests another
unit. Other columns are ignored. Rows are numbered as in a text editor: the first line of the file
is row 1.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import Array

UNITS: dict[str, dict[str, float]] = {
    "": {},
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6},
    "rad": {"rad": 1.0, "deg": math.pi / 180.0, "mrad": 1e-3},
    "m/s": {"m_s": 1.0, "mm_s": 1e-3, "cm_s": 1e-2},
    "rad/s": {"rad_s": 1.0, "deg_s": math.pi / 180.0},
    "J": {"J": 1.0, "mJ": 1e-3, "uJ": 1e-6},
    "kg": {"kg": 1.0, "g": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
}
"""Suffixes of column names and their factors, for each SI unit."""

_DECIMAL_POINT = re.compile(r"[+-]?\d*\.\d*([eE][+-]?\d+)?")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d*([eE][+-]?\d+)?")
_MOST = 0.3
"""Maximum fraction of rows out of range; above this fraction, the whole file is rejected."""


class RecordError(ValueError):
    """Raised for an unusable record; the message names the file, the row or column, and the
    remedy."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of numbers with its SI ``unit`` (a key of ``UNITS``) and its closed range.

    ``least_largest`` is a magnitude that at least one value of the column should reach. If none
    reaches it, the column probably has the wrong unit, for example metres in a column of
    millimetres.
    """

    name: str
    unit: str = ""
    minimum: float = -math.inf
    maximum: float = math.inf
    required: bool = True
    least_largest: float = 0.0

    def headers(self) -> dict[str, float]:
        """Return the permitted names of the column with their factors to SI."""
        return {self.name: 1.0} | {
            f"{self.name}_{ending}": factor for ending, factor in UNITS[self.unit].items()
        }


@dataclass(frozen=True, slots=True)
class RowFault:
    """A rejected row with the reason."""

    path: Path
    row: int
    reason: str

    def __str__(self) -> str:
        return f"{self.path}, row {self.row}: {self.reason}"


@dataclass(frozen=True, slots=True, eq=False)
class CsvTable:
    """The valid rows of a file: row numbers (N,), columns of numbers (N,) in SI units, and columns
    of N texts.

    ``values`` does not contain optional columns that the file lacks. Empty cells of optional
    columns are NaN.
    """

    path: Path
    rows: NDArray[np.intp]
    values: dict[str, Array]
    texts: dict[str, tuple[str, ...]]
    faults: tuple[RowFault, ...]

    def columns(self, *names: str) -> Array:
        """Stack columns side by side, shape (N, len(names))."""
        return np.stack([self.values[name] for name in names], axis=-1)


@dataclass(frozen=True, slots=True)
class _Place:
    """Position of a column in the file, and its factor to SI."""

    column: Column
    index: int
    header: str
    factor: float


def read_csv(
    path: Path | str,
    columns: Sequence[Column],
    texts: Sequence[str] = (),
    optional_texts: Sequence[str] = (),
) -> CsvTable:
    """Read the rows of a CSV file in which every cell is a number within its range.

    Raises:
        RecordError: the file, its header or a column is missing, there is no valid row, a column is
        repeated, or many values indicate a wrong unit.
    """
    path = Path(path)
    lines = _lines(path)
    header = [name.strip() for name in lines[0][1]]
    places = [place for column in columns if (place := _find(path, header, column))]
    text_columns = {
        name: header.index(name) for name in (*texts, *optional_texts) if name in header
    }
    found = {place.column.name for place in places}
    missing = [c.name for c in columns if c.required and c.name not in found]
    missing += [name for name in texts if name not in text_columns]
    if missing:
        wanted = ", ".join(_described(c) for c in columns if c.name in missing)
        raise RecordError(
            f"{path}, row {lines[0][0]}: no column {', '.join(missing)}; the header is"
            f" {', '.join(header)}. Add {wanted or ', '.join(missing)}"
        )
    rows, kept, labels, faults = [], [], [], []
    outside: dict[str, list[float]] = {}
    for row, cells in lines[1:]:
        numbers, reason = _row(cells, header, places, outside)
        if reason is None:
            rows.append(row)
            kept.append(numbers)
            labels.append({name: cells[index].strip() for name, index in text_columns.items()})
        else:
            faults.append(RowFault(path, row, reason))
    _check_units(path, places, outside, len(lines) - 1)
    if not rows:
        reasons = "; ".join(f"row {fault.row}: {fault.reason}" for fault in faults[:3])
        raise RecordError(f"{path}: no row is usable ({reasons or 'it has no rows'})")
    table = np.array(kept, dtype=float).reshape(len(rows), len(places))
    values = {place.column.name: table[:, k] for k, place in enumerate(places)}
    _check_size(path, places, values)
    return CsvTable(
        path=path,
        rows=np.array(rows, dtype=np.intp),
        values=values,
        texts={name: tuple(label[name] for label in labels) for name in text_columns},
        faults=tuple(faults),
    )


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Read row number and cells of each line that is neither empty nor a comment; the first such
    line is the header."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be read ({error.strerror}); give the path of an existing CSV file"
        ) from error
    except UnicodeDecodeError as error:
        raise RecordError(f"{path}: is not UTF-8 text; save it as CSV in UTF-8") from error
    found: list[tuple[int, list[str]]] = []
    delimiter = ","
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if not found and "," not in line:
            delimiter = next((mark for mark in ";\t" if mark in line), ",")
        try:
            found.append((number, next(csv.reader([line], delimiter=delimiter, strict=True))))
        except csv.Error as error:
            raise RecordError(f"{path}, row {number}: is not CSV: {error}") from error
    if not found:
        raise RecordError(f"{path}: is empty; its first line must name the columns")
    return found if delimiter == "," else _with_points(found)


def _with_points(lines: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Convert decimal commas to points.

    A file with any decimal point is left unchanged, because its commas may separate thousands.
    """
    cells = [cell.strip() for _, row in lines[1:] for cell in row]
    if any(_DECIMAL_POINT.fullmatch(cell) for cell in cells):
        return lines
    commas = [
        (number, [c.replace(",", ".") if _DECIMAL_COMMA.fullmatch(c.strip()) else c for c in row])
        for number, row in lines[1:]
    ]
    return [lines[0], *commas]


def _described(column: Column) -> str:
    units = ", ".join(f"{column.name}_{ending}" for ending in UNITS[column.unit])
    return column.name + (f" ({column.unit}; or named {units})" if units else "")


def _find(path: Path, header: Sequence[str], column: Column) -> _Place | None:
    """Find a column in the header; None if the file lacks it."""
    known = column.headers()
    found = [(index, name) for index, name in enumerate(header) if name in known]
    if len(found) > 1:
        raise RecordError(
            f"{path}: the column {column.name} appears {len(found)} times"
            f" ({', '.join(name for _, name in found)}); keep one of them"
        )
    if not found:
        return None
    index, name = found[0]
    return _Place(column, index, name, known[name])


def _row(
    cells: Sequence[str],
    header: Sequence[str],
    places: Sequence[_Place],
    outside: dict[str, list[float]],
) -> tuple[list[float], str | None]:
    """Return the numbers of a row, and the reason if the row is unusable (otherwise None).

    Values out of range are appended to ``outside``.
    """
    if len(cells) != len(header):
        return [], f"has {len(cells)} cells, but the header has {len(header)} columns"
    numbers, reasons = [], []
    for place in places:
        cell, column = cells[place.index].strip(), place.column
        if not cell and not column.required:
            numbers.append(math.nan)
            continue
        try:
            given = float(cell)
        except ValueError:
            reasons.append(f"{place.header} is {cell!r}, not a number")
            continue
        value = given * place.factor
        if not math.isfinite(value):
            reasons.append(f"{place.header} is {cell}, not a finite number")
        elif not column.minimum <= value <= column.maximum:
            outside.setdefault(column.name, []).append(value)
            low, high = column.minimum / place.factor, column.maximum / place.factor
            reasons.append(f"{place.header} is {given:g}, outside {low:g} to {high:g}")
        numbers.append(value)
    return numbers, "; ".join(reasons) or None


def _check_units(
    path: Path, places: Sequence[_Place], outside: dict[str, list[float]], total: int
) -> None:
    """Raise RecordError if many values of a column are out of range."""
    for place in places:
        wrong = outside.get(place.column.name, [])
        if len(wrong) <= _MOST * total:
            continue
        raise RecordError(
            f"{path}: {len(wrong)} of {total} rows have {place.header} outside"
            f" {place.column.minimum / place.factor:g} to"
            f" {place.column.maximum / place.factor:g}, e.g. {wrong[0] / place.factor:g};"
            f" {_remedy(place, wrong)}"
        )


def _check_size(path: Path, places: Sequence[_Place], values: dict[str, Array]) -> None:
    """Raise RecordError if all values of a column are implausibly small."""
    for place in places:
        column, found = place.column, values[place.column.name]
        largest = float(np.max(np.abs(found[np.isfinite(found)]), initial=0.0))
        if largest < column.least_largest:
            raise RecordError(
                f"{path}: the largest magnitude of {place.header} is "
                f"{largest / place.factor:g}, but at least one value of "
                f"{column.least_largest / place.factor:g} or more is expected; "
                f"{_remedy(place, [largest])}"
            )


def _remedy(place: _Place, wrong: Sequence[float]) -> str:
    """Suggest another unit in which these values (SI) would be within range."""
    column = place.column
    for ending, factor in UNITS[column.unit].items():
        scaled = [abs(value) / place.factor * factor for value in wrong]
        limit = max(abs(column.minimum), abs(column.maximum))
        if factor != place.factor and column.least_largest <= max(scaled) <= limit:
            return f"name the column {column.name}_{ending} if the values are in {ending}"
    return f"give {column.name} in {column.unit or 'the right unit'}"
