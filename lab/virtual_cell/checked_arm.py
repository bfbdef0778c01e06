"""The arm's driver, with a check of each move before it begins, and after it was completed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmReading
from tapping_cell.hardware.scara import Joints


class CheckedArm:
    """Arm driver that passes the target and the speed of each move to ``check_start``, the speed as
    a fraction of the maximum joint speeds, and the target of each completed move to ``check``."""

    def __init__(
        self,
        driver: ArmDriver,
        check: Callable[[Joints], None],
        check_start: Callable[[Joints, float], None],
    ) -> None:
        self._driver = driver
        self._check = check
        self._check_start = check_start

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def move_to(self, joints: Joints, speed: float, **via: Any) -> ArmReading:
        """Move as :meth:`ArmDriver.move_to` does, and check the move."""
        self._check_start(joints, max(speed, via.get("via_speed") or 0.0))
        reading = self._driver.move_to(joints, speed, **via)
        self._check(joints)
        return reading
