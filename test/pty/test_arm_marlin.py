"""The arm's driver with Marlin, tested with the emulator and with OctoPrint's virtual printer."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from emulated_arm import HOME, NEAR_HOME, EmulatedArm

from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmSettings, HomingStrategy
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.marlin_dialect import MarlinDialect, MarlinSettings
from tapping_cell.hardware.scara import Joints, ScaraGeometry
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.simulation.marlin_emulator import MarlinEmulator, MarlinMachine
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal

Plug = Callable[..., PseudoTerminal]


def emulated(
    plug: Plug, parser: bool = True, workspace_offsets: bool = True, **options: bool
) -> EmulatedArm:
    """Return an emulated Marlin arm and its driver."""
    machine = MarlinMachine(
        start_joints=NEAR_HOME,
        home_joints=HOME,
        emergency_parser=parser,
        workspace_offsets=workspace_offsets,
    )
    emulator = MarlinEmulator(machine, seed=1, now=time.monotonic())
    port = plug(emulator, **options)
    transport = SerialTransport(str(port.path))
    return EmulatedArm(emulator, port, transport, MarlinDialect(transport))


@pytest.mark.parametrize("workspace_offsets", [True, False])
def test_home_move_read_back(plug: Plug, workspace_offsets: bool) -> None:
    cell = emulated(plug, workspace_offsets=workspace_offsets)
    driver = cell.ready()
    assert driver.firmware is not None and driver.firmware.version.startswith("2.1.2")
    goal = Joints(0.3, 1.2, -0.02, -0.5)
    reading = driver.move_to(goal, speed=0.8)
    # The position comes from the step counts, not from the commanded values at the start of the
    # M114 report.
    assert reading.measured and not reading.moving
    assert np.allclose(reading.joints, goal, atol=1e-3)
    assert np.allclose(cell.truth(), goal, atol=1e-3)


def test_homing_survives_a_disconnected_cable_but_not_a_reset(plug: Plug) -> None:
    cell = emulated(plug)
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
        assert driver.connect().continued is not reset
        assert driver.homed is not reset


@pytest.mark.parametrize("workspace_offsets", [True, False])
def test_a_new_driver_can_declare_the_position_on_a_board_that_was_not_reset(
    plug: Plug, workspace_offsets: bool
) -> None:
    cell = emulated(plug, workspace_offsets=workspace_offsets)
    cell.ready().move_to((0.2, 1.2, -0.02, 0.1))
    cell.driver.close()
    here = (0.5, 1.1, -0.01, 0.3)
    transport = SerialTransport(str(cell.port.path))
    driver = ArmDriver(
        transport, MarlinDialect(transport), ScaraGeometry(), ArmSettings(home_joints=here)
    )
    driver.connect()
    assert not driver.homed and not driver.read().moving
    driver.home(HomingStrategy.MANUAL_POSE)
    assert np.allclose(driver.read_joints(), here, atol=1e-3)
    before = np.array(cell.truth())
    reading = driver.move_to(np.add(here, (0.1, -0.2, -0.01, 0.2)))
    assert reading.measured and not reading.moving
    assert np.allclose(np.array(cell.truth()) - before, (0.1, -0.2, -0.01, 0.2), atol=1e-3)
    driver.close()


@pytest.mark.parametrize("parser", [True, False])
def test_stop_is_unnumbered_and_acts_at_once(plug: Plug, parser: bool) -> None:
    cell = emulated(plug, parser, reset_on_open=True)
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
    cell.wait_moving(True)
    assert driver.stop()
    worker.join(60)
    assert [fault.reason for fault in caught] == [FaultReason.STOPPED]
    cell.wait_moving(False)
    here = cell.truth()
    assert here.shoulder < 1.4
    time.sleep(0.2)
    # Without the emergency parser, the stop is M112, which switches the motors off, so that the
    # quill sinks. M410 keeps them on.
    assert cell.truth()[:2] == here[:2] and (cell.truth() == here) is parser
    # Without the emergency parser the firmware stays halted until the port's DTR signal resets the
    # board.
    driver.clear_fault()
    assert not driver.homed
    driver.home(HomingStrategy.FIRMWARE)
    driver.move_to((0.1, 1.4, 0.0, 0.0))


def test_a_halted_board_without_dtr_reset_needs_an_operator(plug: Plug) -> None:
    cell = emulated(plug, parser=False)
    driver = cell.ready()
    driver.stop()
    with pytest.raises(HardwareFault, match="press the reset button") as caught:
        driver.clear_fault(timeout=2.0)
    assert caught.value.reason is FaultReason.NEEDS_PERSON
    with cell.port.lock:
        cell.emulator.power_cycle(time.monotonic())
    driver.clear_fault()
    driver.home(HomingStrategy.FIRMWARE)


def test_a_restart_during_a_move_is_detected(plug: Plug) -> None:
    cell = emulated(plug)
    driver = cell.ready()

    def restart() -> None:
        cell.wait_moving(True)
        with cell.port.lock:
            cell.emulator.power_cycle(time.monotonic())

    threading.Thread(target=restart).start()
    with pytest.raises(HardwareFault) as caught:
        driver.move_to((1.5, 0.5, -0.1, 1.0), speed=0.2)
    assert caught.value.reason is FaultReason.BOARD_RESET
    assert not driver.homed


class OctoPrintPort:
    """OctoPrint's virtual printer, connected to a pseudo-terminal.

    It is an independent implementation, but not a real board. The virtual printer answers a
    repeated line number with ``Resend`` and ``ok``, whereas real Marlin does not answer. The
    virtual printer has an axis E instead of a fourth arm axis, its reported step counts are not
    those of motors, and the ``ok`` of ``M114`` is on the same line as the position.
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


class Peer:
    """OctoPrint's virtual printer and the arm's driver connected to it."""

    def __init__(self, printer: Any, driver: ArmDriver) -> None:
        self.printer = printer
        self.driver = driver

    def ready(self) -> ArmDriver:
        self.driver.connect(timeout=20)
        self.driver.home(HomingStrategy.MANUAL_POSE)
        return self.driver

    def inject(self, name: str) -> None:
        """Switch on one of the virtual printer's own faults."""
        self.printer.write(f"!!DEBUG:{name}\n".encode())


@pytest.fixture(scope="module")
def octoprint(tmp_path_factory: pytest.TempPathFactory) -> Callable[[], Any]:
    """Return a function that makes virtual printers. OctoPrint's settings can be created only once
    per process."""
    pytest.importorskip("octoprint", reason="OctoPrint is not installed here")
    from octoprint.plugin import PluginSettings, plugin_manager
    from octoprint.plugins.virtual_printer import VirtualPrinterPlugin
    from octoprint.plugins.virtual_printer.virtual import VirtualPrinter
    from octoprint.printer.profile import PrinterProfileManager
    from octoprint.settings import settings

    folder = str(tmp_path_factory.mktemp("octoprint"))
    plugin_manager(init=True, plugin_folders=[], plugin_bases=[], plugin_entry_points=[])
    defaults = VirtualPrinterPlugin().get_settings_defaults()
    own = PluginSettings(settings(init=True, basedir=folder), "virtual_printer", defaults=defaults)
    own.set(["firmwareName"], "Marlin 2.1.2 (peer)")
    return lambda: VirtualPrinter(
        own, PrinterProfileManager(), folder, read_timeout=0.01, write_timeout=1.0
    )


@pytest.fixture
def peer(plug: Plug, octoprint: Callable[[], Any]) -> Iterator[Peer]:
    printer = octoprint()
    port = plug(OctoPrintPort(printer))
    transport = SerialTransport(str(port.path))
    dialect = MarlinDialect(transport, MarlinSettings(letters="XYZE"))
    driver = ArmDriver(
        transport, dialect, ScaraGeometry(), ArmSettings(home_joints=(0.0, 0.0, 0.0, 0.0))
    )
    yield Peer(printer, driver)
    driver.close()
    printer.close()


def test_octoprints_printer_is_understood_and_moved(peer: Peer) -> None:
    firmware = peer.driver.connect(timeout=20)
    assert firmware.name == "Marlin" and "2.1.2 (peer)" in firmware.version
    peer.driver.home(HomingStrategy.MANUAL_POSE)
    for goal in ((0.3, 0.5, -0.02, 0.4), (0.1, 0.2, -0.01, 0.1)):
        reading = peer.driver.move_to(goal)
        assert np.allclose(reading.joints, goal, atol=1e-3)
        assert not reading.measured


@pytest.mark.parametrize(
    "name",
    [
        "trigger_resend_checksum",
        "trigger_resend_lineno",
        "trigger_missing_checksum",
        "dont_answer",
        "sleep_after_next G1 1",
        "resend_ratio 20",
    ],
)
def test_moves_complete_although_octoprints_printer_misbehaves(peer: Peer, name: str) -> None:
    driver = peer.ready()
    peer.inject(name)
    for goal in ((0.3, 0.5, -0.02, 0.4), (0.1, 0.2, -0.01, 0.1), (0.2, 0.3, -0.02, 0.0)):
        assert np.allclose(driver.move_to(goal).joints, goal, atol=1e-3)
    counters = driver.line_counters
    assert counters.resends + counters.timeouts + counters.retries > 0 or "sleep" in name


def test_a_fatal_error_of_octoprints_printer_is_an_alarm(peer: Peer) -> None:
    driver = peer.ready()
    peer.inject("trigger_fatal_error_marlin")
    with pytest.raises(HardwareFault) as caught:
        driver.move_to((0.3, 0.5, -0.02, 0.4))
    assert caught.value.reason is FaultReason.ALARM and not driver.homed
    driver.clear_fault()
    driver.home(HomingStrategy.MANUAL_POSE)


def test_octoprints_printer_that_restarts_must_be_homed_again(peer: Peer) -> None:
    driver = peer.ready()
    peer.inject("reset")
    with pytest.raises(HardwareFault):
        for _ in range(3):
            driver.move_to((0.3, 0.5, -0.02, 0.4))
            driver.move_to((0.1, 0.2, -0.01, 0.1))
    driver.clear_fault()
    assert not driver.homed
