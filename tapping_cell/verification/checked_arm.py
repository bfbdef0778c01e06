"""The arm's driver, with a check after each move that the driver reports as completed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmReading
from tapping_cell.hardware.scara import Joints


class CheckedArm:
    """Arm driver that passes the target of each completed move to ``check``."""

    def __init__(self, driver: ArmDriver, check: Callable[[Joints], None]) -> None:
        self._driver = driver
        self._check = check

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def move_to(self, joints: Joints, speed: float, **via: Any) -> ArmReading:
        """Move as :meth:`ArmDriver.move_to` does, then check the move."""
        reading = self._driver.move_to(joints, speed, **via)
        self._check(joints)
        return reading
