"""What a reader would complain about in a figure: clipped or overlapping text, a legend on data,
and a plan view that is not to scale."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox

SLACK_PX = 1.0
"""Overlap and overhang that nobody sees, px."""


@contextmanager
def collected() -> Iterator[dict[str, list[str]]]:
    """Collect the problems of every figure that is saved meanwhile, by the name of its file."""
    found: dict[str, list[str]] = {}
    plain = Figure.savefig

    def checked(figure: Figure, file: Any, **options: Any) -> None:
        plain(figure, file, **options)  # first: drawing the figure would change its layout
        found[str(file).rpartition("/")[2]] = problems(figure)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", checked)
        yield found


def problems(figure: Figure) -> list[str]:
    """Return the problems of a figure as sentences."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    boxes = [(_shown(text), Text.get_window_extent(text, renderer)) for text in _texts(figure)]
    return [
        *_clipped(figure, boxes),
        *_leaving(figure, renderer),
        *_overlapping(boxes),
        *(each for axes in figure.axes for each in _covered(axes, renderer)),
        *(each for axes in figure.axes for each in _distorted(axes)),
    ]


def _shown(text: Text) -> str:
    return repr(text.get_text().replace("\n", " "))


def _texts(figure: Figure) -> list[Text]:
    """Return the texts that are drawn, without the labels of ticks outside the axes' limits."""
    ticks, drawn = set(), set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            every = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
            ticks |= {label for tick in every for label in (tick.label1, tick.label2)}
            if axes.axison and axis.get_visible():
                low, high = sorted(axis.get_view_interval())
                span = 1e-9 * (high - low)
                drawn |= {
                    label
                    for tick in every
                    for label in (tick.label1, tick.label2)
                    if low - span <= tick.get_loc() <= high + span
                }
    return [
        text
        for text in figure.findobj(Text)
        if text.get_text().strip()
        and text.get_visible()
        and (text not in ticks or text in drawn)
        and (text.axes is None or text.axes.axison)
    ]


def _clipped(figure: Figure, boxes: list[tuple[str, Bbox]]) -> Iterator[str]:
    whole = figure.bbox.padded(SLACK_PX)
    for name, box in boxes:
        if not (whole.contains(*box.min) and whole.contains(*box.max)):
            yield f"{name} is clipped"


def _leaving(figure: Figure, renderer: Any) -> Iterator[str]:
    """Return the texts in a plot that cross its frame."""
    for axes in figure.axes:
        frame = axes.bbox.padded(SLACK_PX)
        for text in axes.texts:
            box = Text.get_window_extent(text, renderer)
            inside = [frame.contains(*corner) for corner in (box.min, box.max)]
            if text.get_text() and any(inside) and not all(inside):
                yield f"{_shown(text)} crosses the frame of its plot"


def _overlapping(boxes: list[tuple[str, Bbox]]) -> Iterator[str]:
    for (one, here), (other, there) in itertools.combinations(boxes, 2):
        shared = Bbox.intersection(here, there)
        if shared is not None and min(shared.width, shared.height) > SLACK_PX:
            yield f"{one} overlaps {other}"


def _covered(axes: Any, renderer: Any) -> Iterator[str]:
    """Return what the legend of the axes hides."""
    legend = axes.get_legend()
    if legend is None:
        return
    box = legend.get_window_extent(renderer).padded(-SLACK_PX)
    for each in (one for one in axes.figure.axes if one.bbox.overlaps(axes.bbox)):
        view = Bbox.intersection(box, each.bbox)
        if view is None:
            continue
        for line in each.lines:
            path = line.get_transform().transform_path(line.get_path())
            if len(path.vertices) and path.intersects_bbox(view, filled=False):
                yield f"the legend hides the line {line.get_label()!r}"
        for points in each.collections:
            places = points.get_offset_transform().transform(np.asarray(points.get_offsets()))
            if len(points.get_offsets()) > 1 and any(view.contains(*place) for place in places):
                yield f"the legend hides points {points.get_label()!r}"
        bars = [bar for all_ in each.containers if isinstance(all_, BarContainer) for bar in all_]
        shapes = [*bars, *(patch for patch in each.patches if isinstance(patch, Polygon))]
        if any(view.overlaps(shape.get_window_extent(renderer)) for shape in shapes):
            yield "the legend hides bars or outlines"
        for text in each.texts:
            arrow = text.arrow_patch if isinstance(text, Annotation) else None
            if arrow is not None and view.overlaps(arrow.get_window_extent(renderer)):
                yield "the legend hides an arrow"


def _distorted(axes: Any) -> Iterator[str]:
    """Return whether a plan view has unequal axes."""
    labels = (axes.get_xlabel(), axes.get_ylabel())
    is_plan = all(label.startswith(name) for label, name in zip(labels, ("x ", "y "), strict=True))
    if is_plan and axes.get_aspect() != 1.0:
        yield f"the axes {labels} are not to scale"
