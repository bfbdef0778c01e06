"""Strict reading of measurements from CSV files; every error names file and row.

The first line that is not a comment (``#``) names the columns, or the last comment above it. A
column is in SI units unless its name ends in another unit: ``x`` and ``x_m`` are in m, ``x_mm`` in
mm, ``shoulder_deg`` in degrees. Cells are separated by commas, semicolons, tabs, vertical bars or
spaces, numbers have decimal points or decimal commas, and thousands may be separated. The separator
is the one that gives the wanted columns; the decimal mark is the one with which every number of the
file can be read. If both marks fit and give different values, the file is rejected. A row in which
a cell is not a number or is out of range is rejected and listed in ``faults``. If many rows are out
of range or contain damaged numbers, such as those that a spreadsheet turned into dates, the file is
rejected, and the message suggests another unit or the cause. Other columns are ignored. Rows are
numbered as in a text editor: the first line of the file is row 1.
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

from tapping_cell.configuration.hints import character_hint, git_hint, number_hint
from tapping_cell.se2 import Array

UNITS: dict[str, dict[str, float]] = {
    "": {},
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "in": 0.0254},
    "rad": {"rad": 1.0, "deg": math.pi / 180.0, "mrad": 1e-3},
    "m/s": {"m_s": 1.0, "mm_s": 1e-3, "cm_s": 1e-2},
    "rad/s": {"rad_s": 1.0, "deg_s": math.pi / 180.0},
    "J": {"J": 1.0, "mJ": 1e-3, "uJ": 1e-6},
    "kg": {"kg": 1.0, "g": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
}
"""Suffixes of column names and their factors, for each SI unit."""

RECORDS = {
    "calibrate arm": ("shoulder", "elbow", "tool", "x", "y"),
    "calibrate tapper": ("energy", "distance"),
    "calibrate mounts": ("tapper", "speed", "x_before", "y_before"),
}
"""Required columns that show for which verb a record was made."""
_SEPARATORS = ",;\t| "
_SPACE = "[ \u00a0\u2009\u202f'\u2019]"


def _number_pattern(decimal: str, thousands: str) -> re.Pattern[str]:
    """Return the pattern of a number with this decimal mark; thousands may be separated by
    ``thousands``, by spaces or by apostrophes."""
    grouped = f"[1-9][0-9]{{0,2}}(?:(?:{thousands}[0-9]{{3}})+|(?:{_SPACE}[0-9]{{3}})+)"
    whole = f"(?:{grouped}|[0-9]+)"
    return re.compile(
        rf"[-+]?(?:{whole}(?:{decimal}[0-9]*)?|{decimal}[0-9]+)(?:[eE][-+]?[0-9]+)?"
        "|[-+]?(?:nan|inf|infinity)",
        re.IGNORECASE,
    )


_MARKS = {".": _number_pattern(r"\.", ","), ",": _number_pattern(",", r"\.")}
"""Pattern of a number for each decimal mark."""
_EXCEL_ERROR = re.compile(r"#(DIV/0!|N/A|NAME\?|NULL!|NUM!|REF!|VALUE!)")
_ARCHIVES = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
"""First bytes of spreadsheet files (xlsx and ods; xls)."""
_MOST = 0.3
"""Maximum fraction of rows out of range, and of rows with damaged numbers; above this fraction, the
whole file is rejected."""


_COPIED = 8
"""Number of successive rows that measurements do not repeat."""


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
    separator, lines = _lines(path, columns, (*texts, *optional_texts))
    header = lines[0][1]
    places = [place for column in columns if (place := _find(path, header, column))]
    text_columns = {
        name: header.index(name) for name in (*texts, *optional_texts) if name in header
    }
    found = {place.column.name for place in places}
    missing = [c.name for c in columns if c.required and c.name not in found]
    missing += [name for name in texts if name not in text_columns]
    if missing:
        wanted = ", ".join(_described(c) for c in columns if c.name in missing)
        for verb, names in RECORDS.items():
            if set(missing) & set(names):
                continue
            if all(any(h == name or h.startswith(f"{name}_") for h in header) for name in names):
                raise RecordError(
                    f"{path}: no column {', '.join(missing)}; with {', '.join(names)} in its "
                    f"header, it is a record for `{verb}`"
                )
        raise RecordError(
            f"{path}, row {lines[0][0]}: no column {', '.join(missing)}"
            f"{character_hint(''.join(header))}; add {wanted or ', '.join(missing)}, or give "
            f"another file; the header is {', '.join(header)}"
        )
    _check_names(path, header, columns, (*texts, *optional_texts))
    _check_copied(path, lines[1:])
    tables: list[tuple[str, CsvTable]] = []
    refusals: list[RecordError] = []
    for mark in _decimal_marks(path, lines, places, set(text_columns.values()), separator):
        try:
            tables.append((mark, _table(path, lines, places, text_columns, mark, separator)))
        except RecordError as error:
            refusals.append(error)
    if not tables:
        raise refusals[0]
    if len(tables) == 2:
        _check_same(path, lines, places, *(table for _, table in tables))
    return tables[0][1]


def _table(
    path: Path,
    lines: list[tuple[int, list[str]]],
    places: Sequence[_Place],
    text_columns: dict[str, int],
    mark: str,
    separator: str,
) -> CsvTable:
    """Build the table with a decimal mark.

    Raises:
        RecordError: no row is usable, or the values indicate a wrong unit.
    """
    header = lines[0][1]
    rows, kept, labels, faults = [], [], [], []
    outside: dict[str, list[float]] = {}
    damaged: dict[str, list[str]] = {}
    for row, cells in lines[1:]:
        numbers, reason = _row(cells, header, places, outside, damaged, mark)
        if reason is None:
            rows.append(row)
            kept.append(numbers)
            labels.append({name: cells[index].strip() for name, index in text_columns.items()})
        else:
            faults.append(RowFault(path, row, reason))
    _check_units(path, places, outside, len(lines) - 1)
    _check_damage(path, damaged, len(lines) - 1)
    if not rows:
        longer = all(len(header) < len(cells) <= 2 * len(header) for _, cells in lines[1:])
        if separator == "," and longer and len(lines) > 1:
            raise RecordError(
                f"{path}: the header has {len(header)} columns, but row {lines[1][0]} has "
                f"{len(lines[1][1])} cells: the comma seems to be decimal mark and separator; "
                "write decimal points, or separate the cells with semicolons"
            )
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


def _text(path: Path) -> str:
    """Read a file in UTF-8, or in UTF-16 with a byte order mark, as Excel's "Unicode text"."""
    try:
        content = path.read_bytes()
        if content.startswith(_ARCHIVES):
            raise RecordError(
                f"{path}: is a file of a spreadsheet program, not CSV; save its sheet as CSV"
            )
        encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
        text = content.decode(encoding)
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be read ({error.strerror}); give the path of an existing CSV file"
        ) from error
    except UnicodeDecodeError as error:
        raise RecordError(f"{path}: is not UTF-8 text; save it as CSV in UTF-8") from error
    if "\0" in text:
        raise RecordError(f"{path}: contains NUL characters; save it as CSV in UTF-8")
    if conflict := git_hint(text):
        raise RecordError(f"{path}: {conflict}")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _lines(
    path: Path, columns: Sequence[Column], texts: Sequence[str]
) -> tuple[str, list[tuple[int, list[str]]]]:
    """Return the separator, and row number and cells of each line that is neither empty nor a
    comment; the first such line is the header."""
    filled = [(n, one) for n, one in enumerate(_text(path).split("\n"), start=1) if one.strip()]
    lines = [(number, line) for number, line in filled if not _is_comment(line)]
    separators = _SEPARATORS
    if lines and (told := re.fullmatch('"?sep=(.)"?', lines[0][1].strip(" "), re.IGNORECASE)):
        separators = told[1]
        del lines[0]
    if not lines:
        raise RecordError(f"{path}: is empty; its first line must name the columns")
    comments = [
        (n, c.lstrip("# ")) for n, c in filled if n < lines[0][0] and re.match('#[^"]*$', c)
    ]
    readings: list[tuple[tuple[bool, int, int, int], str, list[tuple[int, list[str]]]]] = []
    refusal = RecordError()
    for separator in separators:
        if separator == " " and any(complete for (complete, *_), *_ in readings):
            break  # the spaces are around other separators
        try:
            read = _split(path, lines, separator)
            if comments and not _names_all(read[0][1], columns):
                below = _split(path, [comments[-1], *lines], separator)
                # numpy.savetxt writes the names of the columns as a comment.
                read = below if _names_all(below[0][1], columns) else read
        except RecordError as error:
            refusal = refusal if refusal.args else error
            continue
        header = read[0][1]
        named = [any(name in header for name in column.headers()) for column in columns]
        complete = _names_all(header, columns)
        whole = sum(len(row) == len(header) for _, row in read)
        if separator == " " and not (complete and 2 * whole > len(read)):
            break
        title = next((row for row, cells in read[1:] if _names_all(cells, columns)), 0)
        if title and not complete:
            raise RecordError(f"{path}: row {title} names the columns; delete the lines above it")
        known = sum(named) + sum(name in header for name in texts)
        readings.append(((complete, known, whole, len(header)), separator, read))
    if not readings:
        raise refusal
    best = max(rank for rank, _, _ in readings)
    (_, separator, read), *others = [reading for reading in readings if reading[0] == best]
    for _, other, cells in others:
        if cells != read and best[0]:
            raise RecordError(
                f"{path}: both {separator!r} and {other!r} may separate the cells; name the "
                f"separator in a first line, such as sep={separator}"
            )
    return separator, read


def _is_comment(line: str) -> bool:
    start = line.lstrip()
    return start.startswith("#") and not _EXCEL_ERROR.match(start)


def _names_all(cells: Sequence[str], columns: Sequence[Column]) -> bool:
    """Return whether the cells of a line name all required columns."""
    return all(set(column.headers()) & set(cells) for column in columns if column.required)


def _split(
    path: Path, lines: Sequence[tuple[int, str]], separator: str
) -> list[tuple[int, list[str]]]:
    """Split lines into cells. Empty cells at the end of the header, and cells below them, are
    dropped, as are rows without any content."""
    found: list[tuple[int, list[str]]] = []
    columns = 0
    for number, line in lines:
        reader = csv.reader([line], delimiter=separator, strict=True, skipinitialspace=True)
        try:
            cells = [cell.strip() for cell in next(reader)]
        except csv.Error as error:
            raise RecordError(f"{path}, row {number}: is not CSV: {error}") from error
        while cells and not cells[-1] and (not found or len(cells) > columns):
            del cells[-1]
        if any(cells):
            columns = columns or len(cells)
            found.append((number, cells))
    if not found:
        raise RecordError(f"{path}: is empty; its first line must name the columns")
    return found


def _decimal_marks(
    path: Path,
    lines: list[tuple[int, list[str]]],
    places: Sequence[_Place],
    texts: set[int],
    separator: str,
) -> list[str]:
    """Return the decimal marks with which every number of the file can be read.

    Numbers in the wanted columns decide; those in other columns count only if both marks fit.

    Raises:
        RecordError: some numbers have a decimal point and others a decimal comma.
    """
    cells = [
        (row, index, cell)
        for row, columns in lines[1:]
        for index, cell in enumerate(columns)
        if index not in texts and any(mark.fullmatch(cell) for mark in _MARKS.values())
    ]
    wanted = {place.index for place in places}
    own = [(row, cell) for row, index, cell in cells if index in wanted]
    if separator == "," and not any("," in cell for _, cell in own):
        return ["."]
    unread = {
        mark: next(((row, cell) for row, cell in own if not pattern.fullmatch(cell)), None)
        for mark, pattern in _MARKS.items()
    }
    fitting = [mark for mark, cell in unread.items() if cell is None]
    if not fitting:
        (row, cell), (other_row, other) = unread["."] or (0, ""), unread[","] or (0, "")
        raise RecordError(
            f"{path}: row {row} has the number {cell!r}, row {other_row} has {other!r}: write all "
            "numbers with the same decimal mark"
        )
    for mark in fitting[: len(fitting) == 1]:
        either = [one for one in own if len(_values(one[1])) == 2]
        deciding = [one for one in own if not all(p.fullmatch(one[1]) for p in _MARKS.values())]
        if len(either) > 3 * len(deciding):
            (row, cell), (other_row, other) = deciding[0], either[0]
            raise RecordError(
                f"{path}: {cell!r} in row {row} would turn {other!r} in row {other_row} and "
                f"{len(either) - 1} other numbers into {_number(other, mark):.12g} and the like; "
                "write all numbers with the same decimal mark, without separators between thousands"
            )
    others = [m for m in fitting if all(_MARKS[m].fullmatch(cell) for _, _, cell in cells)]
    return others or fitting


def _check_same(
    path: Path,
    lines: list[tuple[int, list[str]]],
    places: Sequence[_Place],
    point: CsvTable,
    comma: CsvTable,
) -> None:
    """Raise RecordError if the two tables differ, which were read with a decimal point and with a
    decimal comma."""
    if point.rows.tolist() == comma.rows.tolist() and all(
        np.array_equal(point.values[name], comma.values[name], equal_nan=True)
        for name in point.values
    ):
        return
    row, header, cell = next(
        (row, place.header, cells[place.index])
        for row, cells in lines[1:]
        for place in places
        if place.index < len(cells)
        and all(pattern.fullmatch(cells[place.index]) for pattern in _MARKS.values())
        and _number(cells[place.index], ".") != _number(cells[place.index], ",")
    )
    raise RecordError(
        f"{path}, row {row}: {header} is {cell!r}, which may be {_number(cell, '.'):.12g} (decimal "
        f"point) or {_number(cell, ','):.12g} (decimal comma), and both fit the whole file; write "
        "the numbers without separators between thousands, and with a decimal point in a file "
        "with commas between the cells"
    )


def _values(cell: str) -> set[float]:
    """Return the values that a cell may have, with a decimal point and with a decimal comma."""
    return {_number(cell, mark) for mark, pattern in _MARKS.items() if pattern.fullmatch(cell)}


def _number(cell: str, mark: str) -> float:
    """Return the value of a cell that matches the pattern of the decimal mark."""
    digits = re.sub(_SPACE, "", cell).replace("," if mark == "." else ".", "")
    return float(digits.replace(mark, "."))


_UNIT_WORDS = {
    *(ending.lower() for endings in UNITS.values() for ending in endings),
    *("", "°", "degree", "degrees", "radian", "radians", "µm", "µs", "µj", "sec", "seconds"),
    *("meter", "meters", "metre", "metres", "in", "inch", "inches"),
}


def _check_names(
    path: Path, header: Sequence[str], columns: Sequence[Column], texts: Sequence[str]
) -> None:
    """Raise RecordError if the name of an optional column differs only in case or in its unit from
    a known name: the column would be ignored."""
    known = {name for column in columns for name in column.headers()} | set(texts)
    for column in columns:
        for name in header:
            ending = name.lower().removeprefix(column.name.lower())
            if name in known or ending == name.lower() or set(column.headers()) & set(header):
                continue
            if ending.strip(" _[](){}.").replace("/", "_") in _UNIT_WORDS:
                raise RecordError(
                    f"{path}: the column {name!r} would be ignored; name it {_described(column)}"
                )


def _check_copied(path: Path, rows: Sequence[tuple[int, list[str]]]) -> None:
    """Raise RecordError if successive rows appear twice, as after pasting them twice: the fitted
    values would seem more certain than they are."""
    seen: dict[tuple[tuple[str, ...], ...], int] = {}
    for index in range(len(rows) - _COPIED + 1):
        block = tuple(tuple(cells) for _, cells in rows[index : index + _COPIED])
        first = seen.setdefault(block, index)
        if index - first >= _COPIED:
            (a, _), (b, _) = rows[first], rows[first + _COPIED - 1]
            (c, _), (d, _) = rows[index], rows[index + _COPIED - 1]
            raise RecordError(
                f"{path}: rows {c} to {d} repeat rows {a} to {b}; delete the rows that were pasted "
                "twice"
            )


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
    damaged: dict[str, list[str]],
    mark: str,
) -> tuple[list[float], str | None]:
    """Return the numbers of a row, and the reason if the row is unusable (otherwise None).

    Values out of range are appended to ``outside``, and cells that contain digits but no number to
    ``damaged``.
    """
    if len(cells) != len(header):
        return [], f"has {len(cells)} cells, but the header has {len(header)} columns"
    numbers, reasons = [], []
    for place in places:
        cell, column = cells[place.index], place.column
        if not cell and not column.required:
            numbers.append(math.nan)
            continue
        if not _MARKS[mark].fullmatch(cell):
            reasons.append(f"{place.header} is {cell!r}, not a number{number_hint(cell)}")
            if re.search("[0-9]", cell) and not _EXCEL_ERROR.match(cell):
                damaged.setdefault(place.header, []).append(cell)
            continue
        given = _number(cell, mark)
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


def _check_damage(path: Path, damaged: dict[str, list[str]], total: int) -> None:
    """Raise RecordError if many cells of a column contain digits but no number: the rows that are
    left are no fair sample, and what damaged the others may have changed them too."""
    for header, cells in damaged.items():
        if len(cells) > _MOST * total:
            raise RecordError(
                f"{path}: {len(cells)} of {total} rows have a {header} that is not a number, e.g. "
                f"{cells[0]!r}{number_hint(cells[0]) or '; write numbers only'}"
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
    limit = max(abs(column.minimum), abs(column.maximum))
    fitting = []
    for ending, factor in UNITS[column.unit].items():
        largest = max(abs(value) for value in wrong) / place.factor * factor
        if factor != place.factor and column.least_largest <= largest <= limit:
            fitting.append(f"{column.name}_{ending} if the values are in {ending}")
    if fitting:
        return f"name the column {', or '.join(fitting)}"
    return f"give {column.name} in {column.unit or 'the right unit'}"
