"""Where the arm is in the camera's view, from its joint positions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rclpy.node import Node
from sensor_msgs.msg import JointState

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic.arm_in_view import VIEW_MARGIN_M, bars_in_table
from tapping_cell.vision import ArmBars, View
from tapping_cell.vision.free_view import view_clearance

LAG_M = 0.05
"""Maximum distance that the arm moves between an image and the last joint positions."""


class ArmView:
    """Subscribes to the arm's joints. The shape of an arm that is not a SCARA is not known, so such
    an arm never explains why something is hidden."""

    def __init__(self, node: Node, cell: Cell) -> None:
        self._node = node
        self._cell = cell
        self._positions: Mapping[str, float] = {}
        self.is_scara = cell.arm.chain() is None
        driver = cell.arm.ros2_control
        self._names = tuple(driver.joints) if driver else Joints._fields
        topic = driver.joint_states if driver else "joint_states"
        self._subscription = node.create_subscription(JointState, topic, self._on_joints, 10)

    def close(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    @property
    def is_known(self) -> bool:
        """Whether the arm's position is known, if its shape is known."""
        return not self.is_scara or bool(self._positions)

    def bars(self) -> ArmBars | None:
        """Return the bars that model the arm, in ``table``, or None if its joint positions or its
        shape are not known."""
        if not self.is_scara or not self._positions:
            return None
        joints = [[self._positions[name] for name in self._names]]
        bars = bars_in_table(self._cell, self._cell.arm.geometry(), joints)
        return ArmBars(bars.start[0], bars.end[0], bars.radius)

    def hides(self, view: View | None, places: ArrayLike, radii: ArrayLike) -> NDArray[np.bool_]:
        """Return for each place (N, 3) in ``table`` whether the arm may hide a part of the disk
        around it that has its radius (N,)."""
        points, bars = np.asarray(places, dtype=float).reshape(-1, 3), self.bars()
        if view is None or bars is None:
            return np.zeros(len(points), dtype=bool)
        wide = bars.radius + VIEW_MARGIN_M + LAG_M
        lens = view.pose.position
        clearance = view_clearance(lens, bars.start[None], bars.end[None], wide, points)[0]
        return np.asarray(clearance <= np.asarray(radii, dtype=float))

    def _on_joints(self, message: JointState) -> None:
        positions = dict(zip(message.name, message.position, strict=False))
        # Another robot may publish its joints on the same topic.
        if all(name in positions for name in self._names):
            self._positions = positions
