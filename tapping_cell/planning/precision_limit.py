"""Check whether taps can meet a tolerance, given the scatter of the object's smallest tap."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.stopping import inside_probability

MIN_SHARE = 0.05
"""Minimum share of the smallest taps that end within the tolerance. With a share of one in twenty,
a goal takes about forty taps."""


def smallest_tap_share(settings: PlannerSettings) -> float:
    """Compute the share of the smallest taps that end in the stopping box under the best
    conditions: the object's distance from the goal is exactly the length of the tap, and the tap
    points straight towards the goal."""
    least, scatter, camera = settings.smallest_distance, settings.scatter, settings.camera
    # Two observations contribute noise: one for aiming the tap and one for judging its result.
    camera_noise = 2.0 * camera.position**2
    turn = 2.0 * camera.angle**2 + scatter.angle_floor**2
    along = float(scatter.along(least)) ** 2 + camera_noise
    across = float(scatter.across(least)) ** 2 + camera_noise
    box = settings.stopping
    spread = np.diag([along, across, 0.0])
    placed = float(inside_probability(np.zeros(3), spread, box.distance, math.pi))
    return placed * math.erf(box.rotation / math.sqrt(2.0 * max(turn, 1e-18)))


def precision_limit(settings: PlannerSettings) -> str:
    """Return why taps cannot meet this tolerance, with the figures, or an empty string if they can.

    The accuracy of the camera is checked for each observation (see ``stopping``).
    """
    share = smallest_tap_share(settings)
    if share >= MIN_SHARE or not settings.stopping.camera_suffices:
        return ""
    least, scatter = settings.smallest_distance, settings.scatter
    along, across = float(scatter.along(least)), float(scatter.across(least))
    turned = ""
    if scatter.angle_floor > 0.0:
        turned = f" and by {math.degrees(scatter.angle_floor):.2g} degrees in rotation"
    return (
        f"the tolerance of {1e3 * settings.tolerance_position:.3g} mm and "
        f"{math.degrees(settings.tolerance_angle):.3g} degrees is too fine for the smallest tap: "
        f"a tap of {1e3 * least:.3g} mm scatters by {1e3 * along:.2g} mm along and "
        f"{1e3 * across:.2g} mm across its direction{turned}, so that only {100.0 * share:.2g} % "
        f"of such taps would end within the tolerance; {100.0 * MIN_SHARE:.0f} % are needed. Widen "
        "the tolerance, or make smaller or more repeatable taps (smallest_tap and scatter of the "
        "object's file)"
    )
