"""Agreement of the simulated world with closed-form solutions, and its processor time per tap.

A free striker makes random taps of three bodies in a simulated world without errors. The contact is
integrated in time, and the velocity after the contact is compared with the velocity after the
closed-form impact. The simulated velocity is read 0.3 ms after the impact, so the difference
includes the speed that the body has lost to the table's friction in this time. The slide that
follows is compared with the closed-form slide. Then the processor time of a tap is measured in each
supplied world.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import ObjectFile, load_object
from tapping_cell.configuration.schema import load
from tapping_cell.mechanics import Striker
from tapping_cell.se2 import Pose
from tapping_cell.simulation.truth import ImpactTruth, TruthFile
from tapping_cell.simulation.world import World

TAPS = 40
_STRIKER = Striker(0.1, 0.0054, "free")
_STROKE = 0.05


def measure() -> dict[str, Any]:
    """Return, for each body, the largest relative errors of launch and slide, and, for each shipped
    world, the processor time per tap in ms."""
    disk = load_cell().object
    bodies = {
        "disk": disk,
        "ring": replace(disk, shape=replace(disk.shape, kind="ring")),
        "square": load_object(shared_folder() / "objects" / "aluminium_square.yaml"),
    }
    worlds = sorted((shared_folder() / "truth").glob("*.yaml"))
    return {
        "agreement": {name: _agreement(content) for name, content in bodies.items()},
        "ms": {path.stem: _cost(disk, load(TruthFile, path)) for path in worlds},
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = [
        f"{name}: launch within {100 * row['launch']:.2f} %, "
        f"slide within {100 * row['slide']:.3f} %"
        for name, row in report["agreement"].items()
    ]
    cost = ", ".join(f"{name} {ms:.0f}" for name, ms in report["ms"].items())
    return [*text, f"processor time per tap in ms: {cost}"]


def _agreement(content: ObjectFile) -> dict[str, float]:
    """Return the largest error of the velocity and of R omega, relative to the speed, and the
    largest relative error of the slide."""
    tap = content.tap(_STRIKER)
    random = np.random.default_rng(0)
    launch = slide = 0.0
    radius = tap.body.support_radius
    # The closed form has only one contact. Therefore, the striker retracts after the first contact
    # (follow_through=0), so that an edge of the rotating object cannot hit it again.
    plain = TruthFile((0.0, 0.0, 0.0), impact=ImpactTruth(follow_through=0.0))
    for wanted in _displacements(random, tap.cone_slope):
        if not tap.reachable(wanted):
            continue
        plan = tap.plan(wanted)
        world = World(content, _STRIKER, _STROKE, plain, 1)
        world.advance(0.0)
        tip = Pose(*plan.strike_pose.tolist()) @ Pose(-0.015, 0.0, 0.0)
        assert world.strike(tip, content.height / 2, float(plan.striker_speed), 0.0)
        world.advance(0.015 / float(plan.striker_speed) + 0.0003)
        vx, vy, spin = world.twist
        began = world.pose
        world.settle()
        speed = math.hypot(plan.twist[0], plan.twist[1])
        off = math.hypot(vx - plan.twist[0], vy - plan.twist[1])
        turn = radius * abs(spin - float(plan.twist[2]))
        launch = max(launch, off / speed, turn / speed)
        cos, sin = math.cos(began.theta), math.sin(began.theta)
        local = (cos * vx + sin * vy, cos * vy - sin * vx, spin)
        dx, dy, rotation = tap.sliding.displace(local).tolist()
        end = began.inverse() @ world.pose
        way = math.hypot(dx, dy)
        off = math.hypot(end.x - dx, end.y - dy)
        slide = max(slide, off / way, radius * abs(end.theta - rotation) / way)
    return {"launch": launch, "slide": slide}


def _displacements(random: np.random.Generator, slope: float) -> np.ndarray:
    distance = random.uniform(0.003, 0.06, TAPS)
    heading = random.uniform(-math.pi, math.pi, TAPS)
    turn = random.uniform(-0.9, 0.9, TAPS) * slope * distance
    return np.column_stack([distance * np.cos(heading), distance * np.sin(heading), turn])


def _cost(content: ObjectFile, truth: TruthFile) -> float:
    tap = content.tap(_STRIKER)
    world = World(content, _STRIKER, _STROKE, truth, 1)
    world.advance(0.0)
    now, wanted = 0.0, _displacements(np.random.default_rng(1), tap.cone_slope)
    began = time.process_time()
    for row in wanted:
        world.place(Pose(0.0, 0.0, 0.0))
        plan = tap.plan(row)
        tip = Pose(*plan.strike_pose.tolist()) @ Pose(-0.015, 0.0, 0.0)
        world.strike(tip, content.height / 2, float(plan.striker_speed), now)
        now = world.settle()
    return 1e3 * (time.process_time() - began) / len(wanted)
