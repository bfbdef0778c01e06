"""Common mistakes of people in the shipped files are refused, with the cause and the remedy."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from tapping_cell.cli import main
from tapping_cell.cli.check_config import check
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import load_object
from tapping_cell.vision.outline.shape import signed_area

DISK, SQUARE = "objects/aluminium_disk.yaml", "objects/aluminium_square.yaml"
CELL, TABLE, CAMERA = "cell.yaml", "table.yaml", "camera_info.yaml"
FIXED = "positioning_cell/cell.yaml"
SIX, ARM = (f"../examples/six_axis_cell/{name}" for name in ("cell.yaml", "six_axis_arm.urdf"))
EXAMPLES = Path(__file__).parents[3] / "examples"
CORNERS = "[[-0.04, -0.04], [0.04, -0.04], [0.04, 0.04], [-0.04, 0.04]]"
CLOCKWISE = "[[-0.04, 0.04], [0.04, 0.04], [0.04, -0.04], [-0.04, -0.04]]"
CROSSED = "[[-0.04, -0.04], [0.04, -0.04], [-0.04, 0.04], [0.04, 0.04]]"
BOW_TIE = "[[0.1, 0.1], [0.2, 0.2], [0.2, 0.1], [0.1, 0.2]]"
LIMITS = "lower: [-2.3, -2.6, -0.148, -3.5]\n  upper: [2.3, 2.6, 0.0, 3.5]"
ENERGIES = "[0.00002, 0.0005, 0.005, 0.05, 0.3125]"
SPEEDS = "[0.02, 0.1, 0.3162278, 1.0, 2.5]"
CURVE = f"energies: {ENERGIES}   # J: v = sqrt(2 E / m)\n  speeds: {SPEEDS}"
SWAPPED = "lower: [2.3, 2.6, 0.0, 3.5]\n  upper: [-2.3, -2.6, -0.148, -3.5]"
SIZE = "image_width: 1280\nimage_height: 1024"
MATRIX = "[1150.0, 0.0, 639.5, 0.0, 1150.0, 511.5, 0.0, 0.0, 1.0]"
XACRO = "http://www.ros.org/wiki/xacro"

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
    (DISK, "friction: 0.17", "friction: 17", "if the value is in percent, write 0.17"),
    (DISK, "restitution: 0.86", "restitution: 1.2", "must be 0 to 1"),
    (DISK, "restitution: 0.86", "restitution: 86 %", "write 0.86"),
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
    (CELL, "base: [0.0, 0.47, -1.5707963]", "base: [0.0, 0.47, -90]", "is in deg, write -1.57"),
    (CELL, "base: [0.0, 0.47,", "base: [0,0, 0.47,", "write '0, 0' or '0.0'"),
    (CELL, "  homing: firmware", "  homming: firmware", "did you mean 'homing'?"),
    (CELL, "  max_taps: 40", "max_taps: 40", "did you mean 'goal.max_taps'? Check the indentation"),
    (CELL, "mass: 0.100", "mass: 1.0", "more than the charged"),
    (CELL, "speeds: [0.02, ", "speeds: [0.2, ", "does not rise"),
    (CELL, "energies: [0.00002, 0.0005, ", "energies: [0.0005, ", "give one speed for each"),
    (CELL, "park: [1.2, 1.2, -0.020, 0.0]", "park: 1.2, 1.2, -0.02, 0", "put the entries in bra"),
    (CELL, "length: 0.60", "length: 600", "if the value is in mm, write 0.6"),
    (CELL, "angle_tolerance: 0.01745329252", "angle_tolerance: pi/180", "not evaluated"),
    (CELL, "angle_tolerance: 0.01745329252", "angle_tolerance: deg(1)", "not evaluated"),
    (CELL, "angle_tolerance: 0.01745329252", "angle_tolerance: !degrees 1", "angles in rad"),
    (CELL, "angle_tolerance: 0.01745329252", "angle_tolerance: 1\u00b0", "in rad"),
    (CELL, "angle_tolerance: 0.01745329252", "angle_tolerance: 1.0", "is in deg, write 0.0174"),
    (TABLE, "size: 0.040, x: -0.33", "size: 40, x: -0.33", "if the value is in mm, write 0.04"),
    (TABLE, "size: 0.040, x: 0.00", "size: 0.400, x: 0.00", "most have 40.0 mm"),
    (TABLE, "x: 0.33, y: 0.25", "x: 0,33, y: 0.25", "unknown key"),
    (TABLE, "theta: 0.0}", "theta: 90}", "if the value is in deg, write 1.5708"),
    (TABLE, "id: 102", "id: 101", "101"),
    (CAMERA, "image_width: 1280", "image_width: 1920", "fits an image of about 1280 x 1024"),
    (CAMERA, "1150.0, 0.0, 639.5", "4.0, 0.0, 639.5", "4.0 and 1150.0 pixels differ"),
    (CAMERA, "[1150.0, 0.0, 639.5, 0.0, 1150.0", "[4.0, 0.0, 639.5, 0.0, 4.0", "must be in pixels"),
    (CAMERA, "-0.12, 0.08", "-1.2, 0.08", "folds back inside the image"),
    (CAMERA, "639.5", "639,5", "'639,5' may be two numbers or 639.5"),
    (DISK, "\nfriction: 0.17 ", "\nfriction: 17% ", "; write 0.17"),
    (DISK, "rotation: 0.15", "rotation: 15", "if the value is in percent, write 0.15"),
    (DISK, "radius: 0.048", "radius: 0.024", "the name says 'aluminium'"),
    (DISK, "torque_factor", "mass: 1\ntorque_factor", "first in line 7; delete one of them"),
    (SQUARE, CORNERS, CROSSED, "at vertex 2 [-0.04, 0.04]"),
    (SQUARE, CORNERS, "[[0, 0], [0.08, 0], [0.08, 0.08], [0, 0.08]]", "subtract [0.04, 0.04]"),
    (CELL, "upper_arm: 0.425", "upper_arm: 425", "if the value is in mm, write 0.425"),
    (CELL, LIMITS, SWAPPED, "exchange 'low"),
    (CELL, "  baud: 115200", "  baud: 112500", "did you mean 115200?"),
    (CELL, "strike_height: 0.006", "strike_height: 6 mm", "write the number without 'mm', in m"),
    (CELL, ENERGIES, "[0.02, 0.5, 5.0, 50.0, 312.5]", "are in mJ, divide them by 1000"),
    (
        CELL,
        "  tip_height",
        "<<<<<<< HEAD\n  tip_height",
        "line 23 is the marker <<<<<<< of a merge",
    ),
    (CELL, "\ncamera:\n", f"\nkeep_outs:\n  polygons: [{BOW_TIE}]\n\ncamera:\n", "order along the"),
    (
        FIXED,
        "direction: -2.3561945",
        "direction: 2.3561945",
        "line of travel of 'northeast' does not",
    ),
    (CAMERA, "image_width: 1280", "image_width: 640", "about 1280 x 1024 pixels, not 640 x 1024"),
    (CAMERA, SIZE, "image_width: 1024\nimage_height: 1280", "image_width and image_height, or cx"),
    (
        CAMERA,
        MATRIX,
        "[1150.0, 0.0, 0.0, 0.0, 1150.0, 0.0, 639.5, 511.5, 1.0]",
        "transposed, as in M",
    ),
    (CAMERA, MATRIX, "[575.0, 0.0, 319.5, 0.0, 575.0, 255.5, 0.0, 0.0, 1.0]", "about 640 x 512"),
    (CAMERA, "rows: 1", "rows: 2", "2 rows and 5 cols, but 5 numbers"),
    (CAMERA, "-0.0003, 0.0]", "-0.0003, .nan]", "must be a finite number; calibrate"),
    (ARM, 'name="six_axis_arm"', f'xmlns:xacro="{XACRO}" name="${{n}}"', "expand the xacro file"),
    (
        ARM,
        '<parent link="link_4"/>',
        '<parent link="link_3"/>',
        "the parent of joint_5, which is l",
    ),
    (ARM, 'lower="-2.97"', 'lower="-170"', "if it is in degrees, write -2.96706"),
    (ARM, '"joint_4"', '"joint_four"', "it has no joint joint_4"),
    (SIX, "tip_link: flange", "tip_link: tool0", "its links are base_link, flange"),
    (DISK, "mass: 0.2455", "mass: 02.Apr", "a spreadsheet has turned the number into a date"),
    (DISK, "mass: 0.2455", "mass: 1.2.2026", "a spreadsheet has turned the number into a date"),
    (SQUARE, "[-0.04, 0.04]]", "[-0.04, 0.04], [-0.04, -0.04]]", "appears twice; delete it"),
    (CAMERA, "image_width", "%YAML:1.0\n---\nimage_width", "of OpenCV's cv::FileStorage"),
    (CELL, "upper_arm: 0.425", "upper_arm: 16.73", "if the value is in inches, write 0.424942"),
    (CELL, "max_speed: [2.0", "max_speed: [90", "in deg/s, write 1.571 here"),
    (CELL, "max_acceleration: [8.0", "max_acceleration: [460", "in deg/s^2, write 8.029 here"),
    (SIX, "max_acceleration: [6.0", "max_acceleration: [344", "in deg/s^2, write 6.004 here"),
    (SIX, "urdf: six", "urdf: package://arm/six", "the path of the URDF file, relative to this f"),
    (CELL, "angle_noise: 0.0009", "angle_noise: 0.05", "if the value is in deg, write 0.000872665"),
    (CELL, "port: ~/.ros/tapping_cell/{cell}/arm", "port: ttyUSB0", "write /dev/ttyUSB0 if it is"),
    (
        CAMERA,
        "cols: 5\n  data: [-0.12, ",
        "cols: 8\n  data: [0, 0, 0, -0.12, ",
        "rational_polynomial",
    ),
    (CELL, CURVE, f"energies: {SPEEDS}\n  speeds: {ENERGIES}", "seem to be exchanged"),
    (CELL, "\ncamera:\n", "\nkeep_outs:\n  circles: [0.2, 0.1, 0.03]\n\ncamera:\n", "in brackets"),
    (
        CELL,
        "\ntable:\n",
        "\nobjects: objects/plexiglas_disk.yaml\n\ntable:\n",
        "in brackets: [...]",
    ),
    (CELL, "\ntable:\n", "\nobjects:\n  disk: plexiglas_disk.yaml\n\ntable:\n", "entry with '- '"),
    (TABLE, "APRILTAG_36h11", "4X4_50", "correct the id or the dictionary"),
    (SQUARE, "kind: polygon", "kind: square", "a square or rectangle is a polygon"),
    (DISK, "\nfriction: 0.17 ", "\nfriction: 9.6 ", "tangent of the friction angle"),
    (DISK, "direction: 0.01745 ", "direction: 0.5 ", "if the value is in deg, write 0.00872665"),
    (CAMERA, "639.5, 0.0, 1150.0, 511.5", "511.5, 0.0, 1150.0, 639.5", "or cx and cy, seem to be"),
    (CAMERA, "distortion_model", "camera_model", "if 'camera_model' is meant, rename it"),
    (CAMERA, "-0.12, 0.08, 0.0004,", "-0.12 0.08 0.0004", "put commas between the numbers"),
    (CELL, "[0.0, 0.47, -1.5707963]", "[0.0 0.47 -1.5707963]", "put commas between the numbers"),
    (DISK, "\nfriction: 0.17 ", "\nfriction = 0.17 ", "write 'key: value', not 'friction = 0...'"),
    (CELL, "  baud: 115200", "  baud:115200", "write a space after the colon in 'baud:115200'"),
    (
        DISK,
        "shape:\n  kind: disk\n  radius: 0.048",
        "shape: {kind:disk}",
        "a space after its colon",
    ),
    (CELL, "port: ~/.ros/tapping_cell/{cell}/arm", "port: /dev/ttyUSB0:115200", "'baud: 115200'"),
    (SIX, "base_link\n      tip_link: flange", "flange\n      tip_link: base_link", "be exchanged"),
    (CELL, "  mass: 0.100", "  mass\u200b: 0.100", "'; delete the zero width space (U+200B)"),
    (CAMERA, "image_width", "image_width\u200b", "rename it; delete the zero width space"),
    (CELL, "name: tapping cell", "```yaml\nname: tapping cell", "delete the lines with ```"),
    (CELL, "# The simulated", "version https://git-lfs.github.com\n# T", "with `git lfs pull`"),
    (DISK, "\nfriction: 0.17 ", "\nfriction: ~0.2 ", "write the number alone: 0.2"),
    (DISK, "\nfriction: 0.17 ", "\nfriction: 0.17 \u00b1 0.02 ", "write the number alone: 0.17"),
    (CELL, "port: ~/.ros/tapping_cell/{cell}/arm", "port: /dev/ttyUSB*", "contains wildcards"),
    (CELL, "dialect: grbl", "dialect: marlin\n  grbl_settings: [[23, 3]]", "by the dialect marlin"),
    (
        CELL,
        "  home: [0.0, 1.5707963, 0.0, 0.0]",
        "  home: [0.0, 1.5707963, 0.0, 0.0]\n  home_place: [0.0, 1.5707963, 0.0, 0.0]",
        "the same as arm.home, which is in rad",
    ),
    (CELL, "tip_height: 0.150", "tip_height: 0.250", "lowers the tip to 102.0 mm at the lowest"),
    (CAMERA, MATRIX, "[9e3, 0, 7e3, 0, 9e3, 6e3, 0, 0, 1]", "an image of about 14001 x 12001 pix"),
    (CAMERA, MATRIX, "[0.9, 0, 0.5, 0, 1.1, 0.5, 0, 0, 1]", "multiply shares of the image's size"),
    (
        SIX,
        "urdf: six",
        "urdf: examples/six_axis_cell/six",
        "six_axis_arm.urdf' exists: a path in a",
    ),
    (CAMERA, MATRIX, "[[1150, 0, 639.5], [0, 1150, 511.5], [0, 0, 1]]", "its numbers in one list"),
]


@pytest.mark.parametrize(("file", "old", "new", "words"), MISTAKES)
def test_a_common_mistake_is_refused_with_cause_and_remedy(
    file: str, old: str, new: str, words: str, tmp_path: Path
) -> None:
    folder = tmp_path / "config"
    shutil.copytree(shared_folder(), folder)
    shutil.copytree(EXAMPLES, tmp_path / "examples")
    path = (folder / file).resolve()
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    checked = path.with_name("cell.yaml") if file == ARM else path
    errors = [sentence for found in check(checked) for sentence in found.errors]
    assert any(words in sentence for sentence in errors), errors
    assert all(str(path) in sentence for sentence in errors), errors


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("object: objects/", "object: objects\\", "did you mean '{}/objects/aluminium_disk.yaml'?"),
        ("objects/aluminium_disk.yaml", "aluminium disk", "mean 'objects/aluminium_disk.yaml'?"),
        ("object: objects/", "object: config/objects/", "'{}/objects/aluminium_disk.yaml' exists"),
        ("camera_info.yaml", "file:///home/ann/head.yaml", "in place of the address file://"),
        ("object: objects/aluminium_disk.yaml", "object: parameters.yaml", "kind parameters, but"),
        ("aluminium_disk", "Aluminium_Disk", "did you mean 'aluminium_disk.yaml'?"),
        (
            "markers: table.yaml",
            "markers: camera_info.yaml",
            "the kind camera_info, but the kind table is",
        ),
        (
            "info: camera_info.yaml",
            "info: table.yaml",
            "the kind table, but the kind camera_info is",
        ),
        (
            "object: objects/aluminium_disk.yaml",
            "object: cell.yaml",
            "of the kind cell, but the kind object is",
        ),
    ],
)
def test_a_wrong_path_in_a_cell_file_is_refused_with_one_sentence(
    old: str, new: str, words: str, tmp_path: Path
) -> None:
    folder = tmp_path / "config"
    shutil.copytree(shared_folder(), folder)
    text = (folder / CELL).read_text(encoding="utf-8")
    assert old in text
    (folder / CELL).write_text(text.replace(old, new, 1), encoding="utf-8")
    (error,) = [sentence for found in check(folder / CELL) for sentence in found.errors]
    assert words.format(folder) in error


def test_a_lens_with_the_third_radial_coefficient_before_the_tangential_ones_is_a_warning(
    tmp_path: Path,
) -> None:
    text = (shared_folder() / CAMERA).read_text(encoding="utf-8")
    path = tmp_path / CAMERA
    path.write_text(text.replace("0.08, 0.0004, -0.0003, 0.0]", "0.08, -0.02, 0.0004, -0.0003]"))
    (found,) = check(path)
    assert not found.errors
    assert "the order, which is k1, k2, p1, p2, k3" in found.warnings[0]
    assert check(shared_folder() / CAMERA)[0].warnings == []


FASTEST = "max_speed: [2.0, 2.5, 0.25, 6.0]\n  max_acceleration: [8.0, 10.0, 2.0, 30.0]"
EXCHANGED = "max_speed: [8.0, 10.0, 2.0, 30.0]\n  max_acceleration: [2.0, 2.5, 0.25, 6.0]"
NORTH = "0.47, -1.5707963]"
SIZES = "length: 0.60\n  width: 0.44"


@pytest.mark.parametrize(
    ("file", "changes", "words"),
    [
        (CELL, {FASTEST: EXCHANGED}, "never reach 'arm.max_speed' within their limits; these two"),
        (CELL, {"travel_speed: 0.8": "travel_speed: 0.3"}, "'arm.travel_speed' (0.3); these two"),
        (CELL, {NORTH: "0.47, 1.5707963]"}, "points away from the middle of the table"),
        (CELL, {SIZES: "length: 0.44\n  width: 0.60"}, "markers 102, 107 lie in the usable area"),
        (FIXED, {f"channel: {k}": f"channel: {k + 1}" for k in (*range(7, -1, -1),)}, "from 0; if"),
    ],
)
def test_a_mistake_that_may_be_meant_is_a_warning(
    file: str, changes: dict[str, str], words: str, tmp_path: Path
) -> None:
    folder = tmp_path / "config"
    shutil.copytree(shared_folder(), folder)
    assert not any(words in sentence for sentence in check(folder / file)[0].warnings)
    text = (folder / file).read_text(encoding="utf-8")
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (folder / file).write_text(text, encoding="utf-8")
    found = check(folder / file)[0]
    assert not found.errors
    assert any(words in sentence for sentence in found.warnings), found.warnings


def test_a_section_that_is_indented_too_far_is_named(tmp_path: Path) -> None:
    text = (shared_folder() / CELL).read_text(encoding="utf-8")
    start, end = text.index("tapper:\n"), text.index("\ncamera:")
    inner = "".join(f"  {line}\n" for line in text[start:end].splitlines())
    (tmp_path / CELL).write_text(text[:start] + inner + text[end:], encoding="utf-8")
    errors = [sentence for found in check(tmp_path / CELL) for sentence in found.errors]
    assert any("'arm.tapper'; if it is a section beside this one" in error for error in errors)


def test_the_corners_of_a_polygon_may_be_clockwise(tmp_path: Path) -> None:
    text = (shared_folder() / SQUARE).read_text(encoding="utf-8")
    turned = tmp_path / "square.yaml"
    turned.write_text(text.replace(CORNERS, CLOCKWISE), encoding="utf-8")
    corners = load_object(turned).shape.outline()
    assert set(corners) == set(load_object(shared_folder() / SQUARE).shape.outline())
    assert signed_area(np.array(corners)) > 0.0


def test_a_layout_file_is_recognised_and_its_units_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "layout.yaml"
    path.write_text("goals: [{object: disk, pose: [0.05, 20, 90]}]\n", encoding="utf-8")
    (found,) = check(path)
    assert found.kind == "layout"
    assert "'goals[0].pose[1]' is 20" in found.errors[0]
    assert "if the value is in mm, write 0.02" in found.errors[0]


def poses() -> list[list[float]]:
    """Return rows of a record for `calibrate arm`: joints in rad, then x and y in m."""
    generator = np.random.default_rng(3)
    rows: list[list[float]] = []
    while len(rows) < 24:
        shoulder, elbow, tool = generator.uniform([-1.3, 0.5, -2.0], [1.3, 2.2, 2.0])
        elbow *= generator.choice([-1.0, 1.0])
        at = 0.47j - 1j * np.exp(1j * shoulder) * (
            0.425 + np.exp(1j * elbow) * (0.375 + 0.06 * np.exp(1j * tool))
        )
        if abs(at.real) < 0.3 and abs(at.imag) < 0.22:
            rows.append([shoulder, elbow, tool, at.real, at.imag])
    return rows


def taps() -> list[list[float]]:
    """Return rows of a record for `calibrate tapper`: energy in J, distance in m."""
    launch = 1.86 * 0.1 / 0.3455
    rows = [0.003, 0.006, 0.012, 0.025, 0.05, 0.08] * 3
    return [[energy, launch**2 * 20.0 * energy / (2.0 * 0.17 * 9.81)] for energy in rows]


def table(names: str, rows: list[list[float]], mark: str = ".") -> str:
    lines = [",".join(f"{value:.6f}".replace(".", mark) for value in row) for row in rows]
    return "\n".join([names, *lines, ""])


JOINTS = "shoulder,elbow,tool"
DATES = re.sub(r"\n-?[0-9.]+,", "\n02.Apr,", table(f"{JOINTS},x,y", poses()), count=8)
RECORDS = [
    ("arm", table(f"{JOINTS},x,y", poses()), ""),
    ("arm", table(f"{JOINTS},y,x", poses()), "after the columns x and y are exchanged"),
    ("arm", table("elbow,shoulder,tool,x,y", poses()), "columns shoulder and elbow are exchanged"),
    ("arm", table(f"{JOINTS},x,y", poses(), ","), "row 2 has 10 cells: the comma seems to be"),
    ("arm", table(f"{JOINTS},x,y", np.degrees(poses()).tolist()), "if the values are in deg"),
    ("arm", table("energy,distance", taps()), "it is a record for `calibrate tapper`"),
    ("arm", DATES, "a spreadsheet has turned the number into a date"),
    ("arm", "PK\x03\x04" + table(f"{JOINTS},x,y", poses()), "is a file of a spreadsheet program"),
    ("arm", "<<<<<<< HEAD\n" + table(f"{JOINTS},x,y", poses()), "line 1 is the marker <<<<<<<"),
    ("arm", table(f"{JOINTS},x,y", poses() + poses()), "rows 26 to 33 repeat rows 2 to 9"),
    (
        "arm",
        table(f"{JOINTS},x,y", [[s, -e, *rest] for s, e, *rest in poses()]),
        "after the sign of the column elbow is changed",
    ),
    ("tapper", table("energy,distance", taps()), ""),
    ("tapper", table("energy,distance_in", [[e, d / 0.0254] for e, d in taps()]), ""),
    ("tapper", table("energy,distance_ft", taps()), "the header is energy, distance_ft"),
    ("tapper", "Series 3,\n" + table("energy,distance", taps()), "delete the lines above it"),
    (
        "tapper",
        table("energy,distance", [[e, 100.0 * d] for e, d in taps()]),
        "distance_cm if the values are in cm",
    ),
    ("tapper", table("energy_mJ,distance", taps()), "check the unit in the name of its column"),
    (
        "tapper",
        table("energy,distance", [[1e3 * e, d] for e, d in taps()]),
        "check the unit in the name of its column",
    ),
    ("tapper", table(f"{JOINTS},x,y", poses()), "it is a record for `calibrate arm`"),
]


@pytest.mark.parametrize(("verb", "text", "words"), RECORDS, ids=range(len(RECORDS)))
def test_a_mistake_in_a_record_is_refused_and_named(
    verb: str, text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record, output = tmp_path / "record.csv", tmp_path / "new_cell.yaml"
    record.write_text(text, encoding="utf-8")
    status = main(["calibrate", verb, str(record), "--output", str(output)])
    assert output.exists() == (status == 0) == (not words)
    assert words in capsys.readouterr().err


TRUTH = str(shared_folder() / "truth" / "default.yaml")
ARGUMENTS = [
    (["goal", "50,5", "-20", "90"], "write a decimal point: 50.5"),
    (["goal", "50,-20,90"], "separate the numbers by spaces: 50 -20 90"),
    (["goal", "50", "-20"], "THETA, in degrees, is missing"),
    (["evaluate", "--trials", "1e3"], "is not a whole number; write 1000"),
    (["evaluate", "--scatter", "5%", "15%", "1"], "without '%', in the unit that --help states"),
    (["demo", "--goal", "10", "20mm", "0"], "write the number without 'mm'"),
    (["evaluate", "--tolerance", "0.001", "0.02"], "if the value is in m, write 1"),
    (["evaluate", "--goal", "0.01", "0", "0.17"], "if it is in m and rad, write 10 0 9.74"),
    (
        ["object", "new", "a.png", "--name", "a", "--height", "0.012", "--output", "o.yaml"],
        "0.012 is outside its limits 0.5 to 500 mm; if the value is in m, write 12",
    ),
    (["goal", "50", "-20", "90", "--tolerance", "0.001", "0.02"], "must be 0.01 to 100 mm"),
    (
        ["evaluate", "--model", "physics", "--object", TRUTH],
        "is a file of another kind, with the k",
    ),
    (
        ["evaluate", "--model", "physics", "--object", "cell.yaml"],
        "another kind, with the keys name",
    ),
    (["goal", "--layout", "LAYOUT"], "'goals[0]' and 'goals[1]' are both for the object 'a'"),
]


@pytest.mark.parametrize(("arguments", "words"), ARGUMENTS)
def test_a_mistake_in_an_argument_is_refused_at_once(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layout = tmp_path / "layout.yaml"
    layout.write_text("goals: [{object: a, pose: [0, 0, 0]}, {object: a, pose: [0.1, 0, 0]}]\n")
    arguments = [str(layout) if word == "LAYOUT" else word for word in arguments]
    try:
        status = main(arguments)
    except SystemExit as error:
        status = int(error.code or 0)
    assert status == 2
    assert words in " ".join(capsys.readouterr().err.split())
