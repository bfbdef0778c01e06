"""The last read-back of the arm's position, and the messages that are made from it."""

from __future__ import annotations

import math

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.scara import Joints, ScaraGeometry
from tapping_cell.logic.arm_jobs import Reading
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.poses import to_message
from tapping_cell.messages import JointState, Pose, Time
from tapping_cell.se2 import Pose as PlanarPose


class ArmReadings:
    """See the module's docstring."""

    _cell: Cell
    _geometry: ScaraGeometry

    def __init__(self) -> None:
        self.last: Reading | None = None
        """None while the position is not known."""
        self.stamp = Time()
        """Stamp of the last reading of a homed arm, ROS time."""
        self._published = Time()
        self._tip: tuple[Reading | None, Pose] = (None, Pose())

    def configure(self, cell: Cell) -> None:
        """Use the geometry of this cell."""
        self._cell, self._geometry = cell, cell.arm.geometry()

    def take_in(self, reading: Reading, now: Now) -> None:
        """Store a reading."""
        self.last = reading
        if reading.homed:
            age = max(now.steady - reading.stamp, 0.0)
            self.stamp = to_stamp(now.ros - round(1e9 * age))

    @property
    def of_homed_arm(self) -> Reading | None:
        """The last reading; None if the arm is not homed."""
        return self.last if self.last is not None and self.last.homed else None

    def age(self, now: Now) -> float:
        """Return the age of the last reading, s; infinite without a reading."""
        return math.inf if self.last is None else now.steady - self.last.stamp

    def new_joints(self) -> JointState | None:
        """Return the joint states of a new reading, once; None if the arm's own ROS driver
        publishes joint states."""
        reading = self.of_homed_arm
        if reading is None or self.stamp == self._published:
            return None
        if self._cell.arm.ros2_control is not None:
            return None
        self._published = self.stamp
        joints = JointState(name=list(Joints._fields), position=list(reading.joints))
        joints.header.stamp = self.stamp
        return joints

    def tip_pose(self, reading: Reading) -> Pose:
        """Return the tip's pose in ``table`` from a reading; computed once per reading."""
        measured, pose = self._tip
        if measured is not reading:
            tip = self._geometry.forward(reading.joints)
            planar = self._cell.arm_base @ PlanarPose(tip.x, tip.y, tip.yaw)
            pose = to_message(planar, tip.z)
            self._tip = reading, pose
        return pose
