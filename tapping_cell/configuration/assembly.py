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
from tapping_cell.planning.fixed_tappers import FixedStrikeSpace, FixedTapper, WorkingArea
from tapping_cell.se2 import Array, Pose, compose


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
    arm, tapper, curve = cell.arm, cell.file.tapper, cell.file.tapper.curve()
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
    geometry = cell.arm.geometry()
    into_base = cell.arm_base.inverse()
    height = cell.arm.strike_height

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


def make_fixed_space(cell: Cell, scatter: Scatter | None = None) -> FixedStrikeSpace:
    """Which taps the cell's fixed tappers can make; ``scatter`` in the place of the object file's.

    Raises:
        ConfigurationError: the cell has an arm.
    """
    fixed = cell.fixed_tappers
    tappers = []
    for entry in fixed.tappers:
        own = cell.tapper_of(entry)
        curve = own.curve()
        tappers.append(
            FixedTapper(
                name=entry.name,
                mount=Pose(*entry.position, entry.direction),
                stroke=own.stroke,
                tap=cell.object.tap(own.striker()),
                slowest=curve.slowest,
                fastest=curve.fastest,
            )
        )
    return FixedStrikeSpace(
        tappers,
        make_workspace(cell),
        WorkingArea(*fixed.working_area),
        scatter or make_scatter(cell),
        smallest_distance=cell.object.smallest_tap,
        tool_radius=cell.file.tapper.tool_radius,
    )


def make_planner_settings(
    cell: Cell,
    tolerance: tuple[float, float],
    *,
    scatter: Scatter | None = None,
    camera: CameraNoise | None = None,
) -> PlannerSettings:
    """What a planning method is told, for a tolerance in m and rad; ``scatter`` and ``camera`` in
    the place of the files'."""
    tap = make_tap(cell)
    noise = cell.file.camera
    return PlannerSettings(
        cone_slope=tap.cone_slope,
        smallest_distance=cell.object.smallest_tap,
        scatter=scatter or make_scatter(cell),
        camera=camera or CameraNoise(noise.position_noise, noise.angle_noise),
        tolerance_position=tolerance[0],
        tolerance_angle=tolerance[1],
    )
