"""Processor time per image with 1, 5 and 20 objects on the table, each with a marker of its own.

The noise and the positions of the objects change from image to image, so that the tracker measures
every object again. The benchmark measures all objects in each image, whereas the node measures the
first object in each image and the other objects in turn.

The processor time of the search for objects without a file is measured in the same images. Only the
first object is known to the search, so the search has to find all other objects. (The node searches
at most every 0.15 s.) Then the search is run on images of the arm over an empty table, at random
places and with random light. The arm's joint positions are known to the search. The search must not
find any object.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from benchmarks.vision_scenes import Cell, random_place, random_scene
from tapping_cell.configuration.cell import load_cell
from tapping_cell.logic.arm_in_view import bars_in_table
from tapping_cell.se2 import Pose, transform_points
from tapping_cell.simulation.arm_picture import arm_solids
from tapping_cell.simulation.rendered_camera import SceneObject
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.truth import CameraTruth
from tapping_cell.vision import (
    ArmBars,
    ObjectMarker,
    PoseTracker,
    Standing,
    TrackerSettings,
    UnknownObjects,
    marker_ids,
)

DEFAULT_COUNT = 60
NUMBERS = (1, 5, 20)
RADIUS, MARKER = 0.022, 0.026
FIRST_ID = 20
COLUMNS, PITCH = 5, 0.075
WARM_UP = 5
ARM_SCENES, EACH_SCENE = 5, 5
"""Number of images of the arm in multiples of ``count``, and number of consecutive images with the
same light."""
AWAY = np.array([5.0, 5.0, 0.0])
"""Pose at which the scene's disk is out of view."""


def measure(count: int) -> dict[str, Any]:
    """Return, for each number of objects, the processor time per image in s and the number of
    objects found."""
    cv2.setNumThreads(1)
    report: dict[str, Any] = {str(number): _measure(number, count) for number in NUMBERS}
    return {**report, "arm": _false_objects(ARM_SCENES * count)}


def _false_objects(frames: int) -> dict[str, int]:
    """Return the number of images of the arm over an empty table, and the number of those images in
    which an object was found."""
    cell, full = Cell.load(), load_cell()
    arm, geometry, table = full.arm, full.arm.geometry(), full.file.table
    false = 0
    for frame in range(frames):
        random = np.random.default_rng([frame, 5])
        if frame % EACH_SCENE == 0:
            scene = random_scene(random, cell, frame)
        joints = None
        while joints is None:
            tip = full.arm_base.inverse() @ Pose(*random_place(random))
            joints = geometry.inverse((tip.x, tip.y, arm.strike_height, tip.theta)).joints
        bars = bars_in_table(full, geometry, [joints])
        solids = arm_solids(arm, full.file.tapper, full.arm_base, joints)
        finder = UnknownObjects(table.length, table.width, cell.table)
        hidden = ArmBars(bars.start[0], bars.end[0], bars.radius)
        finder.search(scene.render(AWAY, occluders=solids), scene.view, [], hidden)
        false += bool(finder.outlines)
    return {"frames": frames, "false": false}


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
    table = cell.file.table
    finder = UnknownObjects(table.length, table.width, cell.references)
    spent, searched, found, unknown = [], [], 0, 0
    for frame in range(WARM_UP + count):
        shift = 1e-4 * random.standard_normal(poses.shape)
        image = renderer.render(poses + shift)
        began = time.thread_time()
        first, others = tracker.update_several(image, frame / 30.0, range(number - 1))
        spent.append(time.thread_time() - began)
        pose = (poses + shift)[0]
        first_outline = Standing(transform_points(pose, outline), own.height)
        began = time.thread_time()
        finder.search(image, renderer.view, [first_outline])
        searched.append(time.thread_time() - began)
        if frame >= WARM_UP:
            unknown += len(finder.outlines)
            found += first.visible + sum(each.visible for each in others.values())
    taken = np.array(spent[WARM_UP:])
    return {
        "median_s": float(np.median(taken)),
        "slowest_s": float(taken.max()),
        "found": found / (count * number),
        "search_median_s": float(np.median(searched[WARM_UP:])),
        "unknown_found": unknown / count,
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    rows = ["processor time of an image in which every object is measured"]
    rows.append(
        "objects   median   slowest   found   search for objects without a file   of them found"
    )
    arm = report["arm"]
    for number, row in report.items():
        if number == "arm":
            continue
        rows.append(
            f"{number:>7}  {1e3 * row['median_s']:5.1f} ms  {1e3 * row['slowest_s']:5.1f} ms  "
            f"{100 * row['found']:5.1f} %   {1e3 * row['search_median_s']:9.1f} ms  "
            f"{row['unknown_found']:31.2f} of {int(number) - 1}"
        )
    rows.append(
        f"objects found without one, with the arm over the table: in {arm['false']} of "
        f"{arm['frames']} images"
    )
    return rows
