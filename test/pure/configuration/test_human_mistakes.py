"""Common mistakes of people in the shipped files are refused, with the cause and the remedy."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tapping_cell.cli.check_config import check
from tapping_cell.configuration.files import shared_folder

DISK, SQUARE = "objects/aluminium_disk.yaml", "objects/aluminium_square.yaml"
CELL, TABLE, CAMERA = "cell.yaml", "table.yaml", "camera_info.yaml"

MISTAKES = [
    (DISK, "radius: 0.048", "radius: 48", "if the value is in mm, write 0.048"),
    (DISK, "radius: 0.048", "radius: 4.8", "if the value is in cm, write 0.048"),
    (DISK, "radius: 0.048", "radius: 0.096", "the radius may be a diameter"),
    (DISK, "radius: 0.048", "radius: 0,048", "write a decimal point: 0.048"),
    (DISK, "radius: 0.048", "radius: 48 mm", "write the number without 'mm', in m"),
    (DISK, "radius: 0.048", "diameter: 0.096", "unknown key 'shape.diameter'"),
    (DISK, "radius: 0.048", 'radius: "0.048"', "remove the quotes: 0.048"),
    (DISK, "mass: 0.2455", "mass: 245.5", "if the value is in g, write 0.2455"),
    (DISK, "mass: 0.2455", "mass: 24.55", "density of 282"),
    (DISK, "mass: 0.2455", "mass: 2.455", "outside 200 to 23000 kg/m3"),
    (DISK, "mass: 0.2455", "mas: 0.2455", "unknown key 'mas'; did you mean 'mass'?"),
    (DISK, "height: 0.012", "height: 0.12", "mass or height may be wrong by a factor of 10"),
    (DISK, "height: 0.012", "height: \u22120.012", "replace the minus sign (U+2212)"),
    (DISK, "friction: 0.17", "friction: 17", "must be 0.01 to 2"),
    (DISK, "restitution: 0.86", "restitution: 1.2", "must be 0 to 1"),
    (DISK, "restitution: 0.86", "restitution: 86 %", "write the number without '%'"),
    (DISK, "kind: disk", "kind: Disc", "did you mean 'disk'?"),
    (DISK, "id: 1\n", "id: 01\n", "'01' starts with 0"),
    (DISK, "id: 1\n", "id: 1.0\n", "write 1"),
    (DISK, "size: 0.050", "size: 0.500", "extends beyond the object's outline by"),
    (DISK, "name: aluminium disk", "name: 7", "put it in quotes"),
    (DISK, "APRILTAG_36h11", "\u201cAPRILTAG_36h11\u201d", "left double quotation mark (U+201C)"),
    (DISK, "\n  kind: disk", "\n\tkind: disk", "indent with spaces, not with tabs"),
    (DISK, "  kind: disk", "\u00a0\u00a0kind: disk", "no-break space (U+00A0)"),
    (SQUARE, "[[-0.04, -0.04]", "[[-0,04, -0.04]", "starts with 0"),
    (SQUARE, "size: 0.050", "size: 0.085", "extends beyond the object's outline by"),
    (CELL, "dialect: grbl", "dialect: Grbl 1.1", "did you mean 'grbl'?"),
    (CELL, "dialect: grbl", "dialect: grblHAL", "did you mean 'grbl'?"),
    (CELL, "baud: 115200", "baud: 115_200", "contains underscores"),
    (CELL, "baud: 115200", "baud: 115.200", "whole number"),
    (CELL, "baud: 115200", "baud: 115,200", "115.200 or 115200, without a comma"),
    (CELL, "quill_brake: true", "quill_brake: yes", "write true"),
    (CELL, "base: [0.0, 0.47, -1.5707963]", "base: [0.0, 0.47, -90]", "angle in rad"),
    (CELL, "base: [0.0, 0.47,", "base: [0,0, 0.47,", "write '0, 0' or '0.0'"),
    (CELL, "  homing: firmware", "  homming: firmware", "did you mean 'homing'?"),
    (CELL, "  max_taps: 40", "max_taps: 40", "did you mean 'goal.max_taps'? Check the indentation"),
    (CELL, "mass: 0.100", "mass: 1.0", "more than the charged"),
    (CELL, "speeds: [0.02, ", "speeds: [0.2, ", "does not rise"),
    (CELL, "energies: [0.00002, 0.0005, ", "energies: [0.0005, ", "give one speed for each"),
    (CELL, "park: [1.2, 1.2, -0.020, 0.0]", "park: 1.2, 1.2, -0.02, 0", "put the entries in bra"),
    (CELL, "length: 0.60", "length: 600", "if the value is in mm, write 0.6"),
    (CELL, "angle_tolerance: 0.01745329252", "angle_tolerance: pi/180", "not evaluated"),
    (CELL, "angle_tolerance: 0.01745329252", "angle_tolerance: 1\u00b0", "in rad"),
    (CELL, "angle_tolerance: 0.01745329252", "angle_tolerance: 2", "is in deg, write 0.0349066"),
    (TABLE, "size: 0.040, x: -0.33", "size: 40, x: -0.33", "if the value is in mm, write 0.04"),
    (TABLE, "size: 0.040, x: 0.00", "size: 0.400, x: 0.00", "most have 40.0 mm"),
    (TABLE, "x: 0.33, y: 0.25", "x: 0,33, y: 0.25", "unknown key"),
    (TABLE, "theta: 0.0}", "theta: 90}", "if the value is in deg, write 1.5708"),
    (TABLE, "id: 102", "id: 101", "101"),
    (CAMERA, "image_width: 1280", "image_width: 1920", "fits an image of about 1279 x 1023"),
    (CAMERA, "1150.0, 0.0, 639.5", "4.0, 0.0, 639.5", "4.0 and 1150.0 pixels differ"),
    (CAMERA, "[1150.0, 0.0, 639.5, 0.0, 1150.0", "[4.0, 0.0, 639.5, 0.0, 4.0", "must be in pixels"),
    (CAMERA, "-0.12, 0.08", "-1.2, 0.08", "folds back inside the image"),
    (CAMERA, "639.5", "639,5", "'639,5' may be two numbers or 639.5"),
]


@pytest.mark.parametrize(("file", "old", "new", "words"), MISTAKES)
def test_a_common_mistake_is_refused_with_cause_and_remedy(
    file: str, old: str, new: str, words: str, tmp_path: Path
) -> None:
    folder = tmp_path / "config"
    shutil.copytree(shared_folder(), folder)
    path = folder / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    errors = [sentence for found in check(path) for sentence in found.errors]
    assert any(words in sentence for sentence in errors), errors
    assert all(str(path) in sentence for sentence in errors), errors
