"""The figure of a run."""

from __future__ import annotations

import itertools
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from report_parts import made_run, tap_row

from tapping_cell.report.cell_view import _draw_table, draw_cell
from tapping_cell.se2 import Pose


def test_the_numbers_of_strikes_at_the_same_place_do_not_overlap() -> None:
    strikes = [Pose(-0.08, 0.0, 0.0), Pose(-0.08, 0.003, 0.05), Pose(-0.079, -0.002, 0.0)]
    taps = [tap_row(number, strike=strike) for number, strike in enumerate(strikes, start=1)]
    figure = Figure(figsize=(6.0, 5.0), dpi=110)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _draw_table(axes, made_run(taps, outline=((0.03, 0.0), (-0.02, 0.02), (-0.02, -0.02))))
    canvas.draw()
    numbers = [each for each in axes.texts if each.get_text() in ("1", "2", "3")]
    boxes = [each.get_window_extent() for each in numbers]
    assert len(boxes) == 3
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
    assert all(axes.bbox.contains(*box.min) and axes.bbox.contains(*box.max) for box in boxes)


def test_a_goal_that_a_restarted_planner_resumed_has_a_figure(tmp_path: Path) -> None:
    taps = [tap_row(number) for number in (3, 4)]
    draw_cell(made_run(taps), tmp_path / "cell.png")
    assert (tmp_path / "cell.png").stat().st_size > 10_000
