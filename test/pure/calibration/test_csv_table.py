"""CSV records are converted to SI units, and each fault is reported with file and row."""

from __future__ import annotations

import math
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
