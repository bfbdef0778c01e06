"""Print true-to-scale sheets: a target for calibrate camera, the table's reference markers, object
markers.

Print the PDF at 100 % (no "fit to page") and measure the ruler at the bottom of the page. For
reference markers, a table file sheet.table.yaml is written next to the PDF. If the ruler does not
measure 100 mm, correct this file with calibrate table --sheet. With --output sheet.png, one page is
written as an image; --dpi sets the resolution.

  python -m tapping_cell calibrate print --paper a4 --output sheet.pdf
  python -m tapping_cell calibrate print --paper a1 --what table --table config/table.yaml \\
      --output table.pdf

With --table FILE, the page contains the reference markers of that file at their positions. No other
table file is written then: use FILE as the table file of the sheet. If only small paper is
available, --what cut prints the same markers one by one. Cut them out, glue them to the table, and
measure their positions with calibrate table.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.keep import KeptFile
from tapping_cell.calibration.print_sheet import (
    Page,
    SheetError,
    cut_page,
    object_page,
    paper_size,
    reference_map,
    reference_page,
    target_page,
)
from tapping_cell.calibration.table_file import table_yaml
from tapping_cell.calibration.target import Target, TargetError
from tapping_cell.cli import argument_types
from tapping_cell.cli.calibration.camera_verb import counts
from tapping_cell.configuration.table import load_reference_map
from tapping_cell.durable_file import replace_text
from tapping_cell.report.print_sheet import PrintedPage, write_pdf, write_png
from tapping_cell.vision import MarkerError, ReferenceMap

SHEETS = ("charuco", "chessboard", "table", "cut", "objects")
SIDES_MM = (3.0, 1000.0)
"""Limits of the side length of squares and markers, in mm."""
LAST_ID = 1_000_000
"""Limit of marker ids, as in a table file."""
MAX_PIXELS = 3e8
"""Limit of the pixels of a PNG, which is drawn in memory with 4 bytes per pixel."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "--paper",
        default="a4",
        help="paper size: a4, a3, a2, a1, a0, letter, tabloid, or a size in mm such as 900x600 "
        "(default: a4)",
    )
    parser.add_argument(
        "--what",
        nargs="+",
        choices=SHEETS,
        default=["charuco", "table", "objects"],
        help="pages to print (default: charuco table objects)",
    )
    parser.add_argument(
        "--squares",
        type=counts,
        default=(10, 7),
        metavar="CxR",
        help="number of columns and rows of squares of the calibration target (default: 10x7)",
    )
    parser.add_argument(
        "--square-size",
        type=argument_types.within(*SIDES_MM, "mm"),
        default=25.0,
        metavar="MM",
        help="side length of the target's squares in mm (default: 25)",
    )
    parser.add_argument(
        "--target-dictionary",
        default="4X4_250",
        help="marker dictionary of a ChArUco target (default: 4X4_250)",
    )
    parser.add_argument(
        "--dictionary",
        default="APRILTAG_36h11",
        help="marker dictionary of the reference and object markers (default: APRILTAG_36h11)",
    )
    parser.add_argument(
        "--marker-size",
        type=argument_types.within(*SIDES_MM, "mm"),
        default=30.0,
        metavar="MM",
        help="side length of the reference markers in mm (default: 30)",
    )
    parser.add_argument(
        "--first-id",
        type=argument_types.whole(0, LAST_ID),
        default=101,
        help="id of the first reference marker (default: 101)",
    )
    parser.add_argument(
        "--object-size",
        type=argument_types.within(*SIDES_MM, "mm"),
        default=50.0,
        metavar="MM",
        help="side length of the object markers in mm (default: 50)",
    )
    parser.add_argument(
        "--object-ids",
        type=argument_types.whole(0, LAST_ID),
        nargs="+",
        default=[1, 2, 3],
        help="ids of the object markers (default: 1 2 3)",
    )
    parser.add_argument(
        "--table",
        type=Path,
        metavar="FILE",
        help="table file with the reference markers to print (default: eight markers along the "
        "edge of the paper)",
    )
    parser.add_argument(
        "--dpi",
        type=argument_types.within(30, 2400),
        default=300.0,
        help="resolution of a PNG in dots per inch, 30 to 2400 (default: 300)",
    )
    parser.add_argument(
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help="file to write: .pdf, or .png for a single page",
    )
    parser.add_argument("--force", action="store_true", help="replace existing files")


def run(arguments: argparse.Namespace) -> int:
    """Write the pages and, for a page of reference markers, the table file."""
    output: Path = arguments.output.expanduser()
    picture = output.suffix.lower() == ".png"
    if picture and len(arguments.what) != 1:
        raise CalibrationRefused("a PNG has only one page; select it with --what, or write a .pdf")
    if not picture and output.suffix.lower() != ".pdf":
        raise CalibrationRefused(f"{output}: the name must end in .pdf, or in .png for one page")
    given: Path | None = arguments.table
    references_shown = bool({"table", "cut"} & set(arguments.what))
    if given is not None and not references_shown:
        raise CalibrationRefused("--table applies to the pages table and cut: name one with --what")
    table = output.with_suffix(".table.yaml") if references_shown and given is None else None
    for path in (output, table):
        if path is not None and path.exists() and not arguments.force:
            raise KeptFile(
                f"{path} exists already and was not replaced; give another --output, or "
                "--force to replace it"
            )
    try:
        pages, text = _pages(arguments)
    except (SheetError, TargetError, MarkerError) as error:
        raise CalibrationRefused(str(error)) from error
    drawn = [printed(page) for page in pages]
    if picture:
        _refuse_too_many_pixels(pages[0], arguments.dpi)
        write_png(output, drawn[0], arguments.dpi)
    else:
        write_pdf(output, drawn, "tapping cell: sheets for calibration")
    print(f"written: {output}: {', '.join(arguments.what)}; print at 100 % and measure the ruler")
    if table is not None:
        replace_text(table, text)
        print(f"written: {table}: the reference markers of that sheet")
    elif given is not None and "table" in arguments.what:
        print(f"the table file of that sheet is {given}, if the ruler measures 100 mm")
    return 0


def _pages(arguments: argparse.Namespace) -> tuple[list[Page], str]:
    """Return the requested pages and the text of the table file."""
    paper = paper_size(arguments.paper)
    pages, text = [], ""
    for what in arguments.what:
        if what in ("charuco", "chessboard"):
            square = arguments.square_size / 1e3
            columns, rows = arguments.squares
            marked = (0.75 * square, arguments.target_dictionary) if what == "charuco" else ()
            target = Target(what, columns, rows, square, *marked)
            pages.append(target_page(paper, target))
        elif what in ("table", "cut"):
            references = _references(arguments, paper)
            draw = reference_page if what == "table" else cut_page
            pages.append(draw(paper, references))
            comment = (
                f"Reference markers of {arguments.output.name} (calibrate print, paper"
                f" {arguments.paper}), if its ruler measures 100 mm."
            )
            text = table_yaml(references, None, comment)
        else:
            size = arguments.object_size / 1e3
            pages.append(object_page(paper, arguments.object_ids, size, arguments.dictionary))
    return pages, text


def _references(arguments: argparse.Namespace, paper: tuple[float, float]) -> ReferenceMap:
    """Return the markers of the given table file, or the default markers for the paper size."""
    if arguments.table is not None:
        return load_reference_map(arguments.table.expanduser())
    size = arguments.marker_size / 1e3
    return reference_map(paper, size, arguments.dictionary, arguments.first_id)


def _refuse_too_many_pixels(page: Page, dpi: float) -> None:
    square_inches = page.width * page.height / 0.0254**2
    if square_inches * dpi**2 > MAX_PIXELS:
        raise CalibrationRefused(
            f"a page of {page.width * 1e3:g} x {page.height * 1e3:g} mm at {dpi:g} dpi has "
            f"{square_inches * dpi**2 / 1e6:.0f} million pixels (limit {MAX_PIXELS / 1e6:.0f} "
            f"million); give --dpi {math.sqrt(MAX_PIXELS / square_inches) // 1:.0f} or less, or "
            "write a .pdf"
        )


def printed(page: Page) -> PrintedPage:
    """Convert the page to the input of the report package; that package draws the page."""
    labels = [(label.x, label.y, label.height, label.text) for label in page.labels]
    return PrintedPage(page.width, page.height, page.shapes, page.lines, labels)
