"""From a cell's files to what planning works with."""

from __future__ import annotations

import numpy as np

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.scara import Branch
from tapping_cell.mechanics import Tap
from tapping_cell.planning import (
    ArmReach,
    CameraNoise,
    CircleArea,
    PlannerSettings,
    PolygonArea,
    Scatter,
    StrikeSettings,
    StrikeSpace,
    Workspace,
)
from tapping_cell.se2 import Array, compose


def make_tap(cell: Cell) -> Tap:
    """How the cell's object answers the cell's striker, as far as the files know."""
    return cell.object.tap(cell.file.tapper.striker())


def make_workspace(cell: Cell) -> Workspace:
    """The table with its keep-outs."""
    table, keep_outs = cell.file.table, cell.file.keep_outs
    return Workspace(
        length=table.length,
        width=table.width,
        edge_margin=table.edge_margin,
        keep_outs=(
            *(CircleArea(*circle) for circle in keep_outs.circles),
            *(PolygonArea(corners) for corners in keep_outs.polygons),
        ),
        keep_out_margin=table.keep_out_margin,
        overhang=table.overhang,
    )


def make_scatter(cell: Cell) -> Scatter:
    """The scatter of a tap that the planner expects."""
    scatter = cell.object.scatter
    return Scatter(scatter.distance, scatter.rotation, scatter.direction)


def make_strike_settings(cell: Cell) -> StrikeSettings:
    """The striker's shape, heights and speeds."""
    arm, tapper, curve = cell.file.arm, cell.file.tapper, cell.file.tapper.curve()
    return StrikeSettings(
        standoff=tapper.standoff,
        strike_height=arm.strike_height,
        travel_height=arm.travel_height,
        tool_radius=tapper.tool_radius,
        tool_start=tapper.tool_start,
        tool_length=tapper.tool_length,
        slowest=curve.slowest,
        fastest=curve.fastest,
    )


def make_arm_reach(cell: Cell) -> ArmReach:
    """Which tip poses (..., 3) in ``table`` the arm can strike from: one column an elbow side."""
    geometry = cell.file.arm.geometry()
    into_base = cell.arm_base.inverse()
    height = cell.file.arm.strike_height

    def reach(tip_poses: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        planar = compose(into_base, tip_poses)
        heights = np.full(planar.shape[:-1], height)
        tips = np.stack([planar[..., 0], planar[..., 1], heights, planar[..., 2]], axis=-1)
        return np.stack([geometry.reachable(tips, side) for side in Branch], axis=-1)

    return reach


def make_strike_space(cell: Cell, scatter: Scatter | None = None) -> StrikeSpace:
    """Which taps can be struck in this cell; ``scatter`` in the place of the object file's."""
    return StrikeSpace(
        make_tap(cell),
        make_workspace(cell),
        make_arm_reach(cell),
        make_strike_settings(cell),
        scatter or make_scatter(cell),
    )


def make_planner_settings(cell: Cell, tolerance: tuple[float, float]) -> PlannerSettings:
    """What a planning method is told, for a tolerance in m and rad."""
    tap = make_tap(cell)
    camera = cell.file.camera
    return PlannerSettings(
        cone_slope=tap.cone_slope,
        smallest_distance=cell.object.smallest_tap,
        scatter=make_scatter(cell),
        camera=CameraNoise(camera.position_noise, camera.angle_noise),
        tolerance_position=tolerance[0],
        tolerance_angle=tolerance[1],
    )
