"""Simulated world: publishes camera images and emulates two serial devices on pseudo-terminals.

All objects of the cell lie on one table and collide on contact.
"""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, PoseStamped
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ObjectContact, ObjectState, ObjectStates
from tapping_cell_msgs.srv import ResetWorld

from tapping_cell.configuration.cell import (
    Cell,
    TapperSection,
    load_further_objects,
    refuse_own_drivers,
)
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import ConfigurationError, load, quantity, text
from tapping_cell.hardware.tapper_boards import numbered
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.camera.picture_publisher import PicturePublisher
from tapping_cell.nodes.cell_identity import claim, key_of
from tapping_cell.nodes.cell_node import CellNode, NotReady, run
from tapping_cell.nodes.cell_parameters import ObjectParameters
from tapping_cell.nodes.conversions import from_message, is_finite, to_message
from tapping_cell.se2 import Pose
from tapping_cell.simulation.devices import SimulatedDevices
from tapping_cell.simulation.fixed_devices import FixedDevices
from tapping_cell.simulation.pacing import Pace
from tapping_cell.simulation.pseudo_terminal import PortTakenError
from tapping_cell.simulation.rendered_camera import SceneObject, SceneRenderer, forget_shared
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.tabletop import Tabletop, TrueContact
from tapping_cell.simulation.truth import TruthFile


@dataclass(frozen=True, slots=True)
class Parameters(ObjectParameters):
    """Parameters of sim_world."""

    other_object_files: str = text(
        "paths of the object files of additional objects on the table, besides those of the cell "
        "file, separated by commas",
        default="",
    )
    truth_file: str = text(
        "path of the simulation parameter file; if empty, the package's default", default=""
    )
    seed: int = quantity("random seed", "", 0, 2**31 - 1, default=1)
    arm_port: str = text(
        "path at which the emulated arm's serial port is created; if empty, the one in the cell "
        "file",
        default="",
    )
    tapper_port: str = text(
        "path at which the emulated tapper's serial port is created; if empty, the one in the "
        "cell file",
        default="",
    )
    frame_rate: float = quantity(
        "frame rate of the simulated camera", "Hz", 1.0, 120.0, default=30.0
    )
    slow_motion: float = quantity(
        "factor by which slides are slowed down, for a computer too slow for the frame rate; time "
        "stamps are those of the slide at normal speed",
        "",
        1.0,
        100.0,
        default=1.0,
    )
    compressed_quality: int = quantity(
        "JPEG quality of camera/image_raw/compressed", "", 50, 100, default=95
    )


class SimWorld(CellNode[Parameters]):
    """See the module's docstring."""

    def __init__(self) -> None:
        super().__init__("sim_world", Parameters)
        self._cell: Cell | None = None
        self._truth: TruthFile | None = None
        self._world: Tabletop | None = None
        self._renderer: SceneRenderer | None = None
        self._devices: SimulatedDevices | FixedDevices | None = None
        self._claim: socket.socket | None = None
        self._info = CameraInfo()
        self._lock = threading.Lock()
        self._late: deque[tuple[float, Image]] = deque()
        self._frames = 0
        self._world_began_ns = 0
        self._pace = Pace(1.0 / self.settings.frame_rate, self.settings.slow_motion)
        self._publisher = PicturePublisher(self, self.settings.compressed_quality)
        self._truth_publisher = self.create_publisher(PoseStamped, "ground_truth", 10)
        self._states_publisher = self.create_publisher(ObjectStates, "true_states", 10)
        self._contact_publisher = self.create_publisher(ObjectContact, "true_contacts", 10)
        self.create_service(ResetWorld, "reset_world", self._on_reset)
        self.create_service(Trigger, "~/press_clear_button", self._on_clear_button)
        self.create_timer(1.0 / self.settings.frame_rate, self._expose)

    def configure(self) -> None:
        """Create the world and open the two ports."""
        settings = self.settings
        cell = settings.load_cell()
        refuse_own_drivers(cell)
        truth = load(TruthFile, settings.truth_file or shared_folder() / "truth" / "default.yaml")
        truth.camera.check_rate(settings.frame_rate)
        further = load_further_objects(cell, settings.other_object_files)
        table = cell.file.table
        try:
            world = Tabletop(
                (cell.object, *further),
                cell.file.tapper.striker(),
                cell.file.tapper.stroke,
                truth,
                settings.seed,
                (table.length, table.width),
            )
        except ValueError as error:
            raise ConfigurationError(str(error)) from error
        own, *others = world.worlds.values()
        shown = [
            SceneObject(one.outline, file.seen()) for one, file in zip(others, further, strict=True)
        ]
        renderer = make_renderer(cell, truth.camera, own.outline, settings.seed, shown)
        # The first image takes much longer to render than the others. It is rendered before the
        # devices exist, because it would delay the emulated boards.
        renderer.render(list(world.poses.values()))
        forget_shared()
        self._claim = claim(f"world/{key_of(self)}")
        if self._claim is None:
            raise NotReady(
                "another simulated world runs on this machine in ROS domain "
                f"{self.context.get_domain_id()}, namespace '{self.get_namespace()}': end that "
                "world, or start this one with another ROS_DOMAIN_ID or namespace"
            )
        try:
            devices = self._make_devices(cell, truth)
        except PortTakenError as error:
            raise NotReady(str(error)) from error
        self._cell, self._truth, self._world, self._devices = cell, truth, world, devices
        self._renderer = renderer
        self._info = images.to_camera_info(cell.camera)

    def _make_devices(self, cell: Cell, truth: TruthFile) -> SimulatedDevices | FixedDevices:
        settings = self.settings
        if cell.file.arm is None:
            return FixedDevices(
                cell,
                truth.mounts,
                ports=lambda board, port: self.port_path(
                    numbered(settings.tapper_port, board) or port
                ),
                on_strike=self._on_strike,
                seed=settings.seed,
            )
        return SimulatedDevices(
            cell,
            truth.arm,
            arm_port=self.port_path(settings.arm_port or cell.arm.port),
            tapper_port=self.port_path(settings.tapper_port or cell.file.tapper.port),
            on_strike=self._on_strike,
            seed=settings.seed,
        )

    def cleanup(self) -> None:
        """Close the ports and remove the devices."""
        if self._devices is not None:
            self._devices.close()
        self._devices = None
        if self._claim is not None:
            self._claim.close()
        self._claim = None
        self._late.clear()

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Report the number of published images."""
        return DiagnosticStatus.OK, "ok", {"pictures": self._frames}

    def _on_strike(
        self, tip: Pose, height: float, speed: float, tapper: TapperSection, now: float
    ) -> tuple[float, float]:
        """Simulate a strike. Called from the emulator's thread."""
        with self._lock:
            if self._world is None:
                return speed, tapper.stroke
            self._world.advance(now)
            self._world.take_striker(tapper.striker(), tapper.stroke)
            travel = min(self._world.travel_to_meet(tip, height, speed), tapper.stroke)
            self._world.strike(tip, height, speed, now)
            return self._world.gate_speed(speed), travel

    def _expose(self) -> None:
        """Take an image when it is due, and publish an image when its latency has passed."""
        if not self.active or self._world is None:
            return
        assert self._renderer is not None and self._truth is not None
        camera = self._truth.camera
        self._send_late()
        now, clock = time.monotonic(), self.get_clock().now().nanoseconds
        with self._lock:
            taken = self._pace.next_picture(now, self._world.at_rest)
            if taken is None:
                return
            opening, middle, closing = (
                self._poses_at(taken - camera.imaging_time * share) for share in (1.0, 0.5, 0.0)
            )
            contacts = self._world.take_contacts()
        if taken == now:
            # Only an image that is taken at the present time sets a new offset between the two
            # clocks. Most images of a slide are taken at other times and keep the previous offset.
            # A new offset for each of these images would shift their stamps relative to each other
            # if a task switch occurred between reading the two clocks.
            self._world_began_ns = clock - round(1e9 * now)
        stamp = self._stamp_at(taken - camera.imaging_time / 2)
        self._publish_truth(middle, stamp)
        for contact in contacts:
            self._publish_contact(contact)
        devices = self._devices if camera.shows_arm else None
        drawings = devices.drawings(now, taken) if devices is not None else ()
        later = [[*middle.values()], [*closing.values()]]
        image = self._renderer.render([*opening.values()], later, drawings=drawings)
        picture = images.to_message(image, "mono8")
        picture.header.frame_id = images.OPTICAL_FRAME
        picture.header.stamp = stamp.to_msg()
        self._late.append((now + camera.latency, picture))
        self._send_late()

    def _stamp_at(self, steady: float) -> Time:
        """Return the ROS time that belongs to a steady time, s. A clock that has just begun at zero
        has no earlier time."""
        return Time(nanoseconds=max(0, self._world_began_ns + round(1e9 * steady)))

    def _poses_at(self, time: float) -> dict[str, Pose]:
        """Return the true poses of the objects, on the table or held by the arm."""
        assert self._world is not None and self._truth is not None and self._devices is not None
        self._world.advance(time)
        poses, held = dict(self._world.poses), self._truth.arm.holds
        if held is not None and isinstance(self._devices, SimulatedDevices):
            poses[next(iter(poses))] = self._devices.tip(time)[0] @ Pose(*held)
        return poses

    def _send_late(self) -> None:
        while self._late and self._late[0][0] <= time.monotonic():
            self._publisher.publish(self._late.popleft()[1], self._info)
            self._frames += 1

    def _publish_truth(self, poses: dict[str, Pose], stamp: Time) -> None:
        message = PoseStamped()
        message.header.frame_id = "table"
        message.header.stamp = stamp.to_msg()
        message.pose = to_message(next(iter(poses.values())))
        self._truth_publisher.publish(message)
        assert self._world is not None
        states = ObjectStates(header=message.header)
        for name, pose in poses.items():
            state = ObjectState(header=message.header, object_id=name, visible=True)
            state.at_rest = self._world.worlds[name].at_rest
            state.pose.pose = to_message(pose)
            vx, vy, omega = self._world.worlds[name].twist
            state.velocity.linear.x, state.velocity.linear.y = vx, vy
            state.velocity.angular.z = omega
            states.objects.append(state)
        self._states_publisher.publish(states)

    def _publish_contact(self, contact: TrueContact) -> None:
        x, y = contact.place
        message = ObjectContact(
            object_id=contact.name,
            other_id=contact.other,
            position=Point(x=x, y=y, z=0.0),
            closing_speed=contact.closing_speed,
        )
        message.header.frame_id = "table"
        message.header.stamp = self._stamp_at(contact.time).to_msg()
        self._contact_publisher.publish(message)

    def _on_clear_button(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Simulate the person who presses the clear button at the tapper after a stop."""
        if self._devices is not None:
            self._devices.press_clear_button()
        response.success = self._devices is not None
        response.message = "pressed" if response.success else "the world is not active yet"
        return response

    def _on_reset(
        self, request: ResetWorld.Request, response: ResetWorld.Response
    ) -> ResetWorld.Response:
        if self._world is None or self._cell is None or not self.active:
            response.message = "the world is not active yet; call again when sim_world is active"
            return response
        name = request.object_id or self._cell.object.name
        try:
            with self._lock:
                pose = self._place(name, request, self._world, self._cell)
        except ValueError as error:
            response.message = f"{error}; nothing was moved"
            return response
        response.success = True
        response.message = f"'{name}' is at x {1000 * pose.x:.1f} mm, y {1000 * pose.y:.1f} mm"
        return response

    def _place(self, name: str, request: ResetWorld.Request, world: Tabletop, cell: Cell) -> Pose:
        """Place an object as requested and return its pose. Raises ValueError with the reason why
        nothing was moved."""
        if name not in world.worlds:
            known = ", ".join(f"'{each}'" for each in world.worlds)
            raise ValueError(f"there is no object '{name}'; name one of {known}")
        if request.seed:
            world.reseed(request.seed)
        if request.random:
            fixed = cell.file.fixed_tappers
            pose = world.free_pose(name, disc=None if fixed is None else fixed.working_area)
        elif is_finite(request.object_pose):
            pose = from_message(request.object_pose)
        else:
            raise ValueError("the pose contains an infinity or NaN")
        table = cell.file.table
        if abs(pose.x) > table.length / 2 or abs(pose.y) > table.width / 2:
            raise ValueError(
                f"x {1000 * pose.x:.1f} mm, y {1000 * pose.y:.1f} mm is off the table of "
                f"{1000 * table.length:.0f} x {1000 * table.width:.0f} mm"
            )
        world.place(name, pose)
        return pose


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(SimWorld, arguments)


if __name__ == "__main__":
    sys.exit(main())
