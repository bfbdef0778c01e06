"""Output of pages to scale: all pages as PDF, or one page as PNG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from tapping_cell.durable_file import part_of

_INCH = 0.0254
_POINT = _INCH / 72.0
_LINE = 0.0002
"""Width of thin lines, in m."""
_CAPITAL = 0.73
"""Height of a capital letter in matplotlib's default font, as a fraction of the font size."""

Loop = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PrintedPage:
    """A page of ``width`` x ``height``, with its origin in the lower left corner; all in m.

    ``shapes``: black areas, each a list of closed loops (N, 2) with the black on their left.
    ``lines``: thin lines (x0, y0, x1, y1). ``labels``: x, y, height of a capital letter, and text.
    """

    width: float
    height: float
    shapes: Sequence[Sequence[Loop]]
    lines: Sequence[tuple[float, float, float, float]]
    labels: Sequence[tuple[float, float, float, str]]


def write_pdf(path: Path, pages: Sequence[PrintedPage], title: str) -> None:
    """Write all pages to one PDF at full scale.

    Raises:
        OSError: the file cannot be written.
    """
    with matplotlib.rc_context({"pdf.fonttype": 42}), PdfPages(part_of(path)) as file:
        file.infodict()["Title"] = title
        for page in pages:
            file.savefig(_figure(page))
    part_of(path).replace(path)


def write_png(path: Path, page: PrintedPage, dpi: float) -> None:
    """Write one page as PNG; sizes are rounded to whole pixels.

    Raises:
        OSError: the file cannot be written.
    """
    _figure(page).savefig(part_of(path), dpi=dpi, format="png")
    part_of(path).replace(path)


def _figure(page: PrintedPage) -> Figure:
    figure = Figure(figsize=(page.width / _INCH, page.height / _INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0.0, page.width)
    axes.set_ylim(0.0, page.height)
    axes.set_axis_off()
    for loops in page.shapes:
        outlines = [Outline(np.vstack([loop, loop[:1]]), closed=True) for loop in loops]
        outline = Outline.make_compound_path(*outlines)
        axes.add_patch(PathPatch(outline, facecolor="black", edgecolor="none", linewidth=0))
    for x0, y0, x1, y1 in page.lines:
        axes.plot([x0, x1], [y0, y1], color="black", linewidth=_LINE / _POINT)
    for x, y, height, text in page.labels:
        size = height / _CAPITAL / _POINT
        axes.text(x, y, text, fontsize=size, va="baseline", color="black")
    return figure
