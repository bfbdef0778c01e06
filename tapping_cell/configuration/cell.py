"""The cell file: poses, dimensions and settings of a cell, and loading of the files it names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, Literal

from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.hints import git_hint
from tapping_cell.configuration.objects import ObjectFile, load_object
from tapping_cell.configuration.provenance import Provenance
from tapping_cell.configuration.schema import (
    ConfigurationError,
    choice,
    load,
    quantity,
    section,
    similar_path,
    text,
)
from tapping_cell.configuration.table import load_camera_model, load_reference_map
from tapping_cell.hardware.arm_settings import ArmSettings
from tapping_cell.hardware.arm_shape import ArmShape
from tapping_cell.hardware.axis_units import check_letters
from tapping_cell.hardware.chain_urdf import chain_from_urdf
from tapping_cell.hardware.controller_needs import ControllerNeeds, needs_of
from tapping_cell.hardware.controllers import CONTROLLERS
from tapping_cell.hardware.energy import EnergyCurve
from tapping_cell.hardware.fixed_urdf import MountedTapper
from tapping_cell.hardware.motion import MotionSettings
from tapping_cell.hardware.output_tapper import OutputTapperSettings
from tapping_cell.hardware.scara import Joints, ScaraGeometry
from tapping_cell.hardware.serial_chain import SerialChain, pose_matrix
from tapping_cell.hardware.tapper_boards import CHANNELS_PER_BOARD, cell_channel
from tapping_cell.mechanics import Striker
from tapping_cell.se2 import Pose
from tapping_cell.vision import CameraModel, ReferenceMap, marker_ids

STANDARD_BAUDS = (
    *(1200, 2400, 4800, 9600, 14_400, 19_200, 28_800, 31_250, 38_400, 57_600, 74_880, 76_800),
    *(115_200, 128_000, 153_600, 230_400, 250_000, 256_000, 307_200, 460_800, 500_000, 576_000),
    *(614_400, 921_600, 1_000_000, 1_152_000, 1_228_800, 1_500_000, 2_000_000, 2_500_000),
    *(3_000_000, 3_500_000, 4_000_000),
)
"""Usual baud rates. Others are possible, but not within 5 % of one of these: such a rate would work
only sometimes, and is probably a mistake."""
LEAST_ENERGY = 0.005
"""Minimum ratio of the striker's kinetic energy to the charged energy at the best point of a curve.
Coil drives reach 0.01 to 0.1, springs 0.3 to 1; energies in mJ in place of J give less than
0.001."""
FourNumbers = tuple[float, float, float, float]
ARM_TAPPER = "tapper"
"""Name of the tapper that the arm carries."""
MOST_ENERGY = 1.2
"""Maximum ratio of the striker's kinetic energy to the charged energy. It would be 1 without the
error of a calibration: the calibrated energy is proportional to the assumed friction."""
LARGEST_FILE_ANGLE_TOLERANCE = 0.4
"""Maximum angle tolerance in a file, rad. A larger value is probably in degrees; a program may send
a goal with a larger tolerance."""
LONGEST_FLIGHT_S = 2.0
"""Maximum time of flight of a striker, in s. The arm must stand still during the flight."""

Constraint = Literal["linear_bearings", "free"]
JointName = Literal["shoulder", "elbow", "quill", "tool"]


@dataclass(frozen=True, slots=True)
class TableSection:
    """The part of the table on which objects may lie."""

    length: float = quantity(
        "length of the area along x; the area is centred on the origin", "m", 0.05, 10.0
    )
    width: float = quantity(
        "width of the area along y; the area is centred on the origin", "m", 0.05, 10.0
    )
    edge_margin: float = quantity(
        "minimum distance between the object and a table edge", "m", 0.0, 0.5, default=0.005
    )
    keep_out_margin: float = quantity(
        "minimum distance of object and striker from keep-out zones", "m", 0.0, 0.5, default=0.005
    )
    overhang: float = quantity(
        "maximum distance by which the striker may extend beyond a table edge",
        "m",
        0.0,
        2.0,
        default=0.15,
    )


@dataclass(frozen=True, slots=True)
class KeepOutSection:
    """Zones that neither the object nor the striker may enter."""

    circles: tuple[tuple[float, float, float], ...] = quantity(
        "circular zones: x, y and radius, in the frame table", "m", -5.0, 5.0, default=()
    )
    polygons: tuple[tuple[tuple[float, float], ...], ...] = quantity(
        "polygonal zones, convex or not: corners x, y in the frame table",
        "m",
        -5.0,
        5.0,
        default=(),
    )

    def __post_init__(self) -> None:
        """Raise ValueError for a polygon whose edges cross."""
        for number, corners in enumerate(self.polygons):
            if len(corners) < 3:
                raise ValueError(
                    f"'polygons[{number}]' has {len(corners)} corners, but needs at least 3"
                )
            if crossing := crossing_edges(corners):
                first, second = crossing
                raise ValueError(
                    f"in 'polygons[{number}]' the edge after corner {first + 1} crosses the edge "
                    f"after corner {second + 1}; give the corners in their order along the outline"
                )


def crossing_edges(corners: Sequence[tuple[float, float]]) -> tuple[int, int] | None:
    """Return the indices of the corners at which two edges of a polygon begin that cross; None if
    no edges cross."""

    def side(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    ends = (*corners[1:], *corners[:1])
    edges = enumerate(zip(corners, ends, strict=True))
    for (first, (a, b)), (second, (c, d)) in combinations(edges, 2):
        if side(a, b, c) * side(a, b, d) < 0.0 and side(c, d, a) * side(c, d, b) < 0.0:
            return first, second
    return None


@dataclass(frozen=True, slots=True)
class ChainSection:
    """Kinematics of an arm that is not a SCARA, taken from its URDF."""

    urdf: str = text(
        "path of the arm's URDF file, relative to this file; expand a xacro file beforehand"
    )
    base_link: str = text("link of the URDF at which the chain begins")
    tip_link: str = text(
        "link of the URDF to which the tapper is attached; the kinematic chain ends here"
    )
    tool: tuple[float, float, float, float, float, float] = quantity(
        "pose of the striker's tip in tip_link (x, y, z in m, roll, pitch, yaw in rad); the x axis "
        "of the tip points along the line of travel, and its z axis up",
        "m, m, m, rad, rad, rad",
        -7.0,
        7.0,
    )
    max_acceleration: tuple[float, ...] = quantity(
        "deceleration of each joint of the arm in a braking stop, in the order of "
        "joints: rad/s^2 (rotary joint) or m/s^2 (prismatic joint)",
        "",
        0.001,
        1000.0,
    )
    mount: tuple[float, float, float, float, float, float] = quantity(
        "pose of base_link in arm_base: x, y, z in m, roll, pitch, yaw in rad",
        "m, m, m, rad, rad, rad",
        -7.0,
        7.0,
        default=(0.0,) * 6,
    )
    tilt: float = quantity(
        "maximum tilt of the striker from the vertical; a pose with a larger tilt is rejected",
        "rad",
        0.0005,
        0.1,
        default=0.01,
    )


@dataclass(frozen=True, slots=True)
class Ros2ControlSection:
    """Interfaces of an arm with a ROS driver of its own: its controller and joint states."""

    controller: str = text(
        "full name of the arm's joint_trajectory_controller, such as /scara_controller"
    )
    joints: tuple[str, ...] = text(
        "names of the joints in the arm's driver, in the order of the kinematic chain (SCARA: "
        "shoulder, elbow, quill, tool)"
    )
    joint_states: str = text(
        "full name of the topic of the arm's joint states", default="/joint_states"
    )
    interface: str = choice(
        "interface for sending trajectories: auto uses the action if control_msgs is installed and "
        "the controller offers the action, otherwise the topic",
        "auto",
        "topic",
        "action",
        default="topic",
    )
    state_timeout: float = quantity(
        "time without joint states after which the connection to the arm counts as lost",
        "s",
        0.05,
        1.0,
        default=0.25,
    )
    chain: ChainSection | None = section(
        "kinematics of an arm that is not a SCARA, with any number of joints", default=None
    )

    def __post_init__(self) -> None:
        _check_full_name("controller", self.controller)
        _check_full_name("joint_states", self.joint_states)
        if len(set(self.joints)) != len(self.joints) or not all(self.joints):
            raise ValueError(f"joints {list(self.joints)}: each joint needs a name of its own")


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmSection:
    """The SCARA arm: base pose, dimensions, limits, moves and controller.

    For an arm that is not a SCARA, the dimensions describe a SCARA that the planner uses in its
    place. The real arm must be able to reach every tip pose of this SCARA (see
    `ros2_control.chain`).
    """

    base: tuple[float, float, float] = quantity(
        "pose of arm_base in the frame table: x and y in m, angle in rad", "m, m, rad", -7.0, 7.0
    )
    upper_arm: float = quantity("distance from shoulder axis to elbow axis", "m", 0.02, 3.0)
    forearm: float = quantity("distance from elbow axis to quill axis", "m", 0.02, 3.0)
    tip_forward: float = quantity("offset of the tip forward of the quill axis", "m", -0.5, 0.5)
    tip_side: float = quantity("offset of the tip to the left of the quill axis", "m", -0.5, 0.5)
    tip_yaw: float = quantity(
        "angle from the tool's heading to the striker's line of travel", "rad", -7.0, 7.0
    )
    tip_height: float = quantity(
        "height of the tip above the table when the quill is at zero", "m", 0.0, 2.0
    )
    lower: FourNumbers = quantity(
        "lower limits of shoulder, elbow, quill and tool", "rad, rad, m, rad", -20.0, 20.0
    )
    upper: FourNumbers = quantity(
        "upper limits of shoulder, elbow, quill and tool", "rad, rad, m, rad", -20.0, 20.0
    )
    max_speed: FourNumbers = quantity(
        "maximum speeds of shoulder, elbow, quill and tool: rad/s, rad/s, m/s, rad/s",
        "",
        0.001,
        100.0,
    )
    max_acceleration: FourNumbers = quantity(
        "maximum accelerations of shoulder, elbow, quill and tool: rad/s^2, rad/s^2, "
        "m/s^2, rad/s^2",
        "",
        0.001,
        1000.0,
    )
    singularity_margin: float = quantity(
        "minimum angle of the elbow from the stretched and from the folded position, in which "
        "the arm is singular",
        "rad",
        0.0,
        0.5,
    )
    strike_height: float = quantity(
        "height of the tip above the table during a strike", "m", 0.001, 0.2
    )
    travel_height: float = quantity(
        "height of the tip above the table while the arm travels", "m", 0.01, 1.0
    )
    travel_speed: float = quantity(
        "travel speed as a fraction of the maximum joint speeds", "", 0.01, 1.0
    )
    near_speed: float = quantity(
        "speed of the slow moves (the last part of the lowering, backing off, lowering "
        "at the park pose), as a fraction of the maximum joint speeds",
        "",
        0.01,
        1.0,
    )
    back_off: float = quantity(
        "distance by which the tip retreats along the line of travel after a tap, before the arm "
        "raises it",
        "m",
        0.0,
        0.1,
    )
    park: FourNumbers = quantity(
        "joint positions at which the arm waits outside the camera's view: shoulder, "
        "elbow, quill, tool in rad, rad, m, rad",
        "rad, rad, m, rad",
        -20.0,
        20.0,
    )
    dialect: str = choice(
        "protocol of the arm's controller; ros2_control if the arm has a ROS driver of its own",
        *CONTROLLERS,
        "ros2_control",
    )
    ros2_control: Ros2ControlSection | None = section(
        "settings of the arm's own ROS driver, for the dialect ros2_control", default=None
    )
    port: str = text(
        "path of the controller's serial port. Placeholders: ~ is the home folder, and "
        "{namespace} is the node's namespace. In paths of simulated ports, {cell} is a name that "
        "is unique to the namespace and the ROS domain.",
        default="",
    )
    baud: int = quantity(
        "baud rate of the arm's serial line", "baud", 1200, 4_000_000, default=115_200
    )
    homing: str = choice(
        "homing method: firmware (the controller's own homing cycle), manual_pose (a person "
        "moves the arm to the pose home) or none (the controller always knows its position, "
        "for example from absolute encoders)",
        "firmware",
        "manual_pose",
        "none",
    )
    home: FourNumbers = quantity(
        "joint positions at the end of homing: shoulder, elbow, quill, tool in rad, rad, m, rad",
        "rad, rad, m, rad",
        -20.0,
        20.0,
        default=(0.0,) * 4,
    )
    near_height: float = quantity(
        "height above the strike pose below which the striker is lowered at near_speed",
        "m",
        0.0,
        0.2,
        default=0.015,
    )
    link_half_width: float = quantity(
        "half the width of the links as seen by the camera", "m", 0.001, 0.5, default=0.03
    )
    link_thickness: float = quantity("thickness of the links", "m", 0.001, 0.5, default=0.04)
    link_clearance: float = quantity(
        "vertical distance from the tip up to the undersides of the links when the quill "
        "is at zero",
        "m",
        -0.5,
        1.0,
        default=0.03,
    )
    axes_without_switch: tuple[JointName, ...] = choice(
        "joints without a home switch, which an operator moves to `home` before homing",
        *Joints._fields,
        default=(),
    )
    home_place: FourNumbers | None = quantity(
        "axis positions that a Grbl-family controller reports after homing, in degrees and mm; "
        "computed from the controller's settings if left out",
        "",
        -1e5,
        1e5,
        default=None,
    )
    homing_timeout: float = quantity("timeout of the homing cycle", "s", 1.0, 600.0, default=60.0)
    axis_letters: str = text(
        "axis letters of shoulder, elbow, quill and tool in the controller", default="XYZA"
    )
    axis_sign: tuple[int, int, int, int] = quantity(
        "direction of each controller axis relative to its joint: 1 or -1",
        "",
        -1,
        1,
        default=(1, 1, 1, 1),
    )
    tolerance_angle: float = quantity(
        "maximum error of a rotary joint at which the arm counts as in position",
        "rad",
        1e-5,
        0.1,
        default=1e-3,
    )
    tolerance_quill: float = quantity(
        "maximum error of the quill at which the arm counts as in position",
        "m",
        1e-6,
        1e-3,
        default=1e-4,
    )
    settle_time: float = quantity(
        "time from the end of the last move until the arm counts as in position",
        "s",
        0.0,
        5.0,
        default=0.15,
    )
    quill_brake: bool = text(
        "whether a brake or a counterweight holds the quill while its motor has no power",
        default=False,
    )
    joint_offset: FourNumbers = quantity(
        "calibrated offsets of shoulder, elbow, quill and tool: true position minus the "
        "position in the controller, in rad, rad, m, rad",
        "rad, rad, m, rad",
        -1.0,
        1.0,
        default=(0.0,) * 4,
    )
    calibration: Provenance | None = section(
        "record of the calibration that set base and joint_offset", default=None
    )
    steps_per_unit: tuple[float, ...] = quantity(
        "steps per degree (rotary axis) or per mm (quill) that must be set in the "
        "controller for its four axes; if empty, the steps are not checked",
        "",
        0.001,
        1e6,
        default=(),
    )
    grbl_settings: tuple[tuple[float, float], ...] = quantity(
        "required Grbl settings ($$) in addition to $13 = 0: number and value, such as [[23, 3], "
        "[27, 1.0]]",
        "",
        -1e7,
        1e7,
        default=(),
    )

    def geometry(self) -> ScaraGeometry:
        """Return the dimensions and limits for the kinematics."""
        return ScaraGeometry(**_values(self, ScaraGeometry))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints in the messages of the arm's driver, from the base on."""
        return self.ros2_control.joints if self.ros2_control else Joints._fields

    @property
    def joint_states_topic(self) -> str:
        """Topic of the arm's joint states."""
        return self.ros2_control.joint_states if self.ros2_control else "joint_states"

    @property
    def homes_alone(self) -> bool:
        """Return whether the arm can be homed without a person at the arm."""
        return self.homing != "manual_pose" and not self.axes_without_switch

    def driver_settings(self) -> ArmSettings:
        """Return wiring, homing and tolerances for the arm's driver.

        Raises:
            ValueError: axis_sign or axis_letters are invalid, or keys do not suit the dialect.
        """
        check_letters(self.axis_letters)
        _check_baud("arm.baud", self.baud)
        self._check_dialect()
        return ArmSettings(
            axis_sign=self.axis_sign,
            home_joints=self.home,
            homing_timeout=self.homing_timeout,
            tolerance_angle=self.tolerance_angle,
            tolerance_quill=self.tolerance_quill,
            settle_time=self.settle_time,
            quill_brake=self.quill_brake,
        )

    def _check_dialect(self) -> None:
        section = self.ros2_control
        for key in ("grbl_settings", "home_place"):
            if self.dialect != "grbl" and getattr(self, key):
                raise ValueError(
                    f"arm.{key} is not used by the dialect {self.dialect}: leave it out"
                )
        if self.home_place == self.home and any(self.home):
            raise ValueError(
                f"arm.home_place is {list(self.home)}, the same as arm.home, which is in rad and "
                "m; give the positions that the controller reports, in degrees and mm"
            )
        if self.dialect != "ros2_control":
            if section is not None:
                raise ValueError(
                    f"arm.ros2_control is not used by the dialect {self.dialect}: leave it out"
                )
            if not self.port:
                raise ValueError(f"key 'arm.port' is missing: the dialect {self.dialect} needs it")
            return
        if section is None:
            raise ValueError("key 'arm.ros2_control' is missing: the dialect ros2_control needs it")
        if self.port:
            raise ValueError("arm.port is not used by the dialect ros2_control: leave it out")
        if section.chain is None and len(section.joints) != len(self.lower):
            raise ValueError(
                f"arm.ros2_control.joints has {len(section.joints)} names, the arm has"
                f" {len(self.lower)} joints; an arm that is not a SCARA needs"
                " arm.ros2_control.chain"
            )
        if self.homing != "none":
            raise ValueError(
                f"arm.homing is {self.homing}, but must be none for the dialect ros2_control: the"
                " arm's own driver homes it"
            )

    def chain(self) -> SerialChain | None:
        """Return the arm's own kinematics; None for a SCARA.

        Raises:
            ValueError: the URDF cannot be read or contradicts ``arm.ros2_control``, or
                ``chain.max_acceleration`` does not have one value for each joint.
        """
        section = self.ros2_control
        if section is None or section.chain is None:
            return None
        chain = section.chain
        if len(chain.max_acceleration) != len(section.joints):
            raise ValueError(
                f"arm.ros2_control.chain.max_acceleration has {len(chain.max_acceleration)}"
                f" values, but arm.ros2_control.joints has {len(section.joints)}; give one value"
                " for each joint"
            )
        try:
            text = Path(chain.urdf).read_text(encoding="utf-8")
            if conflict := git_hint(text):
                raise ValueError(conflict)
            return chain_from_urdf(
                text,
                chain.base_link,
                chain.tip_link,
                section.joints,
                pose_matrix(chain.mount),
                pose_matrix(chain.tool),
            )
        except OSError as error:
            raise ValueError(
                f"arm.ros2_control.chain.urdf {chain.urdf}: cannot be read ({error.strerror}); "
                "give the path of the URDF file, relative to this file"
                + similar_path(Path(chain.urdf))
            ) from error
        except UnicodeDecodeError as error:
            raise ValueError(
                f"arm.ros2_control.chain.urdf {chain.urdf}: is not UTF-8 text; save it as UTF-8"
            ) from error
        except ValueError as error:
            raise ValueError(f"arm.ros2_control.chain.urdf {chain.urdf}: {error}") from error

    def controller_needs(self) -> ControllerNeeds:
        """Return the values that the settings in the arm's controller must have.

        Raises:
            ValueError: steps_per_unit is not empty, but does not have four values.
        """
        if len(self.steps_per_unit) not in (0, 4):
            raise ValueError(
                f"arm.steps_per_unit has {len(self.steps_per_unit)} values, but must have four or "
                "none"
            )
        return needs_of(self.geometry(), self.steps_per_unit)

    def motion(self) -> MotionSettings:
        """Return heights, speeds and park pose of the tap moves."""
        return MotionSettings(**_values(self, MotionSettings))

    def shape(self, tapper: TapperSection) -> ArmShape:
        """Return the parts of the arm and its tool that can occlude the table."""
        return ArmShape(
            link_half_width=self.link_half_width,
            link_thickness=self.link_thickness,
            link_clearance=self.link_clearance,
            tool_half_width=tapper.tool_radius,
            tool_length=tapper.tool_length,
        )


def _check_baud(key: str, baud: int) -> None:
    """Raise ValueError for a baud rate that is nearly a standard one."""
    nearest = min(STANDARD_BAUDS, key=lambda rate: abs(rate - baud))
    if 0 < abs(baud - nearest) < 0.05 * nearest:
        raise ValueError(
            f"key '{key}' is {baud}, which is not a standard baud rate; did you mean {nearest}?"
        )


def _values(section: ArmSection, kind: type) -> dict[str, Any]:
    """Return the fields of the dataclass ``kind`` with their values in ``section``. Every field of
    ``kind`` must be a key of the section."""
    return {field.name: getattr(section, field.name) for field in fields(kind)}


def _check_full_name(key: str, name: str) -> None:
    """Raise ValueError if the value of a key is not the full name of a ROS topic or service."""
    if not name.startswith("/") or name.endswith("/") or len(name) < 2:
        raise ValueError(f"{key} is '{name}', but must be a full name, such as /name")


LONGEST_SHOT = 0.1
"""Maximum time from the last check before a pulse until the output is off, in s. This time plus the
striker's time of flight must pass before the arm is allowed to move again."""


@dataclass(frozen=True, slots=True)
class OutputSection:
    """Digital output that fires the tapper (dialect `io`)."""

    interface: str = choice(
        "interface that switches the output: service (std_srvs/SetBool), topic (std_msgs/Bool), "
        "commands (std_msgs/Float64MultiArray, for a forward_command_controller) or pulse "
        "(std_msgs/Float64: pulse length in s, timed by the receiver)",
        "service",
        "topic",
        "commands",
        "pulse",
    )
    name: str = text("full name of the output's service or topic, such as /robot/set_output")
    guard: str = text(
        "full name of the topic (std_msgs/Bool) that reports whether the guard is closed"
    )
    pulses: tuple[float, ...] = quantity(
        "pulse length for each energy in tapper.energies, in the same order; must increase",
        "s",
        0.0005,
        0.08,
    )
    read_back: str = text(
        "full name of the topic (std_msgs/Bool) that reports whether the output is on; if left "
        "out, only the camera can confirm that a shot was fired",
        default="",
    )
    latency: float = quantity(
        "maximum measured delay between sending a command and the switching of the output",
        "s",
        0.001,
        0.045,
        default=0.02,
    )

    def __post_init__(self) -> None:
        _check_full_name("name", self.name)
        _check_full_name("guard", self.guard)
        if self.read_back:
            _check_full_name("read_back", self.read_back)
        if any(b <= a for a, b in pairwise(self.pulses)):
            raise ValueError(f"pulses {list(self.pulses)} must increase")
        longest = max(self.pulses, default=0.0) + 2 * self.latency
        if longest > LONGEST_SHOT:
            raise ValueError(
                f"the longest pulse and twice the latency take {longest:.3f} s (limit "
                f"{LONGEST_SHOT:g} s); shorten the pulses, or use an output with a smaller latency"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class TapperSection:
    """The striker and the device that charges and fires it."""

    dialect: str = choice(
        "device that fires the striker: board for the tapper's own board, io for a digital output "
        "of a robot or another controller",
        "board",
        "io",
        default="board",
    )
    output: OutputSection | None = section("digital output, for the dialect io", default=None)
    port: str = text(
        "path of the serial port of the tapper's board; placeholders as in arm.port", default=""
    )
    baud: int = quantity(
        "baud rate of the tapper's serial line", "baud", 1200, 4_000_000, default=115_200
    )
    mass: float = quantity("mass of the striker", "kg", 0.001, 10.0)
    tip_radius: float = quantity("radius of the ball at the tip", "m", 0.0005, 0.1)
    constraint: Constraint = choice(
        "guidance of the striker in the impact model: linear_bearings (it moves only along "
        "its line of travel) or free (it can also be deflected sideways)",
        "linear_bearings",
        "free",
    )
    standoff: float = quantity(
        "distance between the tip at rest and the object's edge before a tap", "m", 0.001, 0.2
    )
    stroke: float = quantity("maximum travel of the tip", "m", 0.001, 0.3)
    tool_radius: float = quantity(
        "half the width of the tool, which is the bar behind the tip", "m", 0.0005, 0.1
    )
    tool_start: float = quantity(
        "distance from the centre of the tip back to the front end of the tool (the bar "
        "behind the tip)",
        "m",
        0.0,
        0.2,
    )
    tool_length: float = quantity(
        "distance from the centre of the tip back to the rear end of the tool", "m", 0.0, 1.0
    )
    energies: tuple[float, ...] = quantity(
        "charged energies at which the striker's speed was measured, increasing", "J", 0.0, 1000.0
    )
    speeds: tuple[float, ...] = quantity(
        "measured striker speed at each of these energies, increasing",
        "m/s",
        0.0,
        100.0,
    )
    calibration: Provenance | None = section(
        "record of the calibration that set energies and speeds", default=None
    )

    def curve(self) -> EnergyCurve:
        """Return the calibration curve of striker speed against energy.

        Raises:
            ValueError: the two lists differ in length or are not increasing, or the striker would
                have more energy than was charged.
        """
        if len(self.energies) != len(self.speeds):
            raise ValueError(
                f"tapper.energies has {len(self.energies)} values, but tapper.speeds has "
                f"{len(self.speeds)}; give one speed for each energy"
            )
        curve = EnergyCurve(tuple(zip(self.energies, self.speeds, strict=True)))
        for energy, speed in curve.table:
            kinetic = 0.5 * self.mass * speed**2
            if kinetic > MOST_ENERGY * energy:
                raise ValueError(
                    f"at {speed:g} m/s ('tapper.speeds') a striker of {self.mass:g} kg "
                    f"('tapper.mass') has m v^2 / 2 = {1e3 * kinetic:.4g} mJ, more than the "
                    f"charged {1e3 * energy:.4g} mJ ('tapper.energies'); check the units J, m/s "
                    "and kg, and after calibrate tapper the friction in the object file, which is "
                    f"then at least {kinetic / energy:.3g} times too high"
                )
        ratio, energy, speed = max(
            (0.5 * self.mass * speed**2 / energy, energy, speed) for energy, speed in curve.table
        )
        if ratio < LEAST_ENERGY:
            other = max(0.5 * self.mass * e**2 / v if v else 0.0 for e, v in curve.table)
            if LEAST_ENERGY <= other <= MOST_ENERGY:
                raise ValueError(
                    "the lists 'tapper.energies' (J) and 'tapper.speeds' (m/s) seem to be "
                    f"exchanged: otherwise only {100 * ratio:.2g} % of the charged energy would "
                    "become motion"
                )
            raise ValueError(
                f"at {speed:g} m/s ('tapper.speeds') a striker of {self.mass:g} kg "
                f"('tapper.mass') has m v^2 / 2 = {500 * self.mass * speed**2:.4g} mJ, only "
                f"{100 * ratio:.2g} % of the charged {1e3 * energy:.4g} mJ ('tapper.energies'; "
                f"limit {100 * LEAST_ENERGY:g} %); if the energies are in mJ, divide them by "
                f"1000, here {1e-3 * energy:.4g}; otherwise check the units of mass and speeds"
            )
        return curve

    def output_settings(self) -> OutputTapperSettings:
        """Return pulses and latency of the digital output.

        Raises:
            ValueError: the section ``output`` is missing.
        """
        if self.output is None:
            raise ValueError("key 'tapper.output' is missing: the dialect io needs it")
        return OutputTapperSettings(self.energies, self.output.pulses, self.output.latency)

    def check_dialect(self) -> None:
        """Raise ValueError if keys contradict the dialect or each other, or for an unusual baud
        rate."""
        _check_baud("tapper.baud", self.baud)
        if self.dialect == "board":
            if self.output is not None:
                raise ValueError("tapper.output is not used by the dialect board: leave it out")
            if not self.port:
                raise ValueError("key 'tapper.port' is missing: the dialect board needs it")
            return
        if self.port:
            raise ValueError("tapper.port is not used by the dialect io: leave it out")
        if len(self.output_settings().pulses) != len(self.energies):
            raise ValueError(
                f"tapper.output.pulses has {len(self.output_settings().pulses)} values, "
                f"tapper.energies has {len(self.energies)}: give one pulse for each energy"
            )

    def striker(self) -> Striker:
        """Return the striker of the impact model."""
        return Striker(mass=self.mass, tip_radius=self.tip_radius, constraint=self.constraint)


@dataclass(frozen=True, slots=True)
class FixedTapperSection:
    """One tapper at a fixed mount. Settings that are left out are taken from the section `tapper`.

    These settings are `port`, `stroke`, `tip_radius`, `energies` and `speeds`.
    """

    name: str = text("name of the tapper, unique in the cell", longest=40)
    position: tuple[float, float] = quantity(
        "centre of the tip at rest, in the frame table: x, y", "m", -5.0, 5.0
    )
    direction: float = quantity("direction of travel in the frame table", "rad", -7.0, 7.0)
    channel: int = quantity(
        "number of the board's channel to which the tapper is connected",
        "",
        0,
        CHANNELS_PER_BOARD - 1,
        default=0,
    )
    port: str | None = text(
        "serial port of the tapper's board (default: that of tapper.port)", default=None
    )
    stroke: float | None = quantity("maximum travel of the tip", "m", 0.001, 0.5, default=None)
    tip_radius: float | None = quantity(
        "radius of the ball at the tip", "m", 0.0005, 0.1, default=None
    )
    energies: tuple[float, ...] | None = quantity(
        "charged energies at which this tapper's striker speed was measured, increasing "
        "(default: tapper.energies)",
        "J",
        0.0,
        1000.0,
        default=None,
    )
    speeds: tuple[float, ...] | None = quantity(
        "measured striker speed at each of these energies, increasing (default: tapper.speeds)",
        "m/s",
        0.0,
        100.0,
        default=None,
    )


@dataclass(frozen=True, slots=True)
class FixedTappersSection:
    """Tappers at fixed mounts and their working area."""

    working_area: tuple[float, float, float] = quantity(
        "disc that must contain the object's centre: x and y in the frame table, and radius",
        "m",
        -5.0,
        5.0,
    )
    strike_height: float = quantity("height of the tips above the table", "m", 0.001, 0.2)
    tappers: tuple[FixedTapperSection, ...] = section("tappers at fixed mounts")
    calibration: Provenance | None = section(
        "record of the calibration that set position and direction of the tappers", default=None
    )

    def __post_init__(self) -> None:
        """Raise ValueError for a missing or repeated tapper name or an empty working area."""
        names = [tapper.name for tapper in self.tappers]
        if not names:
            raise ValueError("'tappers' is empty; give at least one")
        if "" in names or len(set(names)) < len(names):
            twice = sorted({name for name in names if names.count(name) > 1 or not name})
            raise ValueError(f"each tapper needs a name of its own; empty or repeated: {twice}")
        if self.working_area[2] <= 0.0:
            raise ValueError(
                f"the radius of 'working_area' is {self.working_area[2]:g} m; it must be above 0"
            )


@dataclass(frozen=True, slots=True)
class CameraSection:
    """Accuracy that the planner assumes for a pose measured at rest."""

    position_noise: float = quantity(
        "standard deviation of a measured position along each axis", "m", 0.0, 0.01
    )
    angle_noise: float = quantity("standard deviation of a measured angle", "rad", 0.0, 0.02)


@dataclass(frozen=True, slots=True)
class GoalSection:
    """Planning method, and conditions under which a goal counts as reached or is aborted."""

    position_tolerance: float = quantity(
        "maximum position error at which a goal counts as reached", "m", 0.0001, 0.1
    )
    angle_tolerance: float = quantity(
        "maximum angle error at which a goal counts as reached",
        "rad",
        0.001,
        LARGEST_FILE_ANGLE_TOLERANCE,
    )
    planner: str = text(
        "name of the planning method, such as optimal; docs/planning.md describes the methods"
    )
    max_taps: int = quantity("maximum number of taps for a goal", "", 1, 1000)
    objective: str = choice(
        "quantity to minimise: taps (number of taps) or time (total time, including the motion "
        "of the arm or the flight of the fixed strikers)",
        "taps",
        "time",
        default="taps",
    )


@dataclass(frozen=True, slots=True)
class CellFile:
    """Contents of a cell file."""

    name: str = text("display name of the cell", longest=100)
    reference_markers: str = text("path of the table file, relative to this file")
    camera_info: str = text("path of the camera_info file, relative to this file")
    object: str = text("path of the object file, relative to this file")
    table: TableSection = section("usable area of the table")
    tapper: TapperSection = section(
        "settings of the arm's tapper; in a cell with fixed tappers, default values for all "
        "tappers; each tapper can override some of these values"
    )
    camera: CameraSection = section("accuracy of the camera")
    goal: GoalSection = section("tolerances and limits of a goal, and the planning method")
    arm: ArmSection | None = section("arm that carries the tapper", default=None)
    fixed_tappers: FixedTappersSection | None = section(
        "tappers at fixed mounts, in place of an arm", default=None
    )
    keep_outs: KeepOutSection = section("keep-out zones", default=KeepOutSection())
    objects: tuple[str, ...] = text(
        "paths of the object files of further objects on the table, relative to this file; each "
        "object needs its own name and, if it has a marker, its own marker id",
        default=(),
    )

    def __post_init__(self) -> None:
        """Raise ValueError for a cell with neither arm nor fixed tappers, or with both."""
        if (self.arm is None) == (self.fixed_tappers is None):
            raise ValueError(
                "give either the key 'arm' (an arm that carries the tapper) or the key "
                "'fixed_tappers' (tappers at fixed mounts)"
            )


@dataclass(frozen=True, slots=True)
class Board:
    """A tapper controller: its port and the channels of its tappers by name."""

    port: str
    channels: dict[str, int]


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell file and the files that it names, read and checked."""

    path: Path
    file: CellFile
    object_path: Path
    object: ObjectFile
    references: ReferenceMap
    camera: CameraModel

    @property
    def tolerance(self) -> tuple[float, float]:
        """Tolerance of a goal: m, rad."""
        return self.file.goal.position_tolerance, self.file.goal.angle_tolerance

    @property
    def arm_base(self) -> Pose:
        """Pose of ``arm_base`` in ``table``."""
        return Pose(*self.arm.base)

    @property
    def tapper_names(self) -> tuple[str, ...]:
        """Names of the cell's tappers, as used in command and state messages."""
        fixed = self.file.fixed_tappers
        return (ARM_TAPPER,) if fixed is None else tuple(entry.name for entry in fixed.tappers)

    @property
    def arm(self) -> ArmSection:
        """Section of the arm.

        Raises:
            ConfigurationError: the cell has fixed tappers instead of an arm.
        """
        if self.file.arm is None:
            raise ConfigurationError(
                f"{self.path}: this cell has fixed tappers and no arm, which is needed here; give "
                "a cell file with the key 'arm'"
            )
        return self.file.arm

    @property
    def fixed_tappers(self) -> FixedTappersSection:
        """Section of the fixed tappers.

        Raises:
            ConfigurationError: the cell has an arm instead of fixed tappers.
        """
        if self.file.fixed_tappers is None:
            raise ConfigurationError(
                f"{self.path}: this cell has an arm and no fixed tappers, which are needed here; "
                "give a cell file with the key 'fixed_tappers'"
            )
        return self.file.fixed_tappers

    def tapper_of(self, entry: FixedTapperSection) -> TapperSection:
        """Return all settings of a fixed tapper, including those shared by all fixed tappers."""
        own = {
            name: value
            for name in ("port", "stroke", "tip_radius", "energies", "speeds")
            if (value := getattr(entry, name)) is not None
        }
        return replace(self.file.tapper, **own)

    @property
    def tapper_sections(self) -> dict[str, TapperSection]:
        """Settings of every tapper by name."""
        fixed = self.file.fixed_tappers
        if fixed is None:
            return {ARM_TAPPER: self.file.tapper}
        return {entry.name: self.tapper_of(entry) for entry in fixed.tappers}

    @property
    def boards(self) -> tuple[Board, ...]:
        """The tapper controllers, in the order of the cell file. The tappers of a board are in the
        order of their channels."""
        fixed = self.file.fixed_tappers
        channels = {} if fixed is None else {entry.name: entry.channel for entry in fixed.tappers}
        ports: dict[str, dict[str, int]] = {}
        for name, tapper in self.tapper_sections.items():
            ports.setdefault(tapper.port, {})[name] = channels.get(name, 0)
        return tuple(
            Board(port, dict(sorted(names.items(), key=lambda pair: pair[1])))
            for port, names in ports.items()
        )

    @property
    def tapper_channels(self) -> dict[str, int]:
        """Channel number of every tapper by name. It is unique in the cell, unlike the channel on a
        board."""
        return {
            name: cell_channel(index, channel)
            for index, board in enumerate(self.boards)
            for name, channel in board.channels.items()
        }

    def mounted_tappers(self) -> tuple[MountedTapper, ...]:
        """Return the poses, dimensions and masses of the fixed tappers for their URDF.

        Raises:
            ConfigurationError: the cell has an arm.
        """
        return tuple(
            MountedTapper(
                entry.name,
                Pose(*entry.position, entry.direction),
                self.fixed_tappers.strike_height,
                tapper.stroke,
                tapper.tool_start,
                tapper.tool_length,
                tapper.tool_radius,
                tapper.mass,
                tapper.curve().fastest,
            )
            for entry, tapper in zip(
                self.fixed_tappers.tappers, self.tapper_sections.values(), strict=True
            )
        )

    @property
    def strike_height(self) -> float:
        """Height of the tips above the table during a strike, m."""
        return (self.file.fixed_tappers or self.arm).strike_height

    def outline(self) -> tuple[tuple[float, float], ...]:
        """Return the outline in the object frame: points (x, y) in m, counter-clockwise."""
        return self.object.shape.outline()


def load_cell(path: Path | str | None = None, object_path: Path | str | None = None) -> Cell:
    """Load a cell file, or the package's own cell file if ``path`` is None.

    ``object_path`` replaces the object file that the cell file names.

    Raises:
        ConfigurationError: a file is invalid; the message names file, key, value and range.
    """
    cell_path = Path(path) if path else shared_folder() / "cell.yaml"
    cell_path = cell_path.expanduser().resolve()
    folder = cell_path.parent
    content = _with_urdf_of(load(CellFile, cell_path), folder)
    chosen = Path(object_path) if object_path else folder / content.object
    chosen = chosen.expanduser().resolve()
    try:
        if content.arm is not None:
            content.arm.driver_settings()
            content.arm.controller_needs()
            content.arm.chain()
            content.arm.motion()
        content.tapper.striker()
        content.tapper.curve()
        content.tapper.check_dialect()
        if content.fixed_tappers is not None and content.tapper.dialect == "io":
            raise ValueError(
                "tapper.dialect is io, but fixed tappers are fired by tapper boards; set the "
                "dialect to board"
            )
    except ValueError as error:
        raise ConfigurationError(f"{cell_path}: {error}") from error
    cell = Cell(
        path=cell_path,
        file=content,
        object_path=chosen,
        object=load_object(chosen),
        references=load_reference_map(folder / content.reference_markers),
        camera=load_camera_model(folder / content.camera_info),
    )
    for name, tapper in cell.tapper_sections.items():
        try:
            cell.object.check_impact(tapper.striker())
            tapper.curve()
        except ValueError as error:
            raise ConfigurationError(f"{cell_path}: tapper '{name}': {error}") from error
    return cell


def _with_urdf_of(content: CellFile, folder: Path) -> CellFile:
    """Return the cell file with the full path of its URDF, if it names one."""
    own = None if content.arm is None else content.arm.ros2_control
    if content.arm is None or own is None or own.chain is None:
        return content
    chain = replace(own.chain, urdf=str(folder / own.chain.urdf))
    return replace(content, arm=replace(content.arm, ros2_control=replace(own, chain=chain)))


def has_simulated_ports(cell: Cell) -> bool:
    """Return whether the arm or a tapper has a port that the simulated world creates."""
    return bool(_simulated_ports(cell))


def refuse_simulated_ports(cell: Cell) -> None:
    """Check that a cell file describes real devices, before it is used with hardware.

    Raises:
        ConfigurationError: a port belongs to the simulated cell, as in the package's own file.
    """
    for key, port in _simulated_ports(cell).items():
        raise ConfigurationError(
            f"{cell.path}: key '{key}' is {port}, a port of the simulated cell, but hardware "
            "was requested: copy the folder config, set the device there (such as "
            "/dev/serial/by-id/...), and give the copy as the cell file"
        )


def refuse_own_drivers(cell: Cell) -> None:
    """Check that a cell file commands no real device, before a simulated cell is started from it.

    Raises:
        ConfigurationError: the arm has a ROS driver of its own, or an output fires the tapper.
            Neither can be simulated.
    """
    output = cell.file.tapper.output
    if output is not None:
        raise ConfigurationError(
            f"{cell.path}: key 'tapper.dialect' is io: a simulated cell started from this file "
            f"would switch the output {output.name}; use 'up --hardware', or give a cell file "
            "with the tapper's board"
        )
    if cell.file.arm is not None and cell.arm.ros2_control is not None:
        raise ConfigurationError(
            f"{cell.path}: key 'arm.dialect' is ros2_control: a simulated cell started from this "
            f"file would move the arm of {cell.arm.ros2_control.controller}; use "
            "'up --hardware', or give a cell file with a serial arm"
        )


def _simulated_ports(cell: Cell) -> dict[str, str]:
    ports = {} if cell.file.arm is None else {"arm.port": cell.file.arm.port}
    ports |= {f"{name}.port": tapper.port for name, tapper in cell.tapper_sections.items()}
    return {
        key: port
        for key, port in ports.items()
        if "{cell}" in port or "/.ros/tapping_cell/" in str(Path(port).expanduser())
    }


def load_further_objects(cell: Cell, paths: str = "") -> tuple[ObjectFile, ...]:
    """Load the objects on a cell's table, except the cell's main object.

    The objects of the key ``objects`` come first, followed by those of ``paths``, the
    comma-separated parameter ``other_object_files``.

    Raises:
        ConfigurationError: a file is invalid, two objects share a name or a marker, or the arm
            cannot travel above an object.
    """
    named = [path.strip() for path in paths.split(",") if path.strip()]
    places = [cell.path.parent / Path(path).expanduser() for path in cell.file.objects]
    places += [Path(path).expanduser() for path in named]
    files = tuple(load_object(place.resolve()) for place in places)
    source = "parameter other_object_files" if named else f"{cell.path}: key 'objects'"
    names = [file.name for file in (cell.object, *files)]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigurationError(
            f"{source}: two objects have the name '{twice[0]}'; give each a name of its own"
        )
    try:
        marker_ids([file.seen() for file in (cell.object, *files)])
    except ValueError as error:
        raise ConfigurationError(f"{source}: {error}") from error
    if cell.file.arm is None:
        return files
    travel = cell.file.arm.travel_height
    for file in files:
        if file.height >= travel:
            raise ConfigurationError(
                f"{source}: '{file.name}' is {1e3 * file.height:.1f} mm high, "
                f"but the tip travels at {1e3 * travel:.1f} mm (key 'arm.travel_height' of "
                f"{cell.path}) and would hit it; increase this value or remove the object"
            )
    return files


def cells_of(cell: Cell) -> dict[str, Cell]:
    """Return one copy of the cell for each object, by the name of the object. In each copy, this
    object is the cell's main object.

    Raises:
        ConfigurationError: an object file is invalid; see ``load_further_objects``.
    """
    return {
        own.name: replace(cell, object=own) for own in (cell.object, *load_further_objects(cell))
    }
