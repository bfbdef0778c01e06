"""Interpolation on a grid with unequal steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.planning.interface import Array

Indices = NDArray[np.intp]


def bracket(grid: Array, values: ArrayLike) -> tuple[Indices, Array]:
    """Return the index of the cell that contains each value, and the relative position in that
    cell, in [0, 1]."""
    wanted = np.asarray(values, dtype=float)
    found = np.searchsorted(grid, wanted, side="right") - 1
    index = np.clip(found, 0, grid.size - 2).astype(np.intp)
    share = (wanted - grid[index]) / (grid[index + 1] - grid[index])
    return index, np.clip(share, 0.0, 1.0)
