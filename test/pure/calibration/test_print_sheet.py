"""Markers and text of printed sheets are at their nominal positions to 0.05 mm."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tapping_cell.calibration.print_sheet import (
    SheetError,
    marker_loops,
    object_page,
    paper_size,
    reference_map,
    reference_page,
    target_page,
)
from tapping_cell.calibration.target import Target, find_target
from tapping_cell.cli import main
from tapping_cell.configuration.table import load_reference_map
from tapping_cell.vision.markers.detection import find_markers, marker_pattern
from tapping_cell.vision.markers.edges import refine

pypdf = pytest.importorskip(
    "pypdf", reason="pypdf is not installed; it is not packaged for Ubuntu 24.04"
)

SHIPPED = Path(__file__).resolve().parents[3] / "config" / "table.yaml"
DPI = 254.0  # 10 dots per mm


def page(tmp_path: Path, what: str, *words: str, kind: str = "png") -> np.ndarray:
    path = tmp_path / f"{what}.{kind}"
    line = ["calibrate", "print", "--what", what, "--dpi", str(DPI), "--output", str(path), *words]
    assert main(line) == 0
    if kind == "png":
        return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    (one,) = pypdf.PdfReader(path).pages
    return rasterised(one)


def rasterised(one: pypdf.PageObject) -> np.ndarray:
    """Rasterise the page's filled paths at DPI like a printer. By PDF's rules, a unit is 1/72 inch,
    the origin is at the lower left, and a path is filled by the winding rule."""
    assert "/UserUnit" not in one and not one.get("/Rotate")
    # OpenCV also fills the pixels on the edge of a path, which makes it half a pixel too large on
    # each side. Draw at four times the resolution to reduce this error.
    scale = 4 * DPI / 72.0
    width, height = (float(side) for side in one.mediabox[2:])
    image = np.full((round(height * scale), round(width * scale)), 255, dtype=np.uint8)
    stack: list[str] = []
    loops: list[list[tuple[float, float]]] = []
    grey, kept, text = 255, [255], False
    for word in one.get_contents().get_data().decode("latin1").split():
        if text:
            text = word != "ET"
        elif word in ("m", "l"):
            x, y = float(stack[-2]), float(stack[-1])
            if word == "m":
                loops.append([])
            loops[-1].append((x * scale - 0.5, (height - y) * scale - 0.5))
        elif word == "g":
            grey = round(255 * float(stack[-1]))
        elif word == "q":
            kept.append(grey)
        elif word == "Q":
            grey = kept.pop()
        elif word == "cm":
            # The only transformation is the translation of text; nothing is scaled.
            assert [float(number) for number in stack[-6:-2]] == [1.0, 0.0, 0.0, 1.0]
        elif word == "BT":
            text = True
        elif word == "f" and loops:
            corners = [np.rint(np.array(loop) * 256).astype(np.int32) for loop in loops]
            cv2.fillPoly(image, corners, grey, shift=8)
        if word in ("f", "S", "n"):
            loops = []
        stack = stack[-5:] + [word]
    return cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize("kind", ["png", "pdf"])
def test_reference_markers_are_at_the_positions_of_the_table_file(
    tmp_path: Path, kind: str
) -> None:
    image = page(tmp_path, "table", "--paper", "a4", kind=kind)
    references = load_reference_map(tmp_path / "table.table.yaml")
    assert image.shape == (2100, 2970)
    found = {d.id: d for d in find_markers(image, references.dictionary)}
    corners = references.corners()
    for row, marker in enumerate(references.markers):
        edges = refine(image, found[marker.id].corners[None], 8)
        # Convert dots (centres of dots at integers) to metres in the page's frame (origin in the
        # middle of the page, y upwards).
        seen = (edges.corners[0] + 0.5 - np.array([1485.0, 1050.0])) * [1e-4, -1e-4]
        assert np.abs(seen - corners[row]).max() < 5e-5


def test_the_sheet_for_the_shipped_table_file_has_its_markers(tmp_path: Path) -> None:
    """The sheet that the build guide says to glue to the table matches the table file of the
    cell."""
    image = page(tmp_path, "table", "--paper", "a1", "--table", str(SHIPPED), "--dpi", "101.6")
    references = load_reference_map(SHIPPED)
    found = {d.id: d for d in find_markers(image, references.dictionary)}
    assert set(found) == {marker.id for marker in references.markers}
    middle = np.array([image.shape[1], image.shape[0]]) / 2
    for marker, corners in zip(references.markers, references.corners(), strict=True):
        edges = refine(image, found[marker.id].corners[None], 8)
        seen = (edges.corners[0] + 0.5 - middle) * [25e-5, -25e-5]
        assert np.abs(seen - corners).max() < 1.5e-4
    assert not (tmp_path / "table.table.yaml").exists()


def test_rotated_markers_are_printed_rotated(tmp_path: Path) -> None:
    given = tmp_path / "given.yaml"
    given.write_text(
        "dictionary: APRILTAG_36h11\nmarkers:\n"
        "  - {id: 7, size: 0.03, x: -0.05, y: 0.02, theta: 0.4}\n"
        "  - {id: 8, size: 0.04, x: 0.06, y: -0.01, theta: -2.0}\n",
        encoding="utf-8",
    )
    image = page(tmp_path, "table", "--paper", "a4", "--table", str(given))
    references = load_reference_map(given)
    found = {d.id: d for d in find_markers(image, references.dictionary)}
    for marker, corners in zip(references.markers, references.corners(), strict=True):
        edges = refine(image, found[marker.id].corners[None], 8)
        seen = (edges.corners[0] + 0.5 - np.array([1485.0, 1050.0])) * [1e-4, -1e-4]
        assert np.abs(seen - corners).max() < 5e-5


def test_the_markers_to_cut_are_those_of_the_table_file(tmp_path: Path) -> None:
    image = page(tmp_path, "cut", "--paper", "a4", "--table", str(SHIPPED), kind="pdf")
    references = load_reference_map(SHIPPED)
    found = {d.id: d for d in find_markers(image, references.dictionary)}
    assert set(found) == {marker.id for marker in references.markers}
    for marker in references.markers:
        corners = refine(image, found[marker.id].corners[None], 8).corners[0]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) * 1e-4
        assert sides == pytest.approx([marker.size] * 4, abs=5e-5)


@pytest.mark.parametrize("kind", ["png", "pdf"])
def test_the_target_has_the_specified_size(tmp_path: Path, kind: str) -> None:
    image = page(tmp_path, "charuco", kind=kind)
    target = Target("charuco", 10, 7, 0.025, 0.01875, "4X4_250")
    view = find_target(image, target, "page")
    assert not isinstance(view, str)
    assert len(view.ids) == 54
    points = target.points[view.ids]
    seen = view.pixels * 1e-4
    shift = (seen - points).mean(axis=0)
    assert np.abs(seen - points - shift).max() < 5e-5


def test_the_ruler_measures_100_mm(tmp_path: Path) -> None:
    image = page(tmp_path, "objects")
    # The ruler with its ticks is the lowest printed element on the page.
    dark = image < 128
    lowest = int(np.flatnonzero(dark.any(axis=1)).max())
    columns = np.flatnonzero(dark[lowest - 20, :1130])
    assert columns.max() - columns.min() == pytest.approx(1000, abs=3)


def test_the_pdf_has_the_paper_size_and_a_description(tmp_path: Path) -> None:
    path = tmp_path / "sheet.pdf"
    assert main(["calibrate", "print", "--paper", "900x600", "--output", str(path)]) == 0
    reader = pypdf.PdfReader(path)
    assert len(reader.pages) == 3
    for one in reader.pages:
        width, height = float(one.mediabox.width), float(one.mediabox.height)
        assert width / 72 * 25.4 == pytest.approx(900, abs=0.05)
        assert height / 72 * 25.4 == pytest.approx(600, abs=0.05)
    assert "25 mm" in reader.pages[0].extract_text()
    assert "101" in reader.pages[1].extract_text()
    assert "id 1, 50 mm" in reader.pages[2].extract_text()
    assert main(["calibrate", "print", "--output", str(path)]) == 2  # an existing file is kept


def test_the_outlines_of_a_marker_match_its_pattern() -> None:
    for number in (0, 17, 101):
        pattern = marker_pattern("APRILTAG_36h11", number)
        loops = [
            np.round(loop * 8 * 16).astype(np.int32)
            for loop in marker_loops("APRILTAG_36h11", number, 1.0)
        ]
        drawn = np.full((128, 128), 255, dtype=np.uint8)
        cv2.fillPoly(drawn, loops, (0,))
        cells = drawn[::-1][8::16, 8::16] > 127
        assert np.array_equal(cells, pattern)
        area = sum(
            0.5 * float(np.sum(a[:-1, 0] * a[1:, 1] - a[1:, 0] * a[:-1, 1]))
            for loop in loops
            for a in [np.vstack([loop, loop[:1]]).astype(float)]
        )
        assert area == pytest.approx((~pattern).sum() * 256)


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda: paper_size("b7"), "unknown"),
        (lambda: paper_size("9000x20"), "outside"),
        (lambda: target_page((0.297, 0.21), Target("chessboard", 12, 9, 0.03)), "fewer or smaller"),
        (lambda: reference_page((0.297, 0.21), load_reference_map(SHIPPED)), "such as a1"),
        (lambda: reference_map((0.297, 0.21), 0.06, "APRILTAG_36h11", 101), "largest that fit"),
        (lambda: object_page((0.297, 0.21), [1], -0.05, "APRILTAG_36h11"), "is -50 mm"),
        (lambda: object_page((0.297, 0.21), [1], 0.0, "APRILTAG_36h11"), "must be above 0 mm"),
    ],
)
def test_a_sheet_that_does_not_fit_is_refused(act, words: str) -> None:
    with pytest.raises(SheetError, match=words):
        act()


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--object-size", "-50", "limits 3 to 1000"),
        ("--marker-size", "0", "limits 3 to 1000"),
        ("--square-size", "25000", "limits 3 to 1000"),
        ("--dpi", "0", "limits 30 to 2400"),
        ("--dpi", "-5", "limits 30 to 2400"),
        ("--dpi", "0.01", "limits 30 to 2400"),
        ("--first-id", "-1", "limits 0 to 1000000"),
    ],
)
def test_an_impossible_size_is_refused_and_nothing_is_written(
    tmp_path: Path, capsys, option: str, value: str, words: str
) -> None:
    line = ["calibrate", "print", "--what", "objects", "--output", str(tmp_path / "sheet.png")]
    with pytest.raises(SystemExit) as ended:
        main([*line, f"{option}={value}"])
    assert ended.value.code == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_png_with_too_many_pixels_is_refused(tmp_path: Path, capsys) -> None:
    line = ["calibrate", "print", "--what", "charuco", "--output", str(tmp_path / "sheet.png")]
    assert main([*line, "--paper", "a1", "--dpi", "2400"]) == 1
    assert "--dpi 622 or less" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
