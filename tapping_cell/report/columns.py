"""Declaration of the columns of ``taps.csv``.

A field of ``TapRow`` that is made by one of these functions declares its columns: their headers
with the unit, how the value is taken from the recorded ``TapRecord``, and how it is written and
read. The bag reader, the table and the reference page use only this declaration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields
from operator import attrgetter
from typing import Any

import numpy as np

from tapping_cell.se2 import Pose, from_message

DEGREES = math.degrees(1.0)
_POSE = (("x_mm", 1e3), ("y_mm", 1e3), ("theta_deg", DEGREES))
_COVARIANCE = (
    ("variance_x_mm2", 0, 0, 1e6),
    ("covariance_x_y_mm2", 0, 1, 1e6),
    ("covariance_x_theta_mm_deg", 0, 2, 1e3 * DEGREES),
    ("variance_y_mm2", 1, 1, 1e6),
    ("covariance_y_theta_mm_deg", 1, 2, 1e3 * DEGREES),
    ("variance_theta_deg2", 2, 2, DEGREES**2),
)


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its header, the factor from SI units (None for text) and the number format."""

    header: str
    factor: float | None = None
    form: str = ""

    def write(self, value: Any) -> str:
        """Return the text of a value."""
        return str(value) if self.factor is None else f"{self.factor * value:{self.form}}"

    def read(self, text: str) -> Any:
        """Return the value of a text."""
        return text if self.factor is None else float(text) / self.factor


@dataclass(frozen=True, slots=True)
class Columns:
    """Columns of one field.

    ``split`` returns the values of a field's columns, and ``join`` the field of these values.
    ``take`` returns the field of a ``TapRecord``; None if the bag reader computes it. ``meaning``:
    description for the reference page.
    """

    meaning: str
    columns: tuple[Column, ...]
    take: Callable[[Any], Any] | None
    split: Callable[[Any], Sequence[Any]] = lambda value: (value,)
    join: Callable[[Sequence[Any]], Any] = lambda values: values[0]


def _declared(columns: Columns, default: Any) -> Any:
    metadata = {"columns": columns}
    return (
        field(metadata=metadata)
        if default is MISSING
        else field(default=default, metadata=metadata)
    )


def count(meaning: str, header: str, source: str) -> Any:
    """Declare an integer of the record's attribute ``source``."""
    join = lambda values: int(values[0])  # noqa: E731
    return _declared(Columns(meaning, (Column(header),), attrgetter(source), join=join), MISSING)


def text(
    meaning: str, header: str, take: Callable[[Any], str] | None, default: Any = MISSING
) -> Any:
    """Declare a text."""
    return _declared(Columns(meaning, (Column(header),), take), default)


def quantity(
    meaning: str,
    header: str,
    factor: float,
    form: str,
    source: str | None,
    default: Any = MISSING,
) -> Any:
    """Declare a number in SI units; NaN if unknown."""
    take = None if source is None else (lambda record: float(attrgetter(source)(record)))
    return _declared(Columns(meaning, (Column(header, factor, form),), take), default)


def pose(meaning: str, prefix: str, take: str | Callable[[Any], Pose] | None) -> Any:
    """Declare a pose in three columns; None is written as NaN and read as None if the bag reader
    computes the pose (``take`` is None)."""
    columns = tuple(Column(prefix + name, factor, ".4f") for name, factor in _POSE)
    optional = take is None

    def split(value: Pose | None) -> Sequence[float]:
        return (math.nan,) * 3 if value is None else value

    def join(values: Sequence[float]) -> Pose | None:
        return None if optional and not math.isfinite(values[0]) else Pose(*values)

    if isinstance(take, str):
        source = attrgetter(take)
        take = lambda record: from_message(source(record))  # noqa: E731
    return _declared(Columns(meaning, columns, take, split, join), MISSING)


def covariance(meaning: str, prefix: str, source: str) -> Any:
    """Declare the covariance of a pose, which the record holds as nine numbers; None if unknown."""
    columns = tuple(Column(prefix + name, factor, ".6g") for name, _, _, factor in _COVARIANCE)

    def split(value: Any) -> Sequence[float]:
        return [math.nan if value is None else value[row][at] for _, row, at, _ in _COVARIANCE]

    def join(values: Sequence[float]) -> Any:
        if not np.all(np.isfinite(values)):
            return None
        xx, xy, xt, yy, yt, tt = values
        return ((xx, xy, xt), (xy, yy, yt), (xt, yt, tt))

    def take(record: Any) -> Any:
        values = np.array(getattr(record, source, ()), dtype=float)
        known = values.size == 9 and np.any(values) and np.all(np.isfinite(values))
        return tuple(tuple(row) for row in values.reshape(3, 3).tolist()) if known else None

    return _declared(Columns(meaning, columns, take, split, join), None)


def part(meaning: str, kind: type, source: str) -> Any:
    """Declare a dataclass of quantities with defaults, which the record holds in ``source``."""
    names = [each.name for each in fields(kind)]
    own = [each.metadata["columns"] for each in fields(kind)]

    def take(record: Any) -> Any:
        held = getattr(record, source, None)
        return kind() if held is None else kind(**from_record(kind, held))

    return field(
        default_factory=kind,
        metadata={
            "columns": Columns(
                meaning,
                tuple(columns.columns[0] for columns in own),
                take,
                attrgetter(*names),
                lambda values: kind(*values),
            )
        },
    )


def declared(kind: type) -> Iterator[tuple[Field[Any], Columns]]:
    """Yield the fields of a row and their columns, in the order of the table."""
    for each in fields(kind):
        yield each, each.metadata["columns"]


def headers(kind: type) -> list[str]:
    """Return the headers of all columns."""
    return [column.header for _, columns in declared(kind) for column in columns.columns]


def from_record(kind: type, record: Any) -> dict[str, Any]:
    """Return the fields that are taken from a record. A record of an earlier version may lack
    fields with a default."""
    found = {}
    for each, columns in declared(kind):
        if columns.take is None:
            continue
        try:
            found[each.name] = columns.take(record)
        except AttributeError:
            if each.default is MISSING:
                raise
    return found


def to_texts(row: Any) -> dict[str, str]:
    """Return the texts of a row, by header."""
    return {
        column.header: column.write(value)
        for each, columns in declared(type(row))
        for column, value in zip(
            columns.columns, columns.split(getattr(row, each.name)), strict=True
        )
    }


def from_texts(kind: type, row: Mapping[str, str]) -> Any:
    """Return the row of a table. A table of an earlier version may lack fields with a default.

    Raises:
        KeyError, TypeError, ValueError: a column is missing or damaged.
    """
    found = {}
    for each, columns in declared(kind):
        optional = each.default is not MISSING or each.default_factory is not MISSING
        if optional and any(column.header not in row for column in columns.columns):
            continue
        found[each.name] = columns.join(
            [column.read(row[column.header]) for column in columns.columns]
        )
    return kind(**found)
