"""CSV records are converted to SI units, and each fault is reported with file and row."""

from __future__ import annotations

import math
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.calibration.csv_table import Column, RecordError, read_csv

COLUMNS = (
    Column("x", "m", -3.0, 3.0, least_largest=0.01),
    Column("angle", "rad", -7.0, 7.0),
    Column("energy", "J", 0.0, 10.0, required=False),
)


def file(folder: Path, text: str) -> Path:
    path = folder / "record.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_units_are_read_from_the_column_names(tmp_path: Path) -> None:
    path = file(tmp_path, "# a comment\n\nrun,x_mm,angle_deg,energy_mJ\na,250,90,5\nb,-1e2,-180,\n")
    table = read_csv(path, COLUMNS, texts=("run",))
    np.testing.assert_allclose(table.values["x"], [0.25, -0.1])
    np.testing.assert_allclose(table.values["angle"], [math.pi / 2, -math.pi])
    np.testing.assert_allclose(table.values["energy"], [0.005, math.nan])
    assert table.texts["run"] == ("a", "b")
    assert table.rows.tolist() == [4, 5]
    assert table.faults == ()


def test_semicolons_and_a_byte_order_mark_are_read(tmp_path: Path) -> None:
    table = read_csv(file(tmp_path, "\ufeffx;angle\n0.5;1\n"), COLUMNS)
    assert table.columns("x", "angle").tolist() == [[0.5, 1.0]]


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("abc,1", "x is 'abc', not a number"),
        ("nan,1", "not a finite number"),
        ("inf,1", "not a finite number"),
        (",1", "x is '', not a number"),
        ("250,1", "x is 250, outside -3 to 3"),
        ("0.25", "has 1 cells, but the header has 2"),
        ("0.25,1,9", "has 3 cells"),
    ],
)
def test_an_invalid_row_is_excluded_and_named(tmp_path: Path, row: str, words: str) -> None:
    good = "0.25,1\n" * 4
    table = read_csv(file(tmp_path, f"x,angle\n{good}{row}\n{good}"), COLUMNS)
    assert len(table.rows) == 8 and 6 not in table.rows
    (fault,) = table.faults
    assert str(fault).startswith(f"{tmp_path / 'record.csv'}, row 6: ")
    assert words in str(fault)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("x,angle\n", "no row"),
        ("x\n1\n", "no column angle"),
        ("x,x_mm,angle\n1,1,1\n", "column x appears 2 times"),
        ("x,angle\n250,1\n-120,1\n0.1,1\n", "name the column x_mm"),
        ("x_mm,angle\n0.25,1\n-0.12,1\n", "name the column x_m "),
        ("x,angle\n0.2,90\n0.1,45\n", "name the column angle_deg"),
        ('x,angle\n"0.2,1\n', "not CSV"),
    ],
)
def test_an_invalid_file_is_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(RecordError) as caught:
        read_csv(file(tmp_path, text), COLUMNS)
    assert str(tmp_path / "record.csv") in str(caught.value)
    assert words in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"none\.csv: cannot be read"):
        read_csv(tmp_path / "none.csv", COLUMNS)


@given(text=st.text(alphabet="x,angle_0.5-\n\"';#\t\0é", max_size=80))
def test_any_text_is_read_within_the_ranges_or_refused(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    path = file(tmp_path_factory.mktemp("csv"), text)
    try:
        table = read_csv(path, COLUMNS)
    except RecordError as error:
        assert str(path) in str(error)
        return
    assert np.all(np.abs(table.values["x"]) <= 3.0)
    assert np.all(np.abs(table.values["angle"]) <= 7.0)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_are_read_if_no_number_has_a_decimal_point(
    tmp_path: Path, separator: str
) -> None:
    path = tmp_path / "a.csv"
    rows = ("x_mm;note", "1,5;a,b", "-2e1;c", ",25;d", "+1,0E-1;e")
    path.write_bytes(("\ufeff" + "\r\n".join(rows) + "\r\n").replace(";", separator).encode())
    table = read_csv(path, (Column("x", "m"),), texts=("note",))
    assert table.values["x"].tolist() == pytest.approx([0.0015, -0.020, 0.00025, 0.0001])
    assert table.texts["note"] == ("a,b", "c", "d", "e") and table.faults == ()
    # A decimal point elsewhere in the file shows that the comma separates thousands.
    path.write_text(f"x_mm{separator}y_mm\n1,250{separator}1.5\n3{separator}4\n5{separator}6\n")
    table = read_csv(path, (Column("x", "m"), Column("y", "m")))
    assert table.values["x"].tolist() == [1.25, 0.003, 0.005] and table.faults == ()


def refusal(folder: Path, text: str, columns: tuple[Column, ...] = COLUMNS) -> str:
    with pytest.raises(RecordError) as caught:
        read_csv(file(folder, text), columns)
    return str(caught.value)


PAIR = (Column("x", "m", -100.0, 100.0), Column("y", "m", -100.0, 100.0))


@pytest.mark.parametrize(
    ("text", "x"),
    [
        ("x_mm;y_mm;note, free\n0,5;1;a\n", [0.5]),
        ('x_mm,y_mm,"note; a\tb"\n0.5,1,a\n', [0.5]),
        ('"x_mm", "y_mm", "a, b"\n0.5, 1, "c, d"\n', [0.5]),
        ("sep=;\nx_mm;y_mm\n1,5;2\n", [1.5]),
        ('"sep=;"\nx_mm;y_mm\n1,5;2\n', [1.5]),
        ("sep=|\nx_mm|y_mm\n1.5|2\n", [1.5]),
        ("x_mm;y_mm;;\n1,5;2;;\n;;;\n2,5;3;;\n", [1.5, 2.5]),
        ("x_mm,y_mm\n1.000,2\n", [1.0]),
        ("x_mm\ty_mm\n1,000\t0.5\n", [1000.0]),
        ("x_mm\ty_mm\n1.000\t0,5\n", [1000.0]),
        ("x_mm;y_mm\n0,500;1\n2,000;1\n", [0.5, 2.0]),
        ("x_mm\ty_mm\ttemperature\n1,000\t1,5\t20\n2,000\t1,000\t20\n", [1.0, 2.0]),
        ("x_mm\ty_mm\ttemperature\n1,000\t2\t20.5\n", [1000.0]),
        ('x_mm,y_mm\n"1,234.5",2\n', [1234.5]),
        ('x_mm,y_mm\n"1,5",2\n', [1.5]),
        ("x_mm;y_mm\n1 234,5;2\n1\u202f000;2\n2'000;2\n", [1234.5, 1000.0, 2000.0]),
        ("x_mm;y_mm\n1.234.567,5;2\n", [1234567.5]),
        ("# c, d; e\nx_mm;y_mm\n# c\n1,5E1;2\n", [15.0]),
        ("# c\n# x_mm,y_mm\n1.5,2\n", [1.5]),
        ("# x_mm y_mm\n  1.5e+00   2.0e+00\n", [1.5]),
        ("x_mm , y_mm\n1.5 , 2\n", [1.5]),
        ("# x_mm and y_mm\nx_mm;y_mm\n1,5;2\n", [1.5]),
    ],
)
def test_separator_and_decimal_mark_are_decided_for_the_whole_file(
    tmp_path: Path, text: str, x: list[float]
) -> None:
    wide = tuple(Column(name, "m", -1e5, 1e5) for name in ("x", "y"))
    table = read_csv(file(tmp_path, text), wide)
    assert table.values["x"].tolist() == pytest.approx([1e-3 * value for value in x], rel=1e-12)
    assert table.faults == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x_mm\ty_mm\n1,000\t2\n", ("row 2: x_mm is '1,000'", "may be 1000 (", "or 1 (")),
        ("x_mm;y_mm\n1;2\n12.345;2\n", ("row 3: x_mm is '12.345'", "12.345", "or 12345 (")),
        ('x_mm,y_mm\n"1,000",2\n', ("'1,000'", "1000", "or 1 (")),
        ("x_mm;y_mm\n0.5;2\n0,5;2\n", ("row 3 has the number '0,5'", "row 2 has '0.5'", "same")),
        ("x_mm\0,y_mm\n1,2\n", ("NUL",)),
    ],
)
def test_a_file_with_two_readings_is_refused_with_both(
    tmp_path: Path, text: str, words: tuple[str, ...]
) -> None:
    message = refusal(tmp_path, text, PAIR)
    assert all(word in message for word in words), message


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "utf-8"])
def test_the_encodings_of_excel_are_read(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes("x_mm\ty_mm\tmaß\r\n0,5\t1\tä\r\n".encode(encoding))
    assert read_csv(path, PAIR).values["x"].tolist() == [0.0005]


@pytest.mark.parametrize(
    "name", ["energy_MJ", "Energy", "energy [mJ]", "energy_degrees", "energy(J)"]
)
def test_an_optional_column_with_a_similar_name_is_not_ignored(tmp_path: Path, name: str) -> None:
    message = refusal(tmp_path, f"x,angle,{name}\n0.2,1,5\n")
    assert repr(name) in message and "energy_mJ" in message
    table = read_csv(file(tmp_path, "x,angle,energy_note\n0.2,1,5\n"), COLUMNS)
    assert set(table.values) == {"x", "angle"}


def test_a_row_that_begins_with_an_error_of_excel_is_no_comment(tmp_path: Path) -> None:
    table = read_csv(file(tmp_path, "x_mm,y_mm\n1,2\n#DIV/0!,3\n#N/A,3\n# note\n"), PAIR)
    assert [fault.row for fault in table.faults] == [3, 4]


_NUMBERS = st.decimals(-99999, 99999, places=3, allow_nan=False, allow_infinity=False)


@given(
    numbers=st.lists(st.tuples(_NUMBERS, _NUMBERS), min_size=1, max_size=5),
    places=st.integers(0, 3),
    layout=st.sampled_from(
        [
            (",", ".", ""),
            (";", ",", ""),
            (";", ",", "."),
            ("\t", ".", ","),
            ("\t", ",", " "),
            (";", ".", ""),
            ("|", ".", "'"),
            ("\t", ",", "."),
            (",", ".", ","),
        ]
    ),
    excel=st.booleans(),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]),
    newline=st.sampled_from(["\n", "\r\n", "\r"]),
)
def test_a_written_table_is_read_exactly_or_refused_as_ambiguous(
    tmp_path_factory: pytest.TempPathFactory,
    numbers: list[tuple[Decimal, Decimal]],
    places: int,
    layout: tuple[str, str, str],
    excel: bool,
    encoding: str,
    newline: str,
) -> None:
    separator, mark, thousands = layout
    quantum = Decimal(1).scaleb(-places)
    rows = [tuple(value.quantize(quantum) for value in row) for row in numbers]

    def cell(value: Decimal) -> str:
        text = f"{value:,f}".replace(",", "T").replace(".", mark).replace("T", thousands)
        return f'"{text}"' if separator in text else text

    lines = [separator.join(("x_mm", '"y_mm"', f'"a{separator} b"'))]
    lines += [separator.join((cell(x), cell(y), "n")) for x, y in rows]
    lines[:0] = [f"sep={separator}"] if excel else []
    path = tmp_path_factory.mktemp("csv") / "table.csv"
    path.write_bytes((newline.join(lines) + newline).encode(encoding))
    try:
        table = read_csv(path, PAIR)
    except RecordError as error:
        assert "and both fit the whole file" in str(error)
        return
    expected = [[float(x) * 1e-3, float(y) * 1e-3] for x, y in rows]
    assert table.columns("x", "y").tolist() == expected
