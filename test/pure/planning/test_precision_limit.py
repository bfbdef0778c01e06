"""Tolerances that no tap can meet are refused, and the refusal states the limit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tapping_cell.planning import CameraNoise, PlannerSettings, Scatter
from tapping_cell.planning.precision_limit import precision_limit, smallest_tap_share

CAMERA_NOISE = CameraNoise(1e-5, math.radians(0.01))


def at(tolerance: float, **others: float | CameraNoise | Scatter) -> PlannerSettings:
    """Return settings for a tolerance in mm and degrees."""
    size = {"tolerance_position": 1e-3 * tolerance, "tolerance_angle": math.radians(tolerance)}
    return replace(PlannerSettings(camera=CAMERA_NOISE), **size, **others)


@pytest.mark.parametrize("tolerance", [1.0, 0.3, 0.1, 0.05])
def test_the_share_matches_sampled_taps(tolerance: float) -> None:
    settings = at(tolerance)
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((5, 200_000))
    measurement = math.sqrt(2.0) * CAMERA_NOISE.position
    along = 0.05 * 0.0017 * noise[0] + measurement * noise[1]
    across = math.radians(1.0) * 0.0017 * noise[2] + measurement * noise[3]
    box = settings.stopping
    turned = math.sqrt(2.0) * CAMERA_NOISE.angle * noise[4]
    inside = (np.hypot(along, across) <= box.distance) & (np.abs(turned) <= box.rotation)
    assert smallest_tap_share(settings) == pytest.approx(inside.mean(), abs=0.004)


def test_fine_tolerances_are_accepted_down_to_the_limit_of_the_smallest_tap() -> None:
    assert precision_limit(at(0.1)) == precision_limit(at(0.05)) == ""
    coarse = at(0.05, smallest_distance=0.006)
    refused = precision_limit(coarse)
    assert "0.05 mm" in refused and "a tap of 6 mm scatters by 0.3 mm" in refused
    assert precision_limit(replace(coarse, scatter=Scatter(0.005, 0.05, 0.002))) == ""
    # Another check refuses a tolerance below the camera's accuracy.
    assert precision_limit(replace(coarse, camera=CameraNoise(1e-4, 1e-3))) == ""


def test_a_floor_of_the_scatter_limits_the_tolerance() -> None:
    coarse = replace(at(0.1), scatter=Scatter(0.01, 0.05, 0.005))
    assert precision_limit(coarse) == ""
    rough = replace(coarse, scatter=Scatter(0.01, 0.05, 0.005, position_floor=5e-4))
    assert "scatters by 0.5 mm along and 0.5 mm across" in precision_limit(rough)
    turned = replace(coarse, scatter=Scatter(0.01, 0.05, 0.005, angle_floor=math.radians(2.0)))
    assert "by 2 degrees in rotation" in precision_limit(turned)
