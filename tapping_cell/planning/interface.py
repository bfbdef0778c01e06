"""Interface of the planning methods."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.planning.settings import PlannerSettings

Array = NDArray[np.float64]


class Taps(NamedTuple):
    """Taps along the line from the object to the goal, arrays of one shape.

    distance: m, positive towards the goal, negative away from it.
    rotation: rad, counter-clockwise, at most the cone's slope times |distance|.
    """

    distance: Array
    rotation: Array


@runtime_checkable
class Planner(Protocol):
    """A planning method: chooses the next tap from the residual to the goal.

    ``choose`` is a vectorised pure function of the residual and never raises an exception. It
    returns a tap even for a residual inside the stopping box, because an observation that is
    noisier than usual may require one more tap.
    """

    @property
    def name(self) -> str:
        """Name of the method in use; while a plan is being solved, the name of the fallback
        method."""
        ...

    @property
    def settings(self) -> PlannerSettings:
        """Settings that the plan was made for."""
        ...

    def choose(self, distance: ArrayLike, rotation: ArrayLike) -> Taps:
        """Choose the next tap for residuals of any shape: distance >= 0 in m, rotation in rad."""
        ...

    def taps_to_go(self, distance: ArrayLike, rotation: ArrayLike) -> Array:
        """Estimate how many taps these residuals need; used to rank alternative taps."""
        ...


@runtime_checkable
class TapValues(Protocol):
    """A planning method that can also evaluate taps that are not on the line to the goal."""

    def taps_after(
        self, distance: float, rotation: float, aside: Array, sizes: Array, turns: Array
    ) -> Array | None:
        """Return the expected number of further taps after a tap, (directions, sizes, turns);
        infinite outside the cone. Return None while no solution is available.

        distance, rotation: residual before the tap, m and rad. aside: directions of the tap
        relative to the direction of the goal, rad. sizes: lengths of the tap, m, above 0.
        turns: rotations of the tap, rad.
        """
        ...
