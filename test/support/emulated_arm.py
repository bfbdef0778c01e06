"""An emulated arm on a pseudo-terminal, and the driver under test."""

from __future__ import annotations

import math
import time

from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmSettings, HomingStrategy
from tapping_cell.hardware.grbl_dialect import GrblDialect
from tapping_cell.hardware.marlin_dialect import MarlinDialect
from tapping_cell.hardware.scara import Joints, ScaraGeometry
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.marlin_emulator import MarlinEmulator
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal

HOME = (0.0, math.pi / 2, 0.0, 0.0)
NEAR_HOME = (0.05, 1.5, -0.005, 0.1)
_TIMEOUT_S = 60.0


class EmulatedArm:
    """An emulated arm and its driver, with a given dialect."""

    def __init__(
        self,
        emulator: GrblEmulator | MarlinEmulator,
        port: PseudoTerminal,
        transport: SerialTransport,
        dialect: GrblDialect | MarlinDialect,
    ) -> None:
        self.emulator, self.port = emulator, port
        self.transport, self.dialect = transport, dialect
        settings = ArmSettings(home_joints=HOME)
        self.driver = ArmDriver(transport, dialect, ScaraGeometry(), settings)

    def ready(self) -> ArmDriver:
        """Return the driver, connected and homed."""
        self.driver.connect()
        self.driver.home(HomingStrategy.FIRMWARE)
        return self.driver

    def wait_moving(self, moving: bool) -> None:
        """Wait until the emulated arm moves, or until it has stopped."""
        deadline = time.monotonic() + _TIMEOUT_S
        while True:
            with self.port.lock:
                if self.emulator.moving(time.monotonic()) is moving:
                    return
            assert time.monotonic() < deadline, f"moving={moving} never came"
            time.sleep(0.005)

    def truth(self) -> Joints:
        """Return the true joints of the emulated arm."""
        with self.port.lock:
            return Joints(*self.emulator.joints(time.monotonic()))
