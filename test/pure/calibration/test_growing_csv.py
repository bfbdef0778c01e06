"""Records are written row by row: no row is lost or overwritten."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tapping_cell.calibration.csv_table import Column, RecordError, read_csv
from tapping_cell.calibration.growing_csv import GrowingCsv

HEADER = ("energy", "distance")
COLUMNS = (Column("energy", "J"), Column("distance", "m"))


def test_rows_are_read_back_unchanged_and_appended_to(tmp_path: Path) -> None:
    path = tmp_path / "new" / "taps.csv"
    growing = GrowingCsv(path, HEADER, resume=False)
    assert growing.rows == 0
    growing.append((0.001, 1 / 3))
    assert growing.rows == 1
    GrowingCsv(path, HEADER, resume=True).append((0.002, 0.5))
    assert GrowingCsv(path, HEADER, resume=True).rows == 2
    table = read_csv(path, COLUMNS)
    np.testing.assert_allclose(table.columns(*HEADER), [[0.001, 1 / 3], [0.002, 0.5]], rtol=1e-8)


def test_an_existing_file_is_neither_overwritten_nor_mixed(tmp_path: Path) -> None:
    path = tmp_path / "taps.csv"
    path.write_text("# by hand\nenergy,distance\n0.1,0.2", encoding="utf-8")
    with pytest.raises(RecordError, match="--resume"):
        GrowingCsv(path, HEADER, resume=False)
    with pytest.raises(RecordError, match="another name"):
        GrowingCsv(path, ("energy", "travel"), resume=True)
    # If the last line has no newline, one is added before the new row.
    GrowingCsv(path, HEADER, resume=True).append((0.3, 0.4))
    assert len(read_csv(path, COLUMNS).rows) == 2
    with pytest.raises(ValueError, match="2 columns"):
        GrowingCsv(path, HEADER, resume=True).append((0.3,))


def test_a_file_in_another_encoding_is_not_continued(tmp_path: Path) -> None:
    path = tmp_path / "taps.csv"
    content = "# Käse\nenergy,distance\n0.1,0.2\n".encode("latin-1")
    path.write_bytes(content)
    with pytest.raises(RecordError, match=r"taps\.csv: .* is not UTF-8 text; save it as CSV"):
        GrowingCsv(path, HEADER, resume=True)
    assert path.read_bytes() == content
