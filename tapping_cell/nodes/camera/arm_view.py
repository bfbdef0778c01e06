"""Where the arm is in the camera's view, from its joint positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from tapping_cell.configuration.cell import Cell
from tapping_cell.logic.arm_in_view import VIEW_MARGIN_M, bars_in_table
from tapping_cell.nodes.own_joints import OwnJoints
from tapping_cell.nodes.polled_topics import PolledTopics
from tapping_cell.vision import ArmBars, View
from tapping_cell.vision.free_view import view_clearance

LAG_M = 0.05
"""Maximum distance that the arm moves between an image and the last joint positions."""


_NEWEST = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
"""The joint states wait until an image needs them. The arm's newest must be among them, also if
other robots publish many times as often. Best effort also matches reliable publishers."""


class ArmView:
    """Subscribes to the arm's joints. The shape of an arm that is not a SCARA is not known, so such
    an arm never explains why something is hidden."""

    def __init__(self, node: Node, cell: Cell) -> None:
        self._cell = cell
        self.is_scara = cell.arm.chain() is None
        self._own = OwnJoints(cell.arm.joint_names)
        self._positions: tuple[float, ...] | None = None
        self._topic = cell.arm.joint_states_topic
        self._polled = PolledTopics(node)
        self._polled.add(JointState, self._topic, _NEWEST)

    def close(self) -> None:
        """End the subscription."""
        self._polled.close()

    @property
    def is_known(self) -> bool:
        """Whether the arm's position is known, if its shape is known."""
        return not self.is_scara or self._joints() is not None

    def bars(self) -> ArmBars | None:
        """Return the bars that model the arm, in ``table``, or None if its joint positions or its
        shape are not known."""
        joints = self._joints() if self.is_scara else None
        if joints is None:
            return None
        bars = bars_in_table(self._cell, self._cell.arm.geometry(), [joints])
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

    def _joints(self) -> tuple[float, ...] | None:
        """Return the newest positions of the arm's joints, from the base on."""
        waiting = [data for _, data, _ in self._polled.take((self._topic,))]
        for data in reversed(waiting):
            if (found := self._own.positions(data)) is not None:
                self._positions = found
                break
        return self._positions
