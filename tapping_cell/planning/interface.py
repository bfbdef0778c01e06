"""The one small interface behind which every planning method stands."""

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
    """A planning method: which tap next, from what remains to the goal.

    ``choose`` is a pure function of what remains, vectorised, and never fails: it also answers
    inside the stopping box (a look with more noise than usual may want one more tap).
    """

    @property
    def name(self) -> str:
        """The method that answers now (a fallback may answer while a plan is solved)."""
        ...

    @property
    def settings(self) -> PlannerSettings:
        """What the plan was made for."""
        ...

    def choose(self, distance: ArrayLike, rotation: ArrayLike) -> Taps:
        """The next tap for what remains: distance >= 0 in m, rotation in rad, any shape."""
        ...

    def taps_to_go(self, distance: ArrayLike, rotation: ArrayLike) -> Array:
        """About how many taps the method needs from there; ranks taps that replace the best one."""
        ...


@runtime_checkable
class TapValues(Protocol):
    """A planning method that also knows what taps beside the line to the goal are worth."""

    def taps_after(
        self, distance: float, rotation: float, aside: Array, sizes: Array, turns: Array
    ) -> Array | None:
        """Expected taps that follow a tap, (directions, sizes, turns); infinite outside the cone;
        None while the method cannot tell.

        distance, rotation: what remains before it, m and rad. aside: directions of the tap from
        that of the goal, rad. sizes: m, above 0. turns: rad.
        """
        ...
