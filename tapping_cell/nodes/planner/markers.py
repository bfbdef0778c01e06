"""Markers of the cell for RViz and Foxglove, in ``table``.

The markers show the outlines of the table, the object, the goal and the predicted final pose. They
also show the goal tolerance, an arrow for the tap, keep-out zones, the workspace of the object and
its path so far, and fixed tappers with the lines along which they strike.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from tapping_cell.configuration.cell import Cell
from tapping_cell.logic.planner_reports import Scene
from tapping_cell.nodes.conversions import to_message
from tapping_cell.nodes.message_conversion import to_ros
from tapping_cell.planning import CircleArea, Strike
from tapping_cell.se2 import Pose

Points = NDArray[np.float64]
"""Points (n, 2) in ``table``, m."""

WHITE = ColorRGBA(r=0.9, g=0.9, b=0.9, a=0.8)
BLUE = ColorRGBA(r=0.2, g=0.5, b=1.0, a=1.0)
GREEN = ColorRGBA(r=0.2, g=0.8, b=0.3, a=1.0)
AMBER = ColorRGBA(r=1.0, g=0.7, b=0.2, a=1.0)
RED = ColorRGBA(r=0.9, g=0.2, b=0.2, a=1.0)
GREY = ColorRGBA(r=0.6, g=0.6, b=0.65, a=0.7)
LINE_WIDTH = 0.002
ORIGIN = Pose(0.0, 0.0, 0.0)


def cell_markers(cell: Cell, scene: Scene, region: Points) -> MarkerArray:
    """Return markers of the table, object, goal and current tap. Absent items are deleted.

    ``region``: edges (n, 2, 2) of the object's workspace in m.
    """
    goal, strike = scene.goal, scene.strike
    table, keep_outs = cell.file.table, cell.file.keep_outs
    half = np.array([table.length, table.width]) / 2
    corners = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    outline = np.asarray(cell.outline())
    reach = float(np.max(np.hypot(*outline.T)))
    heading = np.array([(0.0, 0.0), (reach, 0.0)])
    markers = [_line("table", 0, corners, ORIGIN, WHITE)]
    for number, (x, y, radius) in enumerate(keep_outs.circles):
        markers.append(_line("keep_out", number, _circle(radius), Pose(x, y, 0.0), RED))
    for number, polygon in enumerate(keep_outs.polygons, start=len(keep_outs.circles)):
        markers.append(_line("keep_out", number, np.asarray(polygon), ORIGIN, RED))
    for number, area in enumerate(scene.others):
        if area is None:
            markers.append(_deletion("other_object", number))
        elif isinstance(area, CircleArea):
            centre = Pose(area.x, area.y, 0.0)
            markers.append(_line("other_object", number, _circle(area.radius), centre, RED))
        else:
            markers.append(_line("other_object", number, np.asarray(area.vertices), ORIGIN, RED))
    if cell.file.fixed_tappers is not None:
        markers += _tapper_markers(cell)
    predicted = strike.predicted if strike is not None else None
    drawn = (("object", scene.pose, BLUE), ("goal", goal, GREEN), ("predicted", predicted, AMBER))
    for name, place, colour in drawn:
        markers.append(_line(name, 0, outline, place, colour))
        markers.append(_line(name, 1, heading, place, colour))
    markers.append(_line("goal", 2, _circle(scene.state.position_tolerance), goal, GREEN))
    markers.append(_line("goal", 3, _sector(reach, scene.state.angle_tolerance), goal, GREEN))
    way = [*scene.path, *([scene.pose] if scene.pose else [])]
    places = np.array([(place.x, place.y) for place in way])
    if scene.path:
        markers.append(_points("way", Marker.LINE_STRIP, places, LINE_WIDTH / 2, GREY))
        markers.append(_points("taps", Marker.POINTS, places, 3 * LINE_WIDTH, GREY))
    else:
        markers += [_deletion("way", 0), _deletion("taps", 0)]
    edges = region.reshape(-1, 2)
    markers.append(_points("tappable", Marker.LINE_LIST, edges, LINE_WIDTH / 2, GREY))
    markers.append(_strike_arrow(strike) if strike is not None else _deletion("strike", 0))
    header = to_ros(scene.state.header)
    for marker in markers:
        marker.header = header
    return MarkerArray(markers=markers)


def _tapper_markers(cell: Cell) -> list[Marker]:
    """Return the bodies of the fixed tappers and, thinner, the lines along which their tips travel.
    The id is the tapper's position in the cell file."""
    markers = []
    for number, tapper in enumerate(cell.mounted_tappers()):
        body = np.array([(-tapper.body_start - tapper.body_length, 0.0), (-tapper.body_start, 0.0)])
        line = np.array([(0.0, 0.0), (tapper.stroke, 0.0)])
        drawn = _line("tapper", number, body, tapper.mount, WHITE)
        drawn.scale.x = 2.0 * tapper.body_radius
        way = _line("tapper_line", number, line, tapper.mount, GREY)
        way.scale.x = LINE_WIDTH / 4
        markers += [drawn, way]
    return markers


def _circle(radius: float) -> Points:
    angles = np.linspace(0, 2 * math.pi, 48, endpoint=False)
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def _sector(radius: float, half_angle: float) -> Points:
    """Return the corners of a sector that shows the accepted final headings of the object."""
    ends = radius * np.stack([np.cos([half_angle] * 2), np.sin([-half_angle, half_angle])], axis=-1)
    return np.array([ends[0], (0.0, 0.0), ends[1]])


def _points(name: str, kind: int, points: Points, size: float, colour: ColorRGBA) -> Marker:
    """Return a marker of type ``kind`` that consists of points (n, 2) in ``table``."""
    marker = Marker(ns=name, type=kind, action=Marker.ADD, color=colour)
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = size
    marker.points = list(_message_points(np.asarray(points, dtype=float).tobytes()))
    return marker


@lru_cache(maxsize=256)
def _message_points(numbers: bytes) -> tuple[Point, ...]:
    """Convert points (n, 2) to messages; ``numbers`` are the bytes of the points' array. Results
    are cached, because most points of a scene were already in the previous scene."""
    return tuple(Point(x=x, y=y) for x, y in np.frombuffer(numbers).reshape(-1, 2).tolist())


def _line(name: str, number: int, points: Points, pose: Pose | None, colour: ColorRGBA) -> Marker:
    """Return a marker with a line through points (n, 2) in the frame at ``pose``. The line is
    closed if n is above 2. If ``pose`` is None, return a marker that deletes the line."""
    if pose is None:
        return _deletion(name, number)
    marker = Marker(ns=name, id=number, type=Marker.LINE_STRIP, action=Marker.ADD, color=colour)
    marker.pose = to_message(pose)
    marker.scale.x = LINE_WIDTH
    marker.points = list(_message_points(np.asarray(points, dtype=float).tobytes()))
    if len(points) > 2:
        marker.points.append(marker.points[0])
    return marker


def _strike_arrow(strike: Strike) -> Marker:
    rest, contact = strike.plan.strike_pose, strike.plan.contact_pose
    marker = Marker(ns="strike", id=0, type=Marker.ARROW, action=Marker.ADD, color=RED)
    marker.pose.orientation.w = 1.0
    back = 0.04
    tail = Point(
        x=rest.x - back * math.cos(rest.theta), y=rest.y - back * math.sin(rest.theta), z=0.01
    )
    marker.points = [tail, Point(x=contact.x, y=contact.y, z=0.01)]
    marker.scale.x, marker.scale.y, marker.scale.z = 0.004, 0.010, 0.012
    return marker


def _deletion(name: str, number: int) -> Marker:
    return Marker(ns=name, id=number, action=Marker.DELETE)
