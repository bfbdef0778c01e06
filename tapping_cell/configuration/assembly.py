"""Construction of the planning objects from a cell's files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.scara import Branch
from tapping_cell.mechanics import Tap
from tapping_cell.planning import (
    ArmReach,
    CameraNoise,
    CircleArea,
    PlannerSettings,
    PlanningError,
    PolygonArea,
    PositioningSession,
    Scatter,
    StrikeSettings,
    StrikeSpace,
    Workspace,
    make_planner,
)
from tapping_cell.planning.fixed_session import FixedTapperSession
from tapping_cell.planning.fixed_tappers import FixedStrikeSpace, FixedTapper, WorkingArea
from tapping_cell.planning.session import GoalSession
from tapping_cell.se2 import Array, Pose, compose


def make_tap(cell: Cell) -> Tap:
    """Create the tap model of the cell's object and striker from the files."""
    return cell.object.tap(cell.file.tapper.striker())


def make_workspace(cell: Cell) -> Workspace:
    """Create the table with its keep-out zones."""
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
    """Create the scatter of a tap that the planner assumes."""
    return Scatter(**asdict(cell.object.scatter))


def make_strike_settings(cell: Cell) -> StrikeSettings:
    """Create the settings for the striker's shape and speeds."""
    tapper, curve = cell.file.tapper, cell.file.tapper.curve()
    return StrikeSettings(
        standoff=tapper.standoff,
        tool_radius=tapper.tool_radius,
        tool_start=tapper.tool_start,
        tool_length=tapper.tool_length,
        slowest=curve.slowest,
        fastest=curve.fastest,
    )


def make_arm_reach(cell: Cell) -> ArmReach:
    """Create the function that tests which tip poses the arm can reach.

    The function takes tip poses (..., 3) in the frame ``table``, and returns Booleans (..., 2), one
    for each side of the elbow.
    """
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
    """Create the space of feasible taps of this cell.

    ``scatter`` replaces the scatter of the object file.
    """
    return StrikeSpace(
        make_tap(cell),
        make_workspace(cell),
        make_arm_reach(cell),
        make_strike_settings(cell),
        scatter or make_scatter(cell),
    )


def make_fixed_space(
    cell: Cell, scatter: Scatter | None = None, objective: str = ""
) -> FixedStrikeSpace:
    """Create the space of feasible taps of the cell's fixed tappers.

    ``scatter`` replaces the scatter of the object file. ``objective``, if not empty, replaces the
    objective of the cell file.

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
        objective=objective or cell.file.goal.objective,
    )


def make_planner_settings(
    cell: Cell,
    tolerance: tuple[float, float],
    *,
    scatter: Scatter | None = None,
    camera: CameraNoise | None = None,
) -> PlannerSettings:
    """Create the settings of a planning method for a tolerance in m and rad.

    ``scatter`` and ``camera`` replace the values of the files.
    """
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


def make_session(
    cell: Cell,
    goal: ArrayLike,
    *,
    tolerance: tuple[float, float] | None = None,
    planner: str = "",
    camera: CameraNoise | None = None,
    probe: bool = False,
) -> GoalSession:
    """Create the closed loop of one goal: x, y (m), theta (rad) of the object in `table`.

    ``tolerance`` (m and rad), ``planner`` and ``camera`` replace the values of the cell file.
    ``probe``: begin with a few of the smallest taps, to measure an unknown friction. Create one
    session for each goal. For many goals, create the parts once (``PositioningSession``), because
    the map of the table takes about 0.1 s.

    Raises:
        tapping_cell.planning.PlanningError: the planning method is unknown, a value is out of
            range, or a probe is requested of fixed tappers.
    """
    wanted = cell.tolerance if tolerance is None else tolerance
    if not isinstance(wanted, Sequence) or len(wanted) != 2:
        raise PlanningError(
            f"the tolerance is {wanted!r}; give two numbers, (position in m, angle in rad)"
        )
    settings = make_planner_settings(cell, (wanted[0], wanted[1]), camera=camera)
    if cell.file.fixed_tappers is not None:
        if probe:
            raise PlanningError("fixed tappers make no probe taps; leave out probe")
        return FixedTapperSession(goal, settings, make_fixed_space(cell))
    method = make_planner(planner or cell.file.goal.planner, settings)
    return PositioningSession(goal, method, make_strike_space(cell), probe=probe)
