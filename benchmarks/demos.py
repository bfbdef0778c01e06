"""Benefit of a fitted object file in demos: taps with the configured and with the fitted file.

The demos use the planning sessions of the cell (planner, learning from taps, arm, table). The taps
of a demo are made in the simulated world, which integrates every slide in time. A truth file
defines the world's tilt, uneven pressure, scatter and arm errors. Images, serial lines and the ROS
graph are omitted, so that a demo takes a fifth of a second. The true friction, torque factor,
restitution and contact friction are 15 to 20 % higher or lower than configured. For each of these
ground truths, the object file is fitted to 4 runs of 10 single taps.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.closed_loop import TRUTHS, fitted_file
from tapping_cell.calibration.experiment import StrikerSection
from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.configuration.schema import load
from tapping_cell.planning import FreeSpace, PositioningSession, make_planner
from tapping_cell.planning.session import Done, Strike
from tapping_cell.se2 import Pose, wrap_angle
from tapping_cell.simulation.truth import ArmTruth, ImpactTruth, TruthFile
from tapping_cell.simulation.world import World

DEFAULT_COUNT = 60
MOVES = ((10.0, 0.0, 10.0), (40.0, -25.0, 30.0), (-35.0, 30.0, -25.0), (70.0, 10.0, 15.0))
"""Goals relative to the object's pose, used in turn: mm, mm and degrees."""
_MEASUREMENT_STD = (1.5e-5, 1.5e-5, 3e-4)
"""Standard deviations of a stationary observation: m, m, rad."""


def measure(count: int = DEFAULT_COUNT) -> dict[str, Any]:
    """Return the mean number of taps over ``count`` demos for each ground truth."""
    configured = load_cell()
    tapper = configured.file.tapper
    striker = StrikerSection(tapper.mass, tapper.tip_radius, tapper.constraint)
    rows = []
    for seed, (friction, torque, restitution, contact) in enumerate(TRUTHS):
        default = load(TruthFile, shared_folder() / "truth" / "default.yaml")
        truth = replace(
            default,
            support=replace(default.support, friction_factor=friction, torque_factor_ratio=torque),
            impact=ImpactTruth(restitution, contact, default.impact.striker_speed_factor),
        )
        old = _demos(configured, configured.object, truth, count)
        fitted = replace(configured, object=fitted_file(configured.object, striker, truth, seed))
        new = _demos(fitted, configured.object, truth, count)
        # Simulate a cell after `calibrate tapper`. This command corrects the tapper's speed curve.
        # The true speed of the striker therefore equals the commanded speed.
        nominal = replace(truth, impact=replace(truth.impact, striker_speed_factor=1.0))
        both = _demos(fitted, configured.object, nominal, count)
        saved = np.array(old) - np.array(new)
        rows.append(
            {
                "truth": (friction, torque, restitution, contact),
                "configured": float(np.mean(old)),
                "fitted": float(np.mean(new)),
                "fitted_and_tapper": float(np.mean(both)),
                "fewer": 1.0 - float(np.sum(new)) / float(np.sum(old)),
                "fewer_deviation": float(saved.std() / math.sqrt(count) / np.mean(old)),
            }
        )
    return {"demos": count, "truths": rows}


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = [
        f"mean taps of {report['demos']} demos of 10 to 71 mm and 10 to 30 degrees, by the"
        " ratios of the true to the configured friction, torque factor, restitution and contact"
        " friction:"
    ]
    for row in report["truths"]:
        factors = ", ".join(f"{factor:g}" for factor in row["truth"])
        text.append(
            f"  {factors}: {row['configured']:.2f} as configured, {row['fitted']:.2f} as fitted:"
            f" {100 * row['fewer']:.0f} +- {100 * row['fewer_deviation']:.0f} % fewer;"
            f" {row['fitted_and_tapper']:.2f} with the tapper calibrated as well:"
            f" {100 * (1 - row['fitted_and_tapper'] / row['configured']):.0f} % fewer"
        )
    before, *after = (
        sum(row[name] for row in report["truths"])
        for name in ("configured", "fitted", "fitted_and_tapper")
    )
    shares = [f"{100 * (1 - taps / before):.0f} %" for taps in after]
    text.append(f"  all: {shares[0]} fewer, {shares[1]} with the tapper calibrated as well")
    return text


def _demos(cell: Cell, assumed: ObjectFile, truth: TruthFile, count: int) -> list[int]:
    """Return the number of taps of each demo; a demo that fails counts as the maximum number.
    ``cell`` contains the object file that the planner uses. The ratios in ``truth`` refer to the
    values in the object file ``assumed``."""
    goal = cell.file.goal
    tolerance = (goal.position_tolerance, goal.angle_tolerance)
    planner = make_planner(goal.planner, assembly.make_planner_settings(cell, tolerance))
    space = assembly.make_strike_space(cell)
    free = FreeSpace(space)
    taps = []
    for seed in range(1, count + 1):
        world = World(assumed, cell.file.tapper.striker(), cell.file.tapper.stroke, truth, seed)
        start = Pose(*truth.object_start)
        world.place(start)
        dx, dy, turn = MOVES[seed % len(MOVES)]
        wanted = (
            start.x + dx / 1000,
            start.y + dy / 1000,
            float(wrap_angle(start.theta + math.radians(turn))),
        )
        session = PositioningSession(wanted, planner, space, free, most_taps=goal.max_taps)
        done = _position(cell, assumed, world, session, truth.arm, np.random.default_rng([seed, 7]))
        taps.append(session.taps if done else goal.max_taps)
    return taps


def _position(
    cell: Cell,
    assumed: ObjectFile,
    world: World,
    session: PositioningSession,
    arm: ArmTruth,
    random: np.random.Generator,
) -> bool:
    """Tap until the goal is reached or the session refuses another tap. Return whether the goal was
    reached."""
    covariance = np.diag(np.square(_MEASUREMENT_STD))

    def measure() -> np.ndarray:
        here = world.pose
        return np.array([here.x, here.y, here.theta]) + _MEASUREMENT_STD * random.standard_normal(3)

    now = 0.0
    world.advance(now)
    seen = measure()
    decision = session.decide(seen, covariance)
    while isinstance(decision, Strike):
        tip = _true_tip(cell, decision.plan.strike_pose, arm, random)
        world.strike(tip, assumed.height / 2, decision.plan.striker_speed, now)
        now = world.settle()
        before, seen = seen, measure()
        session.observe(decision, before, seen, covariance)
        decision = session.decide(seen, covariance)
    return isinstance(decision, Done)


def _true_tip(cell: Cell, asked: Pose, arm: ArmTruth, random: np.random.Generator) -> Pose:
    """Return the true pose of the tip for a commanded pose."""
    geometry = cell.arm.geometry()
    local = cell.arm_base.inverse() @ asked
    solution = geometry.inverse((local.x, local.y, cell.arm.strike_height, local.theta))
    assert solution.joints is not None, solution.reason
    play = np.array(arm.backlash) * (random.random(4) - 0.5)
    off = np.array(arm.joint_offset) + np.array(arm.repeatability) * random.standard_normal(4)
    tip = geometry.forward(np.array(solution.joints) + off + play)
    return cell.arm_base @ Pose(*arm.base_offset) @ Pose(tip.x, tip.y, tip.yaw)
