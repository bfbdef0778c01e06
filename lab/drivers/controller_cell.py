"""An emulated arm controller, its arm and the arm driver in virtual time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmSettings, HomingStrategy
from tapping_cell.hardware.grbl_dialect import GrblDialect, GrblSettings
from tapping_cell.hardware.marlin_dialect import MarlinDialect
from tapping_cell.hardware.scara import Joints, ScaraGeometry
from tapping_cell.simulation.fault_layer import FaultLayer
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.grbl_machine import GrblMachine
from tapping_cell.simulation.grbl_variants import VARIANTS
from tapping_cell.simulation.marlin_emulator import MarlinEmulator, MarlinMachine
from tapping_cell.simulation.virtual_line import VirtualClock, VirtualTransport

HOME = (0.0, math.pi / 2, 0.0, 0.0)
START = (0.3, 1.2, -0.030, 0.0)
GRBL_NAMES = tuple(VARIANTS)
NAMES = (*GRBL_NAMES, "marlin")
"""Controllers with at least four axes, by name."""
WITHOUT_SWITCH = {"grbl-mega-5x": (3,)}
"""Indices of the axes that a controller does not home with its default settings: grbl-Mega-5X homes
X, Y and Z only."""
CALL_LIMIT = 1e4
"""Time after which a call of the driver that has not returned counts as hanging, s."""


class ControllerCell:
    """One emulated controller with its arm, and the driver.

    ``settings`` are controller settings that differ from those of the simulated arm. ``change``
    returns a modified copy of the emulated machine; it is used only for controllers of the Grbl
    family.
    """

    def __init__(
        self,
        name: str,
        settings: Mapping[int, float] | None = None,
        change: Callable[[GrblMachine], GrblMachine] = lambda machine: machine,
        arm: ArmSettings | None = None,
        seed: int = 0,
    ) -> None:
        self.clock = VirtualClock()
        self.clock.limit = CALL_LIMIT
        self.emulator: GrblEmulator | MarlinEmulator
        if name == "marlin":
            machine = MarlinMachine(start_joints=START, home_joints=HOME)
            self.emulator = MarlinEmulator(machine, seed)
        else:
            grbl = GrblMachine(
                start_joints=START,
                home_joints=HOME,
                settings=dict(settings or {}),
                variant=VARIANTS[name],
            )
            self.emulator = GrblEmulator(change(grbl), seed)
        self.line = FaultLayer(self.emulator)
        transport = VirtualTransport(self.line, self.clock, "port")
        self.transport = transport
        self.without_switch = WITHOUT_SWITCH.get(name, ())
        self.dialect: GrblDialect | MarlinDialect = (
            MarlinDialect(transport, draw_number=lambda below: below // 2)
            if name == "marlin"
            else GrblDialect(
                transport, GrblSettings(without_switch=self.without_switch, needs_homing=True)
            )
        )
        self.driver = ArmDriver(
            transport, self.dialect, ScaraGeometry(), arm or ArmSettings(home_joints=HOME)
        )

    def ready(self) -> ArmDriver:
        """Connect and home; return the driver."""
        self.driver.connect()
        if self.driver.read().alarm:
            self.driver.clear_fault()
        self.driver.home(HomingStrategy.FIRMWARE)
        return self.driver

    def home_again(self) -> None:
        """Clear the fault, move the axes without a switch to their marks as an operator would, and
        home."""
        self.driver.clear_fault()
        if self.without_switch and isinstance(self.emulator, GrblEmulator):
            at_mark = list(self.truth())
            for axis in self.without_switch:
                at_mark[axis] = HOME[axis]
            self.emulator.push(Joints(*at_mark), self.clock.now)
        self.driver.home(HomingStrategy.FIRMWARE)

    def truth(self) -> Joints:
        """Return the true joints of the emulated arm."""
        return Joints(*self.emulator.joints(self.clock.now))

    def wait(self, duration: float) -> None:
        """Let ``duration`` s pass."""
        self.transport.sleep(duration)

    def unplug(self, duration: float) -> None:
        """Unplug the cable for ``duration`` s."""
        self.line.hang_up(self.clock.now, duration)

    def during_the_next_move(self, after: float, act: Callable[[], object]) -> None:
        """Call ``act`` once as soon as ``after`` s have passed from now."""
        at = self.clock.now + after
        step = self.clock.step

        def stepped(until: float, reading: FaultLayer | None = None) -> None:
            step(min(until, max(at, self.clock.now)), reading)
            if self.clock.now >= at:
                self.clock.step = step  # type: ignore[method-assign]
                act()

        self.clock.step = stepped  # type: ignore[method-assign]
