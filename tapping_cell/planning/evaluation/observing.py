"""Decisions of a session in a simulated trial, including the longer observations it requests."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array
from tapping_cell.planning.session import Decision, ObserveAgain
from tapping_cell.planning.settings import CameraNoise
from tapping_cell.planning.stopping import LONG_OBSERVATION


class DecidingSession(Protocol):
    """A session that decides on the next tap from an observation."""

    def decide(
        self,
        object_pose: ArrayLike,
        covariance: ArrayLike | None = None,
        *,
        observe_again: bool = False,
    ) -> Decision:
        """Return the decision for a measured pose (3,) with its covariance (3, 3)."""


def decide(
    session: DecidingSession,
    pose: Array,
    seen: Array,
    camera: CameraNoise,
    rng: np.random.Generator,
) -> tuple[Decision, Array]:
    """Return the session's decision and the measured pose that it is based on.

    ``pose``: true pose (3,); ``seen``: its first observation (3,). Each longer observation is the
    mean of all observations so far and a new one with independent noise.
    """
    for observations in range(1, LONG_OBSERVATION + 1):
        decision = session.decide(
            seen, camera.covariance / observations, observe_again=observations < LONG_OBSERVATION
        )
        if not isinstance(decision, ObserveAgain):
            break
        fresh = pose + camera.deviations * rng.standard_normal(3)
        seen = seen + (fresh - seen) / (observations + 1)
    return decision, seen
