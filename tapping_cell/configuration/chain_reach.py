"""Check whether an arm that is not a SCARA reaches the strike poses that the planner may choose.

The planner considers a strike pose reachable if the SCARA in the section ``arm`` of the cell file
reaches it. A grid of these poses is checked.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.chain_link import upright
from tapping_cell.hardware.scara import ReachCode
from tapping_cell.hardware.serial_chain import Array, SerialChain
from tapping_cell.se2 import Pose

PLACES = 5
"""Number of checked positions along each side of the table."""
DIRECTIONS = 6
"""Number of checked directions of the line of travel at each position."""
FIRST_SEEDS = 40
"""Number of random initial joint positions for the inverse kinematics of the park pose."""


def chain_reach(cell: Cell) -> Iterator[str]:
    """Yield a warning if the arm cannot reach the park pose, or a strike pose that the SCARA
    reaches."""
    chain = cell.arm.chain()
    if chain is None:
        return
    seed = _first(chain, upright(np.array(cell.arm.geometry().forward(cell.arm.park))))
    if seed is None:
        yield (
            f"{cell.path}: the arm of arm.ros2_control.chain cannot reach the park pose (arm.park) "
            "with the striker upright; check chain.mount, chain.tool and arm.park"
        )
        return
    missed, asked, where = 0, 0, ""
    for tip in _stations(cell):
        asked += 1
        joints, reason = _near(chain, upright(tip), seed)
        if joints is None:
            missed += 1
            where = where or reason
        else:
            seed = joints
    if missed:
        yield (
            f"{cell.path}: the real arm cannot reach {100 * missed / asked:.0f} % of the strike "
            "poses above the table that the SCARA of the section arm reaches; the first failure: "
            f"{where}. A tap at such a pose ends in a fault; move the arm, or narrow arm.lower and "
            "arm.upper"
        )


def _stations(cell: Cell) -> Iterator[Array]:
    """Yield the tip poses of a grid over the table that the SCARA reaches, in the frame
    ``arm_base``."""
    table, geometry, to_base = cell.file.table, cell.arm.geometry(), cell.arm_base.inverse()
    for x in np.linspace(-table.length / 2, table.length / 2, PLACES):
        for y in np.linspace(-table.width / 2, table.width / 2, PLACES):
            for yaw in np.linspace(-math.pi, math.pi, DIRECTIONS, endpoint=False):
                place = to_base @ Pose(float(x), float(y), float(yaw))
                tip = np.array([place.x, place.y, cell.strike_height, place.theta])
                reached = any(
                    int(geometry.inverse_many(tip, branch, cell.arm.park).code) == ReachCode.REACHED
                    for branch in type(geometry.branch_of(cell.arm.park))
                )
                if reached:
                    yield tip


def _first(chain: SerialChain, target: Array) -> Array | None:
    """Solve the inverse kinematics of a pose, trying several initial joint positions. Return None
    if all fail."""
    draw = np.random.default_rng(0)
    middle = (chain.lower + chain.upper) / 2
    seeds = [middle, *draw.uniform(chain.lower, chain.upper, (FIRST_SEEDS, len(middle)))]
    solved = (chain.inverse(target, seed) for seed in seeds)
    return next((solution.joints for solution in solved if solution.success), None)


def _near(chain: SerialChain, target: Array, seed: Array) -> tuple[Array | None, str]:
    """Solve the inverse kinematics of a pose, starting from the joints of a neighbouring pose.

    If this fails, try again with one rotary joint shifted by a full turn. Return the joints and an
    empty text or, if all attempts fail, None and the reason.
    """
    first = chain.inverse(target, seed)
    if first.success:
        return first.joints, ""
    for joint in reversed(range(len(seed))):
        for turn in (-math.tau, math.tau):
            turned = seed.copy()
            turned[joint] += turn
            if not chain.joints[joint].prismatic and (
                chain.lower[joint] <= turned[joint] <= chain.upper[joint]
            ):
                solution = chain.inverse(target, turned)
                if solution.success:
                    return solution.joints, ""
    return None, first.reason
