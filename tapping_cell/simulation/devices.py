"""Simulated arm and tapper on pseudo-terminals; the striker hits objects of the simulated world."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tapping_cell.configuration.cell import ArmSection, Cell, TapperSection
from tapping_cell.se2 import Pose
from tapping_cell.simulation.arm_drawing import ArmDrawing
from tapping_cell.simulation.arm_emulator import ArmEmulator, AxisLimits
from tapping_cell.simulation.joint_motion import AxisErrors
from tapping_cell.simulation.motor_axes import TO_UNITS
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.rendered_camera import Drawing
from tapping_cell.simulation.striker_motion import Flight, striker_speed
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.truth import ArmTruth

OnStrike = Callable[[Pose, float, float, TapperSection, float], tuple[float, float]]
"""Callback when a striker is released. Arguments: true tip pose in ``table``, its height in m,
commanded speed in m/s, the tapper, time in s. Returns the speed measured by the speed gate, m/s,
and the tip's travel, m."""

SINKING_SPEED = 0.02
"""Sinking speed of a quill without a brake while its motor has no power, m/s."""
LARGEST_BOOT = 1_000_000


class SimulatedDevices:
    """Two emulated boards, each on a port that drivers open like a real one.

    Raises:
        PortTakenError: a port's path belongs to a running process.
    """

    def __init__(
        self,
        cell: Cell,
        truth: ArmTruth,
        arm_port: Path,
        tapper_port: Path,
        on_strike: OnStrike,
        seed: int,
    ) -> None:
        self._tapper_section = cell.file.tapper
        self._geometry = cell.arm.geometry()
        self._base = cell.arm_base @ Pose(*truth.base_offset)
        self._curve = cell.file.tapper.curve()
        self._on_strike = on_strike
        self._drawing = ArmDrawing(cell.arm, cell.file.tapper, self._base)
        self._drawn: tuple[tuple[float, ...], tuple[Drawing, ...]] = ((), ())
        self._flight = Flight(0.0, 1.0, 0.0)
        now = time.monotonic()
        self._arm = arm_emulator(cell.arm, truth, seed, now)
        # A restart of the simulation is a power-on of the board, so the boot number must be new.
        boot = int(time.time()) % LARGEST_BOOT + 1
        self._tapper = TapperEmulator(on_fire=self._fire, boot=boot, now=now)
        self._arm_port = PseudoTerminal(self._arm, arm_port)
        self._tapper_port = PseudoTerminal(self._tapper, tapper_port)
        self._arm_port.open()
        try:
            self._tapper_port.open()
        except BaseException:
            self._arm_port.close()
            raise

    def close(self) -> None:
        """Disconnect both devices."""
        self._tapper_port.close()
        self._arm_port.close()

    def press_clear_button(self) -> None:
        """Press the clear button at the cell; this is required before a stop can be cleared."""
        with self._tapper_port.lock:
            self._tapper.press_clear_button(time.monotonic())

    def _fire(self, shot: int, energy: float, now: float) -> float | None:
        """Handle a release: the striker starts at the true pose of the tip."""
        tip, height = self.tip(now)
        speed = striker_speed(self._curve, energy)
        measured, travel = self._on_strike(tip, height, speed, self._tapper_section, now)
        self._flight = Flight(now, speed, travel)
        return measured

    def drawings(self, now: float, exposed: float) -> tuple[Drawing, ...]:
        """Return the arm at its true position at ``now`` for the camera, with the striker as it is
        at ``exposed``, the world time of the image. The result is the same object while nothing
        moves."""
        with self._arm_port.lock:
            joints = self._arm.joints(now)
        key = (*joints, self._flight.extension(exposed))
        if key != self._drawn[0]:
            self._drawn = key, (self._drawing.at(joints, key[-1]),)
        return self._drawn[1]

    def tip(self, now: float) -> tuple[Pose, float]:
        """Return the true pose of the striker's tip in ``table`` and its height in m."""
        with self._arm_port.lock:
            joints = self._arm.joints(now)
        tip = self._geometry.forward(joints)
        return self._base @ Pose(tip.x, tip.y, tip.yaw), tip.z


def arm_emulator(arm: ArmSection, truth: ArmTruth, seed: int, now: float) -> ArmEmulator:
    """Return the emulated controller for the cell's dialect, configured for the cell's arm. It is
    made by ``make_emulator`` in ``NAME_emulator.py`` of this folder."""
    rates, pulls, spans = (
        tuple(float(scale * value) for scale, value in zip(TO_UNITS, values, strict=True))
        for values in (arm.max_speed, arm.max_acceleration, np.subtract(arm.upper, arm.lower))
    )
    machine = {
        "start_joints": arm.park,
        "home_joints": arm.home,
        "errors": AxisErrors(
            offset=truth.joint_offset, backlash=truth.backlash, repeatability=truth.repeatability
        ),
        "quill_sinks": 0.0 if arm.quill_brake else SINKING_SPEED,
        "quill_floor": arm.lower[2],
    }
    module = importlib.import_module(f"tapping_cell.simulation.{arm.dialect}_emulator")
    made: ArmEmulator = module.make_emulator(machine, AxisLimits(rates, pulls, spans), seed, now)
    return made
