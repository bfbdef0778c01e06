"""The arm's driver in Marlin's dialect, on the emulator and on OctoPrint's virtual printer."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmSettings, HomingStrategy
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.marlin_dialect import MarlinDialect, MarlinSettings
from tapping_cell.hardware.scara import Joints, ScaraGeometry
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.simulation.marlin_emulator import MarlinEmulator, MarlinMachine
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal

HOME = (0.0, math.pi / 2, 0.0, 0.0)
Plug = Callable[..., PseudoTerminal]


class Cell:
    """One emulated arm and its driver."""

    def __init__(self, plug: Plug, parser: bool = True, **options: bool) -> None:
        machine = MarlinMachine(
            start_joints=(0.05, 1.5, -0.005, 0.1), home_joints=HOME, emergency_parser=parser
        )
        self.emulator = MarlinEmulator(machine, seed=1, now=time.monotonic())
        self.port = plug(self.emulator, **options)
        self.transport = SerialTransport(str(self.port.path))
        self.dialect = MarlinDialect(self.transport)
        self.driver = ArmDriver(
            self.transport, self.dialect, ScaraGeometry(), ArmSettings(home_joints=HOME)
        )

    def ready(self) -> ArmDriver:
        self.driver.connect()
        self.driver.home(HomingStrategy.FIRMWARE)
        return self.driver

    def truth(self) -> Joints:
        with self.port.lock:
            return Joints(*self.emulator.joints(time.monotonic()))


def test_home_move_read_back(plug: Plug) -> None:
    cell = Cell(plug)
    driver = cell.ready()
    assert driver.firmware is not None and driver.firmware.version.startswith("2.1.2")
    goal = Joints(0.3, 1.2, -0.02, -0.5)
    reading = driver.move_to(goal, speed=0.8)
    # Step counts, not the commanded values that M114 begins with.
    assert reading.measured and not reading.moving
    assert np.allclose(reading.joints, goal, atol=1e-3)
    assert np.allclose(cell.truth(), goal, atol=1e-3)


def test_homing_survives_a_pulled_cable_but_not_a_reset(plug: Plug) -> None:
    cell = Cell(plug)
    driver = cell.ready()
    for reset in (False, True):
        cell.port.hang_up()
        if reset:
            with cell.port.lock:
                cell.emulator.power_cycle(time.monotonic())
        with pytest.raises(HardwareFault) as caught:
            driver.move_to((0.2, 1.2, -0.02, 0.1))
        assert caught.value.reason is FaultReason.DISCONNECTED
        cell.port.plug_in()
        before = time.monotonic()
        assert driver.connect().continued is not reset
        assert time.monotonic() - before < 2.0
        assert driver.homed is not reset


@pytest.mark.parametrize("parser", [True, False])
def test_stop_is_unnumbered_and_acts_at_once(plug: Plug, parser: bool) -> None:
    cell = Cell(plug, parser, reset_on_open=True)
    driver = cell.ready()
    assert cell.dialect.stop_bytes == (b"\nM410\n" if parser else b"\nM112\n")
    caught: list[HardwareFault] = []

    def move() -> None:
        try:
            driver.move_to((1.5, 0.5, -0.1, 1.0), speed=0.2)
        except HardwareFault as fault:
            caught.append(fault)

    worker = threading.Thread(target=move)
    worker.start()
    time.sleep(0.5)
    assert driver.stop()
    worker.join(2)
    assert [fault.reason for fault in caught] == [FaultReason.STOPPED]
    time.sleep(0.1)
    here = cell.truth()
    time.sleep(0.2)
    assert cell.truth() == here
    # Without the emergency parser the firmware is dead until its board is reset: the port's DTR.
    driver.clear_fault()
    assert not driver.homed
    driver.home(HomingStrategy.FIRMWARE)
    driver.move_to((0.1, 1.4, 0.0, 0.0))


def test_a_halted_board_that_no_dtr_resets_needs_a_person(plug: Plug) -> None:
    cell = Cell(plug, parser=False)
    driver = cell.ready()
    driver.stop()
    with pytest.raises(HardwareFault, match="press the reset button") as caught:
        driver.clear_fault(timeout=2.0)
    assert caught.value.reason is FaultReason.NEEDS_PERSON
    with cell.port.lock:
        cell.emulator.power_cycle(time.monotonic())
    driver.clear_fault()
    driver.home(HomingStrategy.FIRMWARE)


def test_a_restart_during_a_move_is_noticed(plug: Plug) -> None:
    cell = Cell(plug)
    driver = cell.ready()

    def restart() -> None:
        with cell.port.lock:
            cell.emulator.power_cycle(time.monotonic())

    timer = threading.Timer(0.3, restart)
    timer.start()
    with pytest.raises(HardwareFault) as caught:
        driver.move_to((1.5, 0.5, -0.1, 1.0), speed=0.2)
    assert caught.value.reason is FaultReason.BOARD_RESET
    assert not driver.homed


class OctoPrintPort:
    """OctoPrint's virtual printer as a device on our pseudo-terminal.

    It is a peer written by others, not a real board: it answers a repeated line number with
    ``Resend`` and ``ok`` where real Marlin stays silent, it has an axis E instead of a fourth arm
    axis, its step counts are not steps, and the ``ok`` of ``M114`` stands on the position's line.
    """

    def __init__(self, printer: object) -> None:
        self._printer = printer
        self._input = b""

    def receive(self, data: bytes, now: float) -> None:
        self._input += data
        while b"\n" in self._input:
            line, self._input = self._input.split(b"\n", 1)
            if line:
                self._printer.write(line + b"\n")  # type: ignore[attr-defined]

    def advance(self, now: float) -> None: ...

    def take_output(self, now: float) -> bytes:
        out = b""
        while not self._printer.outgoing.empty():  # type: ignore[attr-defined]
            line: bytes = self._printer.readline()  # type: ignore[attr-defined]
            out += line.rstrip(b"\n") + b"\n"
        return out

    def next_event(self) -> float | None:
        return time.monotonic() + 0.005

    def power_cycle(self, now: float) -> None: ...


def test_the_dialect_against_octoprints_virtual_printer(plug: Plug, tmp_path: Path) -> None:
    pytest.importorskip("octoprint", reason="OctoPrint is not installed here")
    from octoprint.plugin import PluginSettings, plugin_manager
    from octoprint.plugins.virtual_printer import VirtualPrinterPlugin
    from octoprint.plugins.virtual_printer.virtual import VirtualPrinter
    from octoprint.printer.profile import PrinterProfileManager
    from octoprint.settings import settings

    plugin_manager(init=True, plugin_folders=[], plugin_bases=[], plugin_entry_points=[])
    defaults = VirtualPrinterPlugin().get_settings_defaults()
    own = PluginSettings(
        settings(init=True, basedir=str(tmp_path)),
        "virtual_printer",
        defaults=defaults,
    )
    own.set(["firmwareName"], "Marlin 2.1.2 (peer)")
    printer = VirtualPrinter(
        own, PrinterProfileManager(), str(tmp_path), read_timeout=0.01, write_timeout=1.0
    )
    port = plug(OctoPrintPort(printer))
    transport = SerialTransport(str(port.path))
    dialect = MarlinDialect(transport, MarlinSettings(letters="XYZE"))
    driver = ArmDriver(
        transport, dialect, ScaraGeometry(), ArmSettings(home_joints=(0.0, 0.0, 0.0, 0.0))
    )
    try:
        firmware = driver.connect(timeout=20)
        assert firmware.name == "Marlin" and "2.1.2 (peer)" in firmware.version
        driver.home(HomingStrategy.MANUAL_POSE)
        for goal in ((0.3, 0.5, -0.02, 0.4), (0.1, 0.2, -0.01, 0.1)):
            reading = driver.move_to(goal)
            assert np.allclose(reading.joints, goal, atol=1e-3)
            assert not reading.measured
    finally:
        driver.close()
        printer.close()
