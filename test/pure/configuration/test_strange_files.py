"""Malformed camera and table files are refused with file, key and value."""

from __future__ import annotations

from pathlib import Path

import pytest

from tapping_cell.cli import main
from tapping_cell.configuration.schema import ConfigurationError, read_yaml
from tapping_cell.configuration.table import load_camera_model, load_reference_map

CONFIG = Path(__file__).parents[3] / "config"
TABLE = (CONFIG / "table.yaml").read_text()
CAMERA = (CONFIG / "camera_info.yaml").read_text()


def refusal(load, path: Path, content: str) -> str:
    path.write_text(content)
    with pytest.raises(ConfigurationError) as caught:
        load(path)
    assert str(path) in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[" * 3000 + "]" * 3000, "nested too deeply"),
        ("{[1, 2]: 3}", "a key must be a word"),
        ("a: " + "9" * 6000, "6000 digits"),
        ("[" * 400_000, "nested too deeply"),
        ("a: &a [*a]", "alias *a has no anchor before it"),
        ("a: 1\n---\nb: 2", "line 2, column 1: a second document"),
        ("a: !!python/tuple [1]", "tag:yaml.org,2002:python/tuple is not supported"),
        (
            "a: &a [1,2,3,4,5,6,7,8,9]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a]\n"
            "c: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b]\nd: &d [*c,*c,*c,*c,*c,*c,*c,*c,*c]\n"
            "e: &e [*d,*d,*d,*d,*d,*d,*d,*d,*d]\nf: [*e,*e,*e,*e,*e,*e,*e,*e,*e]",
            "more than 100000 values",
        ),
        ("# " + "x" * 1_100_000, "has 1.1 MB"),
    ],
)
def test_malformed_files_are_refused_with_a_message(tmp_path, content, words):
    assert words in refusal(read_yaml, tmp_path / "file.yaml", content)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("x: 0.00, y: 0.25", "x: -0.33, y: 0.26", "101 and 102 lie 10.0 mm apart"),
        ("x: -0.33", "x: " + "9" * 400, "must be -10 to 10 m"),
    ],
)
def test_an_impossible_table_is_refused(tmp_path, old, new, words):
    assert words in refusal(load_reference_map, tmp_path / "table.yaml", TABLE.replace(old, new, 1))


def test_a_table_with_one_reference_marker_is_refused(tmp_path):
    one = "dictionary: 4X4_50\nmarkers:\n  - {id: 1, size: 0.04, x: 0.0, y: 0.0}\n"
    assert "lists 1" in refusal(load_reference_map, tmp_path / "table.yaml", one)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("639.5", "abc", "'camera_matrix.data[2]' is 'abc'"),
        ("-0.12", "abc", "'distortion_coefficients.data[0]' is 'abc'"),
        ("image_width: 1280", "image_width: 12.5", "'image_width' is 12.5"),
        ("image_width: 1280", "image_width: 1000000000", "too large"),
        ("1150.0, 0.0, 639.5", "1150.0, 9.0, 639.5", "number 1 (from 0) of the camera matrix is 9"),
        ("639.5", "-90000.0", "cx is -90000 pixels"),
        ("data: [1150", "date: [1150", "'camera_matrix.data'"),
        (CAMERA, "[1]", "must be a mapping"),
        ("image_width: 1280", "image_width: .inf", "key 'image_width' is inf"),
        ("image_width: 1280", "image_width: .nan", "key 'image_width' is nan"),
        ("image_width: 1280", "image_width: " + "9" * 400, "key 'image_width' is an integer"),
        ("639.5", ".inf", "key 'camera_matrix.data[2]' is inf"),
        ("639.5", "9" * 400, "key 'camera_matrix.data[2]' is an integer"),
        ("-0.12", "9" * 400, "key 'distortion_coefficients.data[0]' is an integer"),
        (
            "image_width",
            "calibration: {deviations: {fx: 0.1, fy: " + "9" * 400 + "}}\nimage_width",
            "key 'calibration.deviations.fy' is an integer",
        ),
    ],
)
def test_an_impossible_camera_is_refused(tmp_path, old, new, words):
    message = refusal(load_camera_model, tmp_path / "camera.yaml", CAMERA.replace(old, new, 1))
    assert words in message


def test_files_written_on_windows_are_read(tmp_path):
    path = tmp_path / "table.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + TABLE.replace("\n", "\r\n").encode())
    assert load_reference_map(path) == load_reference_map(CONFIG / "table.yaml")


def test_an_object_with_a_marker_of_the_table_is_refused(tmp_path, capsys):
    path = tmp_path / "object.yaml"
    path.write_text(
        "shape: {kind: disk, radius: 0.048}\nheight: 0.012\n"
        "marker: {dictionary: tag36h11, id: 101, size: 0.05, offset: [0.0, 0.0, 0.0]}\n"
    )
    assert main(["locate", "none.png", "--object", str(path)]) == 2
    message = capsys.readouterr().err
    assert "key 'marker.id' is 101" in message and str(path) in message
