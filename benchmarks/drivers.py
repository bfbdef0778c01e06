"""Overhead of the drivers of arm and tapper per tap, beyond motion, settling and charging.

The overhead is measured in the emulated devices' own time, so that it does not depend on the load
of the computer. Replies take the time of a real line at 115200 baud, plus 2 ms for the adapter.
Commands arrive immediately, as over a native USB port. The bytes sent to the arm are counted,
because each byte would take additional time on a slower line.
"""

from __future__ import annotations

import statistics
from collections import defaultdict
from functools import partial
from typing import Any

from lab.drivers.driver_trials import Dialect, TrialCell
from tapping_cell.hardware.motion import path_duration, strike_path, withdraw_path
from tapping_cell.logic.tapper_jobs import WINDOW_S
from tapping_cell.simulation.fault_layer import Direction
from tapping_cell.simulation.spring_drive import SETTLE_TIME

LANGUAGES = (Dialect.GRBL, Dialect.MARLIN)
TAPS = 200
BYTE_S = 10 / 115200


def measure() -> dict[str, Any]:
    """Return the mean times of a tap for each dialect of the arm's controller, in s."""
    return {dialect.value: overhead(dialect, TAPS) for dialect in LANGUAGES}


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    return [
        f"{dialect}: {figures['in_position']:.2f} s from command to in position and"
        f" {figures['withdrawn']:.2f} s back to the park pose;"
        f" overhead per tap beyond motion, settling and charging:"
        f" {1e3 * figures['to_release']:.1f} ms until the release,"
        f" {1e3 * figures['whole']:.1f} ms until parked again, and"
        f" {1e3 * figures['reading']:.1f} ms for reading the arm back before it withdraws, while"
        f" the node waits for the end of the release; {figures['sent']:.0f} bytes per tap to the"
        f" arm's board, which take {1e3 * BYTE_S * figures['sent']:.0f} ms more at 115200 baud"
        for dialect, figures in report.items()
    ]


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
