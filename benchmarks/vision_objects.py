"""Processor time per image with 1, 5 and 20 objects on the table, each with a marker of its own.

In each image, the noise is new and the objects are shifted, so that the tracker measures them
again. All objects are measured in each image, whereas a node measures the further objects in turn.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from tapping_cell.configuration.cell import load_cell
from tapping_cell.simulation.rendered_camera import SceneObject
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.truth import CameraTruth
from tapping_cell.vision import ObjectMarker, PoseTracker, TrackerSettings, marker_ids

DEFAULT_COUNT = 60
NUMBERS = (1, 5, 20)
RADIUS, MARKER = 0.022, 0.026
FIRST_ID = 20
COLUMNS, PITCH = 5, 0.075
WARM_UP = 5


def measure(count: int) -> dict[str, Any]:
    """Return, for each number of objects, the processor time per image in s and the number of
    objects found."""
    cv2.setNumThreads(1)
    return {str(number): _measure(number, count) for number in NUMBERS}


def _measure(number: int, count: int) -> dict[str, float]:
    cell = load_cell()
    own = cell.object.seen()
    assert isinstance(own, ObjectMarker)
    seen = [replace(own, id=FIRST_ID + each, size=MARKER) for each in range(number)]
    turn = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    outline = RADIUS * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    disks = [SceneObject(outline, each) for each in seen]
    assert cell.object.marker is not None
    marker = replace(cell.object.marker, id=FIRST_ID, size=MARKER)
    small = replace(cell, object=replace(cell.object, marker=marker))
    renderer = make_renderer(small, CameraTruth(noise=2.0), outline, 1, disks[1:])
    settings = TrackerSettings(other_ids=marker_ids(seen))
    tracker = PoseTracker(cell.camera, cell.references, seen[0], settings, seen[1:])
    place = np.arange(number)
    poses = np.stack(
        [
            PITCH * (place % COLUMNS - (min(number, COLUMNS) - 1) / 2),
            PITCH * (place // COLUMNS - ((number - 1) // COLUMNS) / 2),
            0.3 * place,
        ],
        axis=-1,
    )
    random = np.random.default_rng(number)
    spent, found = [], 0
    for frame in range(WARM_UP + count):
        shift = 1e-4 * random.standard_normal(poses.shape)
        image = renderer.render(poses + shift)
        began = time.thread_time()
        first, others = tracker.update_several(image, frame / 30.0, range(number - 1))
        spent.append(time.thread_time() - began)
        if frame >= WARM_UP:
            found += first.visible + sum(each.visible for each in others.values())
    taken = np.array(spent[WARM_UP:])
    return {
        "median_s": float(np.median(taken)),
        "slowest_s": float(taken.max()),
        "found": found / (count * number),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    rows = ["processor time of an image in which every object is measured"]
    rows.append("objects   median   slowest   found")
    for number, row in report.items():
        rows.append(
            f"{number:>7}  {1e3 * row['median_s']:5.1f} ms  {1e3 * row['slowest_s']:5.1f} ms  "
            f"{100 * row['found']:5.1f} %"
        )
    return rows
