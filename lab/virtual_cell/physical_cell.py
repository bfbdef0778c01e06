"""Physical part of a simulated cell: boards, serial lines, arm, striker, object and camera view."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from lab.virtual_cell.scheduler import Scheduler
from lab.virtual_cell.serial_line import SerialLine
from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.scara import Joints
from tapping_cell.se2 import Pose
from tapping_cell.simulation.arm_picture import arm_solids
from tapping_cell.simulation.devices import arm_emulator
from tapping_cell.simulation.fault_layer import FaultLayer
from tapping_cell.simulation.spring_drive import SpringMechanism
from tapping_cell.simulation.striker_motion import striker_speed
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine
from tapping_cell.simulation.truth import TruthFile
from tapping_cell.simulation.world import World


@dataclass(frozen=True, slots=True)
class Release:
    """Ground truth of one release of the striker: ``energy`` in J, ``height`` of the tip in m."""

    shot: int
    energy: float
    time: float
    joints: Joints
    moving: bool
    tip: Pose
    height: float
    object_pose: Pose


class PhysicalCell:
    """Parts of the cell that exist independently of any program. Times are in s from the start of
    the run."""

    def __init__(self, scheduler: Scheduler, cell: Cell, truth: TruthFile, seed: int) -> None:
        self.cell = cell
        self.truth = truth
        self.releases: list[Release] = []
        self.on_release: Callable[[], None] = lambda: None
        self._scheduler = scheduler
        self._captured: tuple[Pose, Joints] | None = None
        self._is_hidden = False
        self._curve = cell.file.tapper.curve()
        self.world = World(
            cell.object, cell.file.tapper.striker(), cell.file.tapper.stroke, truth, seed
        )
        self._make_devices(seed, scheduler.now)

    def _make_devices(self, seed: int, now: float) -> None:
        """Create the boards and their lines. Subclasses for other kinds of cells create other
        boards."""
        cell, truth, scheduler = self.cell, self.truth, self._scheduler
        self.geometry = cell.arm.geometry()
        self._base = cell.arm_base @ Pose(*truth.arm.base_offset)
        self.arm_board = arm_emulator(cell.arm, truth.arm, seed, now)
        # In half of the runs the spring cannot push the screw back while the motor is off.
        spring = SpringMechanism(back_drive=4000.0 if seed % 2 else 0.0)
        self.tapper_board = TapperEmulator(
            TapperMachine(spring=spring), self._release, boot=1, now=now
        )
        self.arm_line = SerialLine(scheduler, FaultLayer(self.arm_board), "arm")
        self.tapper_line = SerialLine(scheduler, FaultLayer(self.tapper_board), "tapper")

    def joints(self, time: float) -> Joints:
        """Return the true joints of the arm."""
        return Joints(*self.arm_board.joints(time))

    def moving(self, time: float) -> bool:
        """Return whether the arm truly moves."""
        return self.arm_board.moving(time)

    def tip(self, time: float) -> tuple[Pose, float]:
        """Return the true pose of the striker's tip in ``table`` and its height in m."""
        tip = self.geometry.forward(self.joints(time))
        return self._base @ Pose(tip.x, tip.y, tip.yaw), tip.z

    def object_pose(self, time: float) -> Pose:
        """Return the true pose of the object."""
        self.world.advance(time)
        return self.world.pose

    def view(self, time: float) -> Pose | None:
        """Return the true pose of the object, or None while the arm hides it from the camera."""
        pose = self.object_pose(time)
        return None if self._hidden(pose, time) else pose

    def energy_for(self, speed: float) -> float:
        """Return the energy in J for a striker speed in m/s, from the tapper's curve; inf if the
        curve does not include this speed."""
        possible = self._curve.slowest <= speed <= self._curve.fastest
        return self._curve.energy_for(speed) if possible else math.inf

    def flight(self, speed: float) -> float:
        """Return the time in s in which the striker covers its stroke at this speed (m/s)."""
        return self.cell.file.tapper.stroke / speed

    def press_clear_button(self) -> None:
        """Press the clear button at the tapper's board."""
        self.tapper_board.press_clear_button(self._scheduler.now)
        self.tapper_line.schedule()

    def set_enabling_switch(self, held: bool) -> None:
        """Hold or release the enabling switch at the tapper's board."""
        self.tapper_board.set_enabling_switch(held, self._scheduler.now)
        self.tapper_line.schedule()

    def set_interlock(self, closed: bool) -> None:
        """Open or close the guard."""
        self.tapper_board.set_interlock(closed, self._scheduler.now)
        self.tapper_line.schedule()

    def _hidden(self, pose: Pose, time: float) -> bool:
        """Return whether the arm's silhouette in the camera view overlaps the object's top."""
        joints = self.joints(time)
        if (pose, joints) != self._captured:
            self._captured = pose, joints
            self._is_hidden = self._silhouette_meets(pose, joints)
        return self._is_hidden

    def _silhouette_meets(self, pose: Pose, joints: Joints) -> bool:
        file = self.cell.file
        lens = np.array(self.truth.camera.position)
        radius, place = self.cell.object.body().bounding_radius, np.array([pose.x, pose.y])
        for solid in arm_solids(self.cell.arm, file.tapper, self._base, joints):
            scale = (lens[2] - self.cell.object.height) / (lens[2] - solid.points[:, 2])
            shadow = lens[:2] + (solid.points[:, :2] - lens[:2]) * scale[:, None]
            away = np.maximum(shadow.min(axis=0) - place, place - shadow.max(axis=0))
            if away.max() > radius:
                continue
            hull = cv2.convexHull(shadow.astype(np.float32))
            if cv2.pointPolygonTest(hull, (pose.x, pose.y), True) > -radius:
                return True
        return False

    def _release(self, shot: int, energy: float, now: float) -> float | None:
        """Handle a release of the striker by the board."""
        release = Release(
            shot,
            energy,
            now,
            self.joints(now),
            self.moving(now),
            *self.tip(now),
            self.object_pose(now),
        )
        speed = striker_speed(self._curve, energy)
        self.releases.append(self._described(release, speed))
        self.on_release()
        self._strike(release, speed)
        return self.world.gate_speed(speed)

    # Methods that a cell with several objects overrides

    def _described(self, release: Release, speed: float) -> Release:
        """Return a release with the ground truth that the cell's invariants need. ``speed``: of the
        striker, m/s."""
        return release

    def _strike(self, release: Release, speed: float) -> None:
        """Let the released striker fly; ``speed`` in m/s."""
        self.world.strike(release.tip, release.height, speed, release.time)
