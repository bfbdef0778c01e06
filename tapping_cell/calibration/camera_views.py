"""Selection of usable views for the calibration of a camera, and their coverage of the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.target import TargetView

_SAME_SHARE = 0.004
"""Mean distance between corresponding corners of two views, as a fraction of the image diagonal,
below which the views count as duplicates."""
_BLUR_SHARE, _BLUR_PIXELS, _BLUR_RATIO = 0.15, 2.5, 2.0
GRID = (5, 6)
"""Number of rows and columns into which the image is divided to count coverage."""
_PLACES = (
    ("top left", "top", "top right"),
    ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)


@dataclass(frozen=True, slots=True)
class Rejected:
    """A rejected photograph with the reason."""

    name: str
    reason: str


def screen(
    views: Sequence[TargetView], size: tuple[int, int]
) -> tuple[list[TargetView], list[Rejected]]:
    """Reject blurred views and, among several views of the same pose, all views except the
    first."""
    usual = float(np.median([view.blur for view in views])) if views else 0.0
    near = _SAME_SHARE * float(np.hypot(*size))
    kept: list[TargetView] = []
    rejected: list[Rejected] = []
    for view in views:
        limit = _BLUR_SHARE * view.side
        if view.blur > limit or view.blur > max(_BLUR_PIXELS, _BLUR_RATIO * usual):
            rejected.append(
                Rejected(
                    view.name,
                    f"blurred: edges spread over {view.blur:.1f} pixels (standard deviation); the"
                    f" median of all views is {usual:.1f}",
                )
            )
            continue
        duplicate = next((other for other in kept if _apart(view, other) < near), None)
        if duplicate is not None:
            rejected.append(
                Rejected(
                    view.name,
                    f"duplicate view: its corners lie within {_apart(view, duplicate):.1f} pixels"
                    f" of those of {duplicate.name}",
                )
            )
            continue
        kept.append(view)
    return kept, rejected


def _apart(view: TargetView, other: TargetView) -> float:
    """Return the mean distance, in pixels, between the positions of the same corner in the two
    views, over all corners that both views show. It is infinite if both views show fewer than four
    common corners."""
    _, mine, others = np.intersect1d(view.ids, other.ids, return_indices=True)
    if len(mine) < 4:
        return np.inf
    first, second = view.pixels[mine], other.pixels[others]
    apart = np.linalg.norm(first - second, axis=1).mean()
    if len(view.ids) == len(other.ids) == len(mine):
        # A chessboard detected with reversed corner order is the same view.
        apart = min(apart, np.linalg.norm(first - second[::-1], axis=1).mean())
    return float(apart)


def coverage(views: Sequence[TargetView], size: tuple[int, int]) -> NDArray[np.intp]:
    """Count the views that have a corner in each part of the image; shape ``GRID``."""
    counts = np.zeros(GRID, dtype=np.intp)
    for view in views:
        column = np.clip((view.pixels[:, 0] + 0.5) / size[0] * GRID[1], 0, GRID[1] - 1)
        row = np.clip((view.pixels[:, 1] + 0.5) / size[1] * GRID[0], 0, GRID[0] - 1)
        seen = np.zeros(GRID, dtype=bool)
        seen[row.astype(int), column.astype(int)] = True
        counts += seen
    return counts


def uncovered_regions(counts: NDArray[np.intp]) -> list[str]:
    """Name the regions of the image of which more than half has no corner in any view."""
    uncovered = []
    for row, names in enumerate(_PLACES):
        for column, name in enumerate(names):
            rows = slice(row * GRID[0] // 3, -(-(row + 1) * GRID[0] // 3))
            columns = slice(column * GRID[1] // 3, -(-(column + 1) * GRID[1] // 3))
            if (counts[rows, columns] == 0).mean() > 0.5:
                uncovered.append(name)
    return uncovered
