"""Search for objects without an object file, in images in which nothing moves and the arm has
withdrawn."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point32, Polygon
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.time import Time
from tapping_cell_msgs.msg import ArmState, ObjectState
from tapping_cell_msgs.msg import UnknownObjects as Outlines

from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.logic.frames import TABLE
from tapping_cell.nodes.camera.arm_view import ArmView
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.conversions import from_message
from tapping_cell.se2 import transform_points
from tapping_cell.vision import Standing, UnknownObjects, View

PERIOD_S = 0.5
"""Time between two searches."""
AWAITED_PERIOD_S = 0.15
"""Time between two searches while the planner waits for an observation."""
MEMORY_S = 2.0
"""Time for which an object that is no longer measured is still expected at its last pose."""


class UnknownSearch:
    """Searches the images of a cell with an arm, and publishes the outlines found.

    A cell without an arm is never searched, because the strikers of its fixed tappers are always in
    the image and would be taken for objects.
    """

    def __init__(
        self,
        node: Node,
        cell: Cell,
        others: Sequence[ObjectFile],
        arm: ArmView,
        publisher: Publisher,
    ) -> None:
        """Subscribe to the arm's state. ``publisher``: of ``unknown_objects``."""
        self._node = node
        self._publisher = publisher
        self._arm = arm
        self._shapes: dict[str, tuple[NDArray[np.float64], float]] = {
            file.name: (np.array(file.shape.outline()), file.height)
            for file in (cell.object, *others)
        }
        table = cell.file.table
        self._found = UnknownObjects(table.length, table.width, cell.references)
        self._seen: dict[str, tuple[float, ObjectState]] = {}
        self._searched_at = -math.inf
        self._clear = False
        self._subscription = node.create_subscription(ArmState, "arm_state", self._on_arm, LATCHED)

    def close(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    @property
    def outlines(self) -> list[NDArray[np.float64]]:
        """Outlines of the unknown objects, points (N, 2) in m in ``table``."""
        return self._found.outlines

    def search(
        self,
        image: NDArray[np.uint8],
        stamp: float,
        view: View | None,
        states: Sequence[ObjectState],
        awaited: bool,
    ) -> None:
        """Search an image and publish what was found, unless something moves in it or the last
        search was recent.

        ``states``: current states of the cell's objects; ``awaited``: the planner waits for an
        observation.
        """
        period = AWAITED_PERIOD_S if awaited else PERIOD_S
        for state in states:
            if state.visible:
                self._seen[state.object_id] = stamp, state
        still = all(state.at_rest or not state.visible for state in states)
        # Before its first measurement, an object of the cell would be taken for an unknown object.
        measured = all(state.header.stamp.sec for state in states)
        # Search also if the camera's clock was set back.
        due = not 0.0 <= stamp - self._searched_at < period
        # An arm whose position is not known would be taken for an unknown object.
        possible = self._clear and still and measured and due and self._arm.is_known
        if view is None or not possible:
            return
        recent = [state for seen_at, state in self._seen.values() if stamp - seen_at <= MEMORY_S]
        standing = [self._standing(state) for state in recent]
        self._found.search(image, view, standing, self._arm.bars())
        self._searched_at = stamp
        message = Outlines(
            outlines=[
                Polygon(points=[Point32(x=float(x), y=float(y)) for x, y in outline])
                for outline in self.outlines
            ]
        )
        message.header.frame_id = TABLE
        message.header.stamp = Time(nanoseconds=round(1e9 * stamp)).to_msg()
        self._publisher.publish(message)

    @property
    def searches(self) -> bool:
        """Whether the search has begun, or begins once nothing moves."""
        return self._searched_at > -math.inf or self._arm.is_known

    def _on_arm(self, message: ArmState) -> None:
        self._clear = message.clear_of_camera and message.state == ArmState.IDLE

    def _standing(self, state: ObjectState) -> Standing:
        outline, height = self._shapes[state.object_id]
        return Standing(transform_points(from_message(state.pose.pose), outline), height)
