"""Coverage of the 95 % intervals of ``object learn``, from poses at rest and with tracks.

The objects are the disks and rings of the section unknown-objects; fits of polygons take ten times
as long. Each makes 24 random taps in two simulated worlds: one whose only effect is the scatter,
and one whose friction depends on speed and direction and whose impact is not that of the model,
with random sizes up to those of ``config/truth/everything.yaml``. Both integrate the motion in
time, and the striker may hit a light object again. With tracks, the camera sees the slides at
30 Hz. The friction of the second world is not one number, so only its torque factor is compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.unknown_objects import CAMERA, TRUTH, drawn_object
from benchmarks.unknown_worlds import drawn_world
from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.learnt_object import Launches, learn_object
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.objects import GRAVITY, ObjectFile
from tapping_cell.mechanics import Sliding
from tapping_cell.planning.track import Track, launch_from
from tapping_cell.se2 import Array
from tapping_cell.simulation.tap_trials import PATH_STEP_S, SimulatedTaps
from tapping_cell.simulation.truth import TruthFile

DEFAULT_COUNT = 60
"""Number of objects per world."""

TAPS = 24
DISTANCES = (0.003, 0.040)
IMAGE_STEPS = round(1 / 30 / PATH_STEP_S)
BEFORE = 2
"""Number of images of the object at rest before the strike."""


def worlds(seed: int) -> dict[str, TruthFile]:
    """Return the two worlds of an object."""
    drawn = drawn_world((1.0, 1.0), np.random.default_rng(seed))
    surface = replace(drawn.surface, patches=())
    return {
        "scatter only": TRUTH,
        "other friction and impact": replace(TRUTH, surface=surface, impact=drawn.impact),
    }


def taps(
    true: ObjectFile, begun: ObjectFile, truth: TruthFile, seed: int
) -> tuple[Array, Array, Launches]:
    """Return commanded and measured displacements (n, 3) and launches of random taps that were
    planned with the file ``begun``, but move the object as far as desired."""
    rng = np.random.default_rng(seed)
    cell = load_cell()
    tap = replace(begun.tap(cell.file.tapper.striker()), smallest_distance=0.0)
    asked = np.empty((0, 3))
    while len(asked) < TAPS:
        length = np.exp(rng.uniform(*np.log(DISTANCES), 64)) * true.friction / begun.friction
        heading = rng.uniform(-math.pi, math.pi, 64)
        turn = rng.uniform(-1.0, 1.0, 64) * tap.cone_slope * length
        some = np.stack([length * np.cos(heading), length * np.sin(heading), turn], axis=1)
        asked = np.concatenate([asked, some[tap.reachable(some)]])[:TAPS]
    world = SimulatedTaps(tap, true, truth, cell.file.tapper.standoff)
    sliding = Sliding(begun.body(), begun.friction, begun.torque_factor, GRAVITY)
    rest, gains, noise = np.zeros((1, 3)), np.ones((1, 4)), CAMERA.deviations
    before = -IMAGE_STEPS * PATH_STEP_S * np.arange(BEFORE, 0, -1)
    moved, rows = [], []
    for wanted in asked:
        moved.append(world.answer(rest, rest, wanted[None], gains, rng)[0])
        images = slice(int(rng.integers(IMAGE_STEPS)), None, IMAGE_STEPS)
        time, path = (part[images] for part in world.path())
        time = np.concatenate([time[0] + before, time])
        poses = np.concatenate([np.zeros((BEFORE, 3)), path])
        poses = poses + rng.standard_normal(poses.shape) * noise
        track = Track(time, poses, np.tile(noise[1:], (len(time), 1)))
        found = launch_from(track, np.zeros(3), moved[-1], sliding)
        rows.append(np.full(4, math.nan))
        if found is not None:
            rows[-1][:] = found.speed, found.spin, found.speed_std, found.spin_std
    return asked, np.array(moved), Launches(*np.array(rows).T)


def partial_reports(count: int) -> Iterator[dict[str, Any]]:
    """Yield, after each object, the widths of the intervals and whether they contain the truth."""
    report: dict[str, Any] = {}
    for number in range(count):
        seed = 3 * (number // 2) + number % 2
        true, begun = drawn_object(seed)
        for name, truth in worlds(seed).items():
            asked, moved, launches = taps(true, begun, truth, seed)
            for tracked, seen in (("at rest", None), ("tracks", launches)):
                try:
                    learnt = learn_object(begun, asked, moved, seen)
                except RecordError:
                    continue
                for entry in learnt.estimates:
                    known = entry.name == "torque_factor" or truth is TRUTH
                    if entry.name in ("friction", "torque_factor") and known and entry.fitted:
                        value = getattr(true, entry.name)
                        row = {
                            "inside": entry.low < value < entry.high,
                            "low": value > entry.high,
                            "factor": math.sqrt(entry.high / entry.low),
                        }
                        report.setdefault(f"{entry.name}, {name}, {tracked}", []).append(row)
        yield report


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = []
    for name, rows in sorted(report.items()):
        inside = sum(row["inside"] for row in rows)
        text.append(
            f"{name:<55} {inside} of {len(rows)} intervals contain the true value "
            f"({100 * inside / len(rows):.0f} %), {sum(row['low'] for row in rows)} are too low; "
            f"median half width: factor {np.median([row['factor'] for row in rows]):.3f}"
        )
    return text
