"""Repeated runs in the plane of distance and rotation, like figures 5 and 6 of the paper."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.planning.interface import Array, Planner


def fan_of_runs(
    planner: Planner, goal: tuple[float, float], count: int, seed: int, most_taps: int = 20
) -> list[Array]:
    """Simulate runs from (0, 0) to ``goal`` = (distance in m, rotation in rad); return the states
    of each run, (taps + 1, 2).

    The camera has no noise, and taps have the scatter that the planner assumes. The first
    coordinate is the object's position along the line from the start to the goal; sideways drift is
    not included.
    """
    rng = np.random.default_rng(seed)
    scatter, box = planner.settings.scatter, planner.settings.stopping
    runs = []
    for _ in range(count):
        place = np.zeros(3)
        track = [(0.0, 0.0)]
        while len(track) <= most_taps:
            left = np.array([goal[0], 0.0, goal[1]]) - place
            distance = math.hypot(left[0], left[1])
            if distance <= box.distance and abs(left[2]) <= box.rotation:
                break
            tap = planner.choose(distance, left[2])
            noise = rng.standard_normal(3)
            size, turn = float(tap.distance), float(tap.rotation)
            length = size + float(scatter.along(size)) * noise[0]
            heading = math.atan2(left[1], left[0]) + float(scatter.across(size)) / size * noise[2]
            turn += float(scatter.turning(turn)) * noise[1]
            place = place + np.array([length * math.cos(heading), length * math.sin(heading), turn])
            track.append((float(place[0]), float(place[2])))
        runs.append(np.array(track))
    return runs
