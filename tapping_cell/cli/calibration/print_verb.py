"""True-to-scale sheets: a target for calibrate camera, the table's reference markers, object
markers.

Print the PDF at 100 % (no "fit to page") and measure the ruler at its foot. With the reference
markers comes a table file beside the PDF, sheet.table.yaml; when the ruler measures anything but
100 mm, calibrate table --sheet corrects it. With --output sheet.png one page is written as an image
of --dpi.

  python -m tapping_cell calibrate print --paper a4 --output sheet.pdf
  python -m tapping_cell calibrate print --paper 900x600 --what table --marker-size 40 \\
      --output table.pdf
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.keep import KeptFile
from tapping_cell.calibration.print_sheet import (
    Page,
    SheetError,
    object_page,
    paper_size,
    reference_map,
    reference_page,
    target_page,
)
from tapping_cell.calibration.table_file import table_yaml
from tapping_cell.calibration.target import Target, TargetError
from tapping_cell.cli.calibration.camera_verb import counts
from tapping_cell.report.print_sheet import PrintedPage, write_pdf, write_png
from tapping_cell.vision import MarkerError

SHEETS = ("charuco", "chessboard", "table", "objects")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "--paper",
        default="a4",
        help="a4, a3, a2, a1, a0, letter, tabloid, or a size in mm such as 900x600 (a4)",
    )
    parser.add_argument(
        "--what",
        nargs="+",
        choices=SHEETS,
        default=["charuco", "table", "objects"],
        help="the pages (charuco table objects)",
    )
    parser.add_argument(
        "--squares", type=counts, default=(10, 7), metavar="CxR", help="of the target (10x7)"
    )
    parser.add_argument(
        "--square-size", type=float, default=25.0, metavar="MM", help="of the target in mm (25)"
    )
    parser.add_argument(
        "--target-dictionary", default="4X4_250", help="of a ChArUco target (4X4_250)"
    )
    parser.add_argument(
        "--dictionary",
        default="APRILTAG_36h11",
        help="of reference and object markers (APRILTAG_36h11)",
    )
    parser.add_argument(
        "--marker-size", type=float, default=30.0, metavar="MM", help="of reference markers (30)"
    )
    parser.add_argument(
        "--first-id", type=int, default=101, help="number of the first reference marker (101)"
    )
    parser.add_argument(
        "--object-size", type=float, default=50.0, metavar="MM", help="of object markers (50)"
    )
    parser.add_argument(
        "--object-ids", type=int, nargs="+", default=[1, 2, 3], help="of object markers (1 2 3)"
    )
    parser.add_argument("--dpi", type=float, default=300.0, help="dots per inch of a PNG (300)")
    parser.add_argument(
        "--output", type=Path, required=True, metavar="FILE", help="a .pdf, or a .png of one page"
    )
    parser.add_argument("--force", action="store_true", help="replace the files if they are there")


def run(arguments: argparse.Namespace) -> int:
    """Write the pages, and the table file where there is a page of reference markers."""
    output: Path = arguments.output.expanduser()
    picture = output.suffix.lower() == ".png"
    if picture and len(arguments.what) != 1:
        raise CalibrationRefused("a PNG holds one page: name one with --what, or write a .pdf")
    if not picture and output.suffix.lower() != ".pdf":
        raise CalibrationRefused(f"{output}: end it in .pdf, or in .png for one page")
    table = output.with_suffix(".table.yaml") if "table" in arguments.what else None
    for path in (output, table):
        if path is not None and path.exists() and not arguments.force:
            raise KeptFile(
                f"{path}: is there already and stays as it is; give another --output, or --force to"
                " replace it"
            )
    try:
        pages, text = _pages(arguments)
    except (SheetError, TargetError, MarkerError) as error:
        raise CalibrationRefused(str(error)) from error
    drawn = [printed(page) for page in pages]
    if picture:
        write_png(output, drawn[0], arguments.dpi)
    else:
        write_pdf(output, drawn, "tapping cell: sheets for calibration")
    print(f"written: {output}: {', '.join(arguments.what)}; print at 100 %, measure the ruler")
    if table is not None:
        table.write_text(text, encoding="utf-8")
        print(f"written: {table}: the reference markers of that sheet")
    return 0


def _pages(arguments: argparse.Namespace) -> tuple[list[Page], str]:
    """The pages asked for, and the text of the table file."""
    paper = paper_size(arguments.paper)
    pages, text = [], ""
    for what in arguments.what:
        if what in ("charuco", "chessboard"):
            square = arguments.square_size / 1e3
            columns, rows = arguments.squares
            target = Target(what, columns, rows, square)
            if what == "charuco":
                target = replace(
                    target, marker=0.75 * square, dictionary=arguments.target_dictionary
                )
            pages.append(target_page(paper, target))
        elif what == "table":
            size = arguments.marker_size / 1e3
            references = reference_map(paper, size, arguments.dictionary, arguments.first_id)
            pages.append(reference_page(paper, references))
            comment = (
                f"Reference markers of {arguments.output.name} (calibrate print, paper"
                f" {arguments.paper}), if its ruler measures 100 mm."
            )
            text = table_yaml(references, None, comment)
        else:
            size = arguments.object_size / 1e3
            pages.append(object_page(paper, arguments.object_ids, size, arguments.dictionary))
    return pages, text


def printed(page: Page) -> PrintedPage:
    """The page as the report room draws it."""
    labels = [(label.x, label.y, label.height, label.text) for label in page.labels]
    return PrintedPage(page.width, page.height, page.shapes, page.lines, labels)
