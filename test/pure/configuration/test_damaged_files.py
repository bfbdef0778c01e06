"""Damaged files of every kind are refused in one sentence, or read as an independent reader reads
them."""

from __future__ import annotations

import math
import re
import tempfile
import time
from decimal import Decimal
from pathlib import Path
from xml.dom import minidom

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.cli.check_config import check
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import load_object
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.configuration.table import load_camera_model
from tapping_cell.hardware.chain_urdf import chain_from_urdf

URDF = Path(__file__).parents[3] / "examples" / "six_axis_cell" / "six_axis_arm.urdf"
LONGEST_S = 2.0
NUMBER = re.compile(r"(?<![\w.])-?\d+\.\d+|(?<![\w.])-?\d+(?![\w.])")
WRITTEN = st.sampled_from(
    [
        "0,5",
        "1_0",
        "011",
        "0x10",
        "1:30",
        "1e-2",
        "\u22120.5",
        "1 000",
        "5 mm",
        "90",
        "1e999",
        ".nan",
        "",
        "[",
        "{",
        "*a",
        "&a 1",
        "!!x",
        "true",
        "no",
        "-180",
        "300",
        "0.0",
        "12.5",
        "\t1",
        "\xa01",
    ]
) | st.floats(-1e4, 1e4).map(lambda value: f"{value:.6g}")
EDITS = st.lists(st.tuples(st.integers(0, 200), WRITTEN), min_size=1, max_size=3)
CUTS = st.lists(
    st.tuples(st.integers(0, 100), st.sampled_from(["drop", "double", "swap", "indent"])),
    max_size=2,
)


def damaged(text: str, edits: list[tuple[int, str]], cuts: list[tuple[int, str]]) -> str:
    """Replace numbers of a text, then drop, repeat, exchange or indent lines."""
    for place, new in edits:
        found = list(NUMBER.finditer(text))
        match = found[place % len(found)] if found else re.search("^", text)
        assert match is not None
        text = text[: match.start()] + new + text[match.end() :]
    lines = text.split("\n")
    for place, what in cuts:
        k = place % len(lines)
        if what == "drop":
            lines[k] = ""
        elif what == "double":
            lines.insert(k, lines[k])
        elif what == "swap":
            lines[k], lines[k - 1] = lines[k - 1], lines[k]
        else:
            lines[k] = "  " + lines[k]
    return "\n".join(lines)


def numbers_at(text: str, key: str) -> list[float]:
    """Read the numbers of a key written on one line, independently of the YAML reader."""
    line = next(line for line in text.split("\n") if re.match(rf"\s*{key}:", line))
    value = line.split(":", 1)[1].split("#")[0].strip(" []")
    return [float(Decimal(word.strip())) for word in value.split(",")]


FILES = ("cell.yaml", "table.yaml", "objects/aluminium_square.yaml", "truth/everything.yaml")


@given(file=st.sampled_from(FILES), edits=EDITS, cuts=CUTS)
def test_every_damaged_file_is_refused_in_time_or_read(
    file: str, edits: list[tuple[int, str]], cuts: list[tuple[int, str]]
) -> None:
    source = shared_folder() / file
    text = damaged(source.read_text(encoding="utf-8"), edits, cuts)
    began = time.process_time()
    for sentence in findings(text, "file.yaml"):
        assert "\n" not in sentence and len(sentence) < 3000
    assert time.process_time() - began < LONGEST_S


def findings(text: str, name: str) -> list[str]:
    """Return the errors of a text that check-config finds in the file alone."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_text(text, encoding="utf-8")
        return [sentence for entry in check(path) for sentence in entry.errors]


@given(edits=EDITS, cuts=CUTS)
def test_an_accepted_object_has_the_numbers_of_its_text(
    tmp_path_factory: pytest.TempPathFactory,
    edits: list[tuple[int, str]],
    cuts: list[tuple[int, str]],
) -> None:
    source = shared_folder() / "objects" / "aluminium_disk.yaml"
    path = tmp_path_factory.mktemp("object") / "object.yaml"
    path.write_text(damaged(source.read_text(encoding="utf-8"), edits, cuts), encoding="utf-8")
    try:
        read = load_object(path)
    except ConfigurationError:
        return
    text = path.read_text(encoding="utf-8")
    for key, value in (
        ("mass", read.mass),
        ("height", read.height),
        ("friction", read.friction),
        ("radius", read.shape.radius),
        ("restitution", read.restitution),
    ):
        assert numbers_at(text, key) == [value]
    assert read.marker is not None and numbers_at(text, "id") == [read.marker.id]


@given(edits=EDITS, cuts=CUTS)
def test_an_accepted_camera_has_the_numbers_of_its_text(
    tmp_path_factory: pytest.TempPathFactory,
    edits: list[tuple[int, str]],
    cuts: list[tuple[int, str]],
) -> None:
    source = shared_folder() / "camera_info.yaml"
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    path.write_text(damaged(source.read_text(encoding="utf-8"), edits, cuts), encoding="utf-8")
    began = time.process_time()
    try:
        camera = load_camera_model(path)
    except ConfigurationError:
        return
    finally:
        assert time.process_time() - began < LONGEST_S
    text = path.read_text(encoding="utf-8")
    assert numbers_at(text, "image_width") == [camera.width]
    assert abs(camera.cx / camera.width - 0.5) < 0.13
    after = text[text.index("camera_matrix:") :]
    assert numbers_at(after, "data") == camera.matrix.ravel().tolist()


NAMES = tuple(f"joint_{number}" for number in range(1, 7))


@given(edits=EDITS, cuts=CUTS)
def test_an_accepted_urdf_has_the_numbers_of_its_text(
    edits: list[tuple[int, str]], cuts: list[tuple[int, str]]
) -> None:
    text = damaged(URDF.read_text(encoding="utf-8"), edits, cuts)
    began = time.process_time()
    try:
        chain = chain_from_urdf(text, "base_link", "flange", NAMES, np.eye(4), np.eye(4))
    except ValueError as error:
        assert str(error)
        return
    finally:
        assert time.process_time() - began < LONGEST_S
    joints = {
        element.getAttribute("name"): element
        for element in minidom.parseString(text).getElementsByTagName("joint")
    }
    for joint in chain.joints:
        (limit,) = joints[joint.name].getElementsByTagName("limit")[:1]
        assert joint.upper == float(Decimal(limit.getAttribute("upper") or "0"))
        assert joint.lower == float(Decimal(limit.getAttribute("lower") or "0"))
        assert joint.max_speed == float(Decimal(limit.getAttribute("velocity")))
        assert max(abs(joint.lower), abs(joint.upper)) < 2.01 * math.tau
