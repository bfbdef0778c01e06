"""Drivers of arm and tapper: overhead per tap, time until the bytes of a stop are on the serial
line, and time to reconnect.

The overhead is measured in the emulated devices' own time, so that it does not depend on the load
of the computer. Replies take the time of a real line at 115200 baud, plus 2 ms for the adapter.
Commands arrive immediately, as over a native USB port. The bytes sent to the arm are counted,
because each byte would take additional time on a slower line. Stops and reconnections are measured
in real time over pseudo-terminals. For comparison, the times of a plain ``os.write`` through the
same terminal and of a plain opening of the port are measured.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import threading
import time
import tty
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lab.drivers.driver_trials import Dialect, TrialCell
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.hardware.grbl import STOP
from tapping_cell.hardware.grbl_dialect import GrblDialect
from tapping_cell.hardware.marlin_dialect import MarlinDialect
from tapping_cell.hardware.motion import path_duration, strike_path, withdraw_path
from tapping_cell.hardware.scara import ScaraGeometry
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.hardware.tapper import TapperDriver
from tapping_cell.hardware.transport import Transport
from tapping_cell.logic.tapper_jobs import WINDOW_S
from tapping_cell.simulation.device_emulator import DeviceEmulator
from tapping_cell.simulation.fault_layer import Direction
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.marlin_emulator import MarlinEmulator
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.spring_drive import SETTLE_TIME
from tapping_cell.simulation.tapper_emulator import TapperEmulator

LANGUAGES = (Dialect.GRBL, Dialect.MARLIN)
TAPS = 200
BYTE_S = 10 / 115200
STOPS = 500
RETURNS = 20


def measure() -> dict[str, Any]:
    """Return the times of a tap (``overhead``) for each dialect of the arm's controller, the
    latency of a stop, and the time to reconnect. Times are in s."""
    return {
        "overhead": {dialect.value: overhead(dialect, TAPS) for dialect in LANGUAGES},
        "stop": stop_to_wire(STOPS),
        "reconnect": reconnect(RETURNS),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    rows = [
        f"{dialect}: {figures['in_position']:.2f} s from command to in position and"
        f" {figures['withdrawn']:.2f} s back to the park pose;"
        f" overhead per tap beyond motion, settling and charging:"
        f" {1e3 * figures['to_release']:.1f} ms until the release,"
        f" {1e3 * figures['whole']:.1f} ms until parked again, and"
        f" {1e3 * figures['reading']:.1f} ms for reading the arm back before it withdraws, while"
        f" the node waits for the end of the release; {figures['sent']:.0f} bytes per tap to the"
        f" arm's board, which take {1e3 * BYTE_S * figures['sent']:.0f} ms more at 115200 baud"
        for dialect, figures in report["overhead"].items()
    ]
    stop, back = report["stop"], report["reconnect"]
    rows.append(
        f"stop to the wire: p99 {1e3 * stop['p99']:.2f} ms, worst {1e3 * stop['worst']:.2f} ms of"
        f" {stop['stops']} stops; p99 of a plain write {1e3 * stop['bare_p99']:.2f} ms"
    )
    medians = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in back["median"].items())
    rows.append(
        f"reconnection after the port is back: median {medians}; worst {back['worst']:.2f} s"
        f"; a plain opening {1e3 * back['bare']:.2f} ms"
    )
    return rows


def overhead(dialect: Dialect, taps: int) -> dict[str, float]:
    """Return mean values of a tap: times in s, and the number of bytes ``sent`` to the arm's board.

    ``in_position``: from the command until the arm is in position. ``withdrawn``: motion back to
    the park pose. ``to_release``: overhead from the command to the shot, without the planned
    motion, settling and charging. ``whole``: overhead of the complete tap, without the arm's status
    query during firing. ``reading``: duration of this query."""
    cell = TrialCell(dialect, 3)
    cell.recover()
    before = cell.arm_line.count(Direction.TO_DEVICE)
    times: dict[str, list[float]] = defaultdict(list)
    spring = cell.tapper_device.machine.spring
    for shot in range(1, taps + 1):
        began = cell.clock.now
        here = cell.arm.read_joints()
        path = strike_path(cell.geometry, here, cell.random_tip(), cell.motion)
        needed = path_duration(cell.geometry, here, path) + cell.arm.settings.settle_time
        cell.goal, cell.shot, cell.firing = path[-1].joints, shot, True
        cell.arm.follow(path)
        times["in_position"].append(cell.clock.now - began)
        energy = float(cell.rng.uniform(0.001, 0.2))
        needed += spring.steps_for(energy) / spring.step_rate + SETTLE_TIME
        cell.tapper.charge(shot, energy)
        cell.tapper.fire(shot, WINDOW_S, partial(_allow, cell))
        times["to_release"].append(cell.tapper_device.fires[-1][2] - began - needed)
        # The node reads the joints while it waits for the end of firing. Here they are read after
        # firing, so the duration of the reading is not counted as a delay.
        reading = cell.clock.now
        here = cell.arm.read_joints()
        times["reading"].append(cell.clock.now - reading)
        needed += times["reading"][-1]
        back = withdraw_path(cell.geometry, here, cell.motion)
        needed += path_duration(cell.geometry, here, back)
        leaving = cell.clock.now
        for waypoint in back:
            cell.arm.move_to(waypoint.joints, waypoint.speed, via=waypoint.via)
        times["withdrawn"].append(cell.clock.now - leaving)
        times["whole"].append(cell.clock.now - began - needed)
    return {
        **{name: statistics.fmean(values) for name, values in times.items()},
        "sent": (cell.arm_line.count(Direction.TO_DEVICE) - before) / taps,
    }


def _allow(cell: TrialCell, release_by: float) -> bool:
    """Store the deadline of the release for the cell's checks, and allow the shot."""
    cell.release_by = release_by
    return True


def stop_to_wire(stops: int) -> dict[str, float]:
    """Return the times in s from the call of ``stop`` until its bytes are received at the other end
    of the line. During this time, another thread writes."""
    master, slave = os.openpty()
    tty.setraw(slave)
    transport = SerialTransport(os.ttyname(slave))
    transport.open(1.0)
    ending = threading.Event()

    def work() -> None:
        while not ending.is_set():
            try:
                transport.write(b"G21G90G94G1X12.345Y12.345Z-1.000A0.000F1000.000\n")
                transport.read(0.005)
            except HardwareFault:
                time.sleep(0.001)

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    stopped: list[float] = []
    for _ in range(stops):
        transport.release()
        time.sleep(0.003)
        stopped.append(_until_received(master, lambda: transport.stop(STOP), STOP))
    ending.set()
    transport.release()
    worker.join()
    bare = [_until_received(master, lambda: os.write(slave, STOP), STOP) for _ in range(stops)]
    transport.close()
    os.close(slave)
    os.close(master)
    p99, peer = (float(np.percentile(values, 99)) for values in (stopped, bare))
    return {"stops": stops, "p99": p99, "worst": max(stopped), "bare_p99": peer}


def _until_received(master: int, act: Callable[[], object], wanted: bytes) -> float:
    began = time.perf_counter()
    act()
    received = b""
    while wanted not in received:
        received += os.read(master, 4096)
    return time.perf_counter() - began


def reconnect(times: int) -> dict[str, Any]:
    """Return, for each driver, the times in s from plugging the cable in until the device is
    identified."""
    found: dict[str, list[float]] = {}
    bare: list[float] = []
    now = time.monotonic()
    geometry = ScaraGeometry()
    boards: dict[str, tuple[DeviceEmulator, Callable[[Transport], ArmDriver | TapperDriver]]] = {
        "grbl": (GrblEmulator(now=now), lambda t: ArmDriver(t, GrblDialect(t), geometry)),
        "marlin": (MarlinEmulator(now=now), lambda t: ArmDriver(t, MarlinDialect(t), geometry)),
        "tapper": (TapperEmulator(now=now), TapperDriver),
    }
    with tempfile.TemporaryDirectory() as folder:
        for name, (board, make) in boards.items():
            path = Path(folder) / name
            with PseudoTerminal(board, path) as terminal:
                driver = make(SerialTransport(str(path)))
                driver.connect()
                found[name] = [_return_of(terminal, driver) for _ in range(times)]
                driver.close()
                began = time.monotonic()
                os.close(os.open(path, os.O_RDWR | os.O_NOCTTY))
                bare.append(time.monotonic() - began)
    medians = {name: statistics.median(values) for name, values in found.items()}
    return {
        "median": medians,
        "worst": max(max(values) for values in found.values()),
        "bare": statistics.median(bare),
    }


def _return_of(terminal: PseudoTerminal, driver: ArmDriver | TapperDriver) -> float:
    """Disconnect the cable, reconnect it while the driver waits, and return the time from the
    reconnection until the device is identified, in s."""
    terminal.hang_up()
    driver.close()
    back = threading.Timer(0.2, terminal.plug_in)
    due = time.monotonic() + 0.2
    back.start()
    driver.connect(10.0)
    back.join()
    return time.monotonic() - due
