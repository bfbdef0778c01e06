"""The cell's messages as dataclasses that need no ROS; generated, not edited.

``python environment/generate_messages.py`` writes this file from the installed message packages.
``ROS_TYPE`` names the message that a class mirrors; ``nodes/message_conversion.py`` converts.
Units and meanings are documented in ``msg_defs``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar


@dataclass(slots=True, kw_only=True)
class Duration:
    """Mirror of ``builtin_interfaces/msg/Duration``."""

    ROS_TYPE: ClassVar[str] = "builtin_interfaces/msg/Duration"

    sec: int = 0
    nanosec: int = 0


@dataclass(slots=True, kw_only=True)
class Time:
    """Mirror of ``builtin_interfaces/msg/Time``."""

    ROS_TYPE: ClassVar[str] = "builtin_interfaces/msg/Time"

    sec: int = 0
    nanosec: int = 0


@dataclass(slots=True, kw_only=True)
class Header:
    """Mirror of ``std_msgs/msg/Header``."""

    ROS_TYPE: ClassVar[str] = "std_msgs/msg/Header"

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass(slots=True, kw_only=True)
class Point:
    """Mirror of ``geometry_msgs/msg/Point``."""

    ROS_TYPE: ClassVar[str] = "geometry_msgs/msg/Point"

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(slots=True, kw_only=True)
class Quaternion:
    """Mirror of ``geometry_msgs/msg/Quaternion``."""

    ROS_TYPE: ClassVar[str] = "geometry_msgs/msg/Quaternion"

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass(slots=True, kw_only=True)
class Pose:
    """Mirror of ``geometry_msgs/msg/Pose``."""

    ROS_TYPE: ClassVar[str] = "geometry_msgs/msg/Pose"

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass(slots=True, kw_only=True)
class PoseStamped:
    """Mirror of ``geometry_msgs/msg/PoseStamped``."""

    ROS_TYPE: ClassVar[str] = "geometry_msgs/msg/PoseStamped"

    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@dataclass(slots=True, kw_only=True)
class PoseWithCovariance:
    """Mirror of ``geometry_msgs/msg/PoseWithCovariance``."""

    ROS_TYPE: ClassVar[str] = "geometry_msgs/msg/PoseWithCovariance"

    pose: Pose = field(default_factory=Pose)
    covariance: list[float] = field(default_factory=lambda: [0.0] * 36)


@dataclass(slots=True, kw_only=True)
class PoseWithCovarianceStamped:
    """Mirror of ``geometry_msgs/msg/PoseWithCovarianceStamped``."""

    ROS_TYPE: ClassVar[str] = "geometry_msgs/msg/PoseWithCovarianceStamped"

    header: Header = field(default_factory=Header)
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)


@dataclass(slots=True, kw_only=True)
class JointState:
    """Mirror of ``sensor_msgs/msg/JointState``."""

    ROS_TYPE: ClassVar[str] = "sensor_msgs/msg/JointState"

    header: Header = field(default_factory=Header)
    name: list[str] = field(default_factory=list)
    position: list[float] = field(default_factory=list)
    velocity: list[float] = field(default_factory=list)
    effort: list[float] = field(default_factory=list)


@dataclass(slots=True, kw_only=True)
class Bool:
    """Mirror of ``std_msgs/msg/Bool``."""

    ROS_TYPE: ClassVar[str] = "std_msgs/msg/Bool"

    data: bool = False


class SetBool:
    """Mirror of ``std_srvs/srv/SetBool``."""

    ROS_TYPE: ClassVar[str] = "std_srvs/srv/SetBool"

    @dataclass(slots=True, kw_only=True)
    class Request:
        """Mirror of ``std_srvs/srv/SetBool.Request``."""

        ROS_TYPE: ClassVar[str] = "std_srvs/srv/SetBool.Request"

        data: bool = False

    @dataclass(slots=True, kw_only=True)
    class Response:
        """Mirror of ``std_srvs/srv/SetBool.Response``."""

        ROS_TYPE: ClassVar[str] = "std_srvs/srv/SetBool.Response"

        success: bool = False
        message: str = ""


class Trigger:
    """Mirror of ``std_srvs/srv/Trigger``."""

    ROS_TYPE: ClassVar[str] = "std_srvs/srv/Trigger"

    @dataclass(slots=True, kw_only=True)
    class Request:
        """Mirror of ``std_srvs/srv/Trigger.Request``."""

        ROS_TYPE: ClassVar[str] = "std_srvs/srv/Trigger.Request"

    @dataclass(slots=True, kw_only=True)
    class Response:
        """Mirror of ``std_srvs/srv/Trigger.Response``."""

        ROS_TYPE: ClassVar[str] = "std_srvs/srv/Trigger.Response"

        success: bool = False
        message: str = ""


@dataclass(slots=True, kw_only=True)
class JointTrajectoryPoint:
    """Mirror of ``trajectory_msgs/msg/JointTrajectoryPoint``."""

    ROS_TYPE: ClassVar[str] = "trajectory_msgs/msg/JointTrajectoryPoint"

    positions: list[float] = field(default_factory=list)
    velocities: list[float] = field(default_factory=list)
    accelerations: list[float] = field(default_factory=list)
    effort: list[float] = field(default_factory=list)
    time_from_start: Duration = field(default_factory=Duration)


@dataclass(slots=True, kw_only=True)
class JointTrajectory:
    """Mirror of ``trajectory_msgs/msg/JointTrajectory``."""

    ROS_TYPE: ClassVar[str] = "trajectory_msgs/msg/JointTrajectory"

    header: Header = field(default_factory=Header)
    joint_names: list[str] = field(default_factory=list)
    points: list[JointTrajectoryPoint] = field(default_factory=list)


@dataclass(slots=True, kw_only=True)
class ArmState:
    """Mirror of ``tapping_cell_msgs/msg/ArmState``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/ArmState"
    DISCONNECTED: ClassVar[int] = 0
    FAULT: ClassVar[int] = 7
    HOMING: ClassVar[int] = 2
    IDLE: ClassVar[int] = 3
    IN_POSITION: ClassVar[int] = 5
    MOVING: ClassVar[int] = 4
    NOT_HOMED: ClassVar[int] = 1
    STOPPED: ClassVar[int] = 8
    WITHDRAWING: ClassVar[int] = 6

    header: Header = field(default_factory=Header)
    state: int = 0
    tap_id: int = 0
    homed: bool = False
    clear_of_camera: bool = False
    set_up: bool = False
    enabled: bool = False
    last_stop: Time = field(default_factory=Time)
    tip_pose: Pose = field(default_factory=Pose)
    error_code: int = 0
    error_msg: str = ""


@dataclass(slots=True, kw_only=True)
class ObjectProgress:
    """Mirror of ``tapping_cell_msgs/msg/ObjectProgress``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/ObjectProgress"
    ACTIVE: ClassVar[int] = 1
    FAILED: ClassVar[int] = 4
    MAKING_WAY: ClassVar[int] = 2
    REACHED: ClassVar[int] = 3
    WAITING: ClassVar[int] = 0

    object_id: str = ""
    state: int = 0
    has_goal: bool = False
    goal_pose: Pose = field(default_factory=Pose)
    position_tolerance: float = 0.0
    angle_tolerance: float = 0.0
    residual_distance: float = 0.0
    residual_rotation: float = 0.0
    taps: int = 0
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    error_code: int = 0
    error_msg: str = ""


@dataclass(slots=True, kw_only=True)
class ArrangementState:
    """Mirror of ``tapping_cell_msgs/msg/ArrangementState``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/ArrangementState"

    header: Header = field(default_factory=Header)
    active: bool = False
    objects: list[ObjectProgress] = field(default_factory=list)
    taps: int = 0
    error_code: int = 0
    error_msg: str = ""


@dataclass(slots=True, kw_only=True)
class ErrorCode:
    """Mirror of ``tapping_cell_msgs/msg/ErrorCode``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/ErrorCode"
    ARM_ALARM: ClassVar[int] = 503
    ARM_BUSY: ClassVar[int] = 512
    ARM_COMMAND_EXPIRED: ClassVar[int] = 514
    ARM_FIRMWARE_UNKNOWN: ClassVar[int] = 510
    ARM_JOINT_LIMIT: ClassVar[int] = 506
    ARM_NOT_CONNECTED: ClassVar[int] = 501
    ARM_NOT_HOMED: ClassVar[int] = 502
    ARM_OUT_OF_REACH: ClassVar[int] = 505
    ARM_POSITION_MISMATCH: ClassVar[int] = 507
    ARM_REPLY_GARBLED: ClassVar[int] = 511
    ARM_SILENT: ClassVar[int] = 509
    ARM_STOPPED: ClassVar[int] = 508
    ARM_TIMEOUT: ClassVar[int] = 504
    CAMERA_MOVED: ClassVar[int] = 306
    CAMERA_NOT_CALIBRATED: ClassVar[int] = 308
    CAMERA_SILENT: ClassVar[int] = 303
    CLOCKS_DIFFER: ClassVar[int] = 909
    COMMAND_INVALID: ClassVar[int] = 122
    COMMAND_REPEATED: ClassVar[int] = 123
    CONFIGURATION_CONFLICT: ClassVar[int] = 205
    DEADLINE_EXCEEDED: ClassVar[int] = 408
    EMERGENCY_STOP: ClassVar[int] = 901
    ENABLING_RELEASED: ClassVar[int] = 910
    GOALS_OVERLAP: ClassVar[int] = 115
    GOAL_BAD_ORIENTATION: ClassVar[int] = 109
    GOAL_BAD_TAP_LIMIT: ClassVar[int] = 112
    GOAL_BAD_TOLERANCE: ClassVar[int] = 107
    GOAL_CANCELED: ClassVar[int] = 111
    GOAL_IN_KEEP_OUT: ClassVar[int] = 105
    GOAL_NOT_FINITE: ClassVar[int] = 101
    GOAL_NOT_PLANAR: ClassVar[int] = 108
    GOAL_OFF_TABLE: ClassVar[int] = 103
    GOAL_OUTSIDE_WORKING_AREA: ClassVar[int] = 113
    GOAL_OUT_OF_REACH: ClassVar[int] = 104
    GOAL_REPLACED: ClassVar[int] = 110
    GOAL_STALE: ClassVar[int] = 106
    GOAL_UNKNOWN_OBJECT: ClassVar[int] = 114
    GOAL_WRONG_FRAME: ClassVar[int] = 102
    IMAGE_INVALID: ClassVar[int] = 307
    INTERNAL: ClassVar[int] = 904
    MARKER_AMBIGUOUS: ClassVar[int] = 309
    NONE: ClassVar[int] = 0
    NOT_ACTIVE: ClassVar[int] = 903
    NOT_IN_SET_UP: ClassVar[int] = 912
    NOT_READY: ClassVar[int] = 902
    NO_ARRANGEMENT: ClassVar[int] = 412
    NO_CONTACT_FOUND: ClassVar[int] = 406
    NO_TAP_FOUND: ClassVar[int] = 401
    OBJECT_MOVED: ClassVar[int] = 311
    OBJECT_NOT_AT_REST: ClassVar[int] = 305
    OBJECT_NOT_SEEN: ClassVar[int] = 301
    OBJECT_OFF_TABLE: ClassVar[int] = 312
    OTHER_VERSION: ClassVar[int] = 911
    PLANNER_BUSY: ClassVar[int] = 409
    PLANNER_UNKNOWN: ClassVar[int] = 404
    PROBE_NEEDED: ClassVar[int] = 405
    RECORDING_FAILED: ClassVar[int] = 908
    REFERENCES_NOT_SEEN: ClassVar[int] = 302
    SHUTTING_DOWN: ClassVar[int] = 906
    STAMP_INVALID: ClassVar[int] = 313
    TAPPER_ARM_NOT_IN_POSITION: ClassVar[int] = 614
    TAPPER_BUSY: ClassVar[int] = 615
    TAPPER_COMMAND_EXPIRED: ClassVar[int] = 610
    TAPPER_FAULT: ClassVar[int] = 611
    TAPPER_FIRMWARE_UNKNOWN: ClassVar[int] = 612
    TAPPER_INTERLOCK_OPEN: ClassVar[int] = 602
    TAPPER_MOUNT_NOT_PROVEN: ClassVar[int] = 618
    TAPPER_NOT_CONNECTED: ClassVar[int] = 601
    TAPPER_OTHER_ACTIVE: ClassVar[int] = 619
    TAPPER_OUTCOME_UNKNOWN: ClassVar[int] = 607
    TAPPER_REPLY_GARBLED: ClassVar[int] = 613
    TAPPER_RESET: ClassVar[int] = 609
    TAPPER_SILENT: ClassVar[int] = 608
    TAPPER_SPEED_OUT_OF_RANGE: ClassVar[int] = 606
    TAPPER_SPENT: ClassVar[int] = 605
    TAPPER_STOPPED: ClassVar[int] = 603
    TAPPER_STRIKER_AWAY: ClassVar[int] = 617
    TAPPER_TIMEOUT: ClassVar[int] = 604
    TAPPER_UNKNOWN: ClassVar[int] = 616
    TAP_LEAVES_TABLE: ClassVar[int] = 410
    TAP_LEAVES_VIEW: ClassVar[int] = 411
    TAP_LIMIT_REACHED: ClassVar[int] = 402
    TAP_NOT_AWAITED: ClassVar[int] = 414
    TAP_NOT_CONFIRMED: ClassVar[int] = 413
    TAP_WITHOUT_EFFECT: ClassVar[int] = 403
    TAP_WITHOUT_ROTATION: ClassVar[int] = 407
    TOO_FEW_FRAMES: ClassVar[int] = 314
    TRAJECTORY_INVALID: ClassVar[int] = 121


@dataclass(slots=True, kw_only=True)
class SlideTrack:
    """Mirror of ``tapping_cell_msgs/msg/SlideTrack``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/SlideTrack"

    poses: int = 0
    speed: float = 0.0
    speed_deviation: float = 0.0
    spin: float = 0.0
    spin_deviation: float = 0.0
    deceleration: float = 0.0
    deceleration_deviation: float = 0.0
    model_speed: float = 0.0
    model_spin: float = 0.0
    model_deceleration: float = 0.0


@dataclass(slots=True, kw_only=True)
class LearntGains:
    """Mirror of ``tapping_cell_msgs/msg/LearntGains``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/LearntGains"

    distance: float = 0.0
    distance_deviation: float = 0.0
    rotation: float = 0.0
    rotation_deviation: float = 0.0
    direction: float = 0.0
    direction_deviation: float = 0.0
    direction_growth: float = 0.0
    direction_growth_deviation: float = 0.0
    offset_x: float = 0.0
    offset_x_deviation: float = 0.0
    offset_y: float = 0.0
    offset_y_deviation: float = 0.0
    impact_distance: float = 0.0
    impact_distance_deviation: float = 0.0
    slide_distance: float = 0.0
    slide_distance_deviation: float = 0.0
    impact_rotation: float = 0.0
    impact_rotation_deviation: float = 0.0
    slide_rotation: float = 0.0
    slide_rotation_deviation: float = 0.0
    impact_offset_x: float = 0.0
    impact_offset_x_deviation: float = 0.0
    slide_offset_x: float = 0.0
    slide_offset_x_deviation: float = 0.0
    impact_offset_y: float = 0.0
    impact_offset_y_deviation: float = 0.0
    slide_offset_y: float = 0.0
    slide_offset_y_deviation: float = 0.0
    explained: int = 0
    unexplained: int = 0


@dataclass(slots=True, kw_only=True)
class TapRecord:
    """Mirror of ``tapping_cell_msgs/msg/TapRecord``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/TapRecord"

    tap_id: int = 0
    tapper: str = ""
    object_id: str = ""
    number: int = 0
    planner: str = ""
    object_pose: Pose = field(default_factory=Pose)
    dx: float = 0.0
    dy: float = 0.0
    dtheta: float = 0.0
    predicted_pose: Pose = field(default_factory=Pose)
    predicted_covariance: list[float] = field(default_factory=lambda: [0.0] * 9)
    reason: str = ""
    expected_taps: float = 0.0
    expected_seconds: float = 0.0
    measured_pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    striker_speed: float = 0.0
    measured_speed: float = 0.0
    contact_angle: float = 0.0
    strike_pose: Pose = field(default_factory=Pose)
    fired_at: Time = field(default_factory=Time)
    at_rest_at: Time = field(default_factory=Time)
    outcome: int = 0
    track: SlideTrack = field(default_factory=SlideTrack)
    learnt: LearntGains = field(default_factory=LearntGains)


@dataclass(slots=True, kw_only=True)
class GoalReport:
    """Mirror of ``tapping_cell_msgs/msg/GoalReport``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/GoalReport"

    header: Header = field(default_factory=Header)
    refused: bool = False
    state: int = 0
    object_id: str = ""
    goal: PoseStamped = field(default_factory=PoseStamped)
    position_tolerance: float = 0.0
    angle_tolerance: float = 0.0
    planner: str = ""
    taps: int = 0
    records: list[TapRecord] = field(default_factory=list)
    residual_distance: float = 0.0
    residual_rotation: float = 0.0
    error_code: int = 0
    error_msg: str = ""


@dataclass(slots=True, kw_only=True)
class ObjectContact:
    """Mirror of ``tapping_cell_msgs/msg/ObjectContact``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/ObjectContact"

    header: Header = field(default_factory=Header)
    object_id: str = ""
    other_id: str = ""
    position: Point = field(default_factory=Point)
    closing_speed: float = 0.0


@dataclass(slots=True, kw_only=True)
class ObjectGoal:
    """Mirror of ``tapping_cell_msgs/msg/ObjectGoal``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/ObjectGoal"

    object_id: str = ""
    goal_pose: PoseStamped = field(default_factory=PoseStamped)
    position_tolerance: float = 0.0
    angle_tolerance: float = 0.0


@dataclass(slots=True, kw_only=True)
class Vector3:
    """Mirror of ``geometry_msgs/msg/Vector3``."""

    ROS_TYPE: ClassVar[str] = "geometry_msgs/msg/Vector3"

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(slots=True, kw_only=True)
class Twist:
    """Mirror of ``geometry_msgs/msg/Twist``."""

    ROS_TYPE: ClassVar[str] = "geometry_msgs/msg/Twist"

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass(slots=True, kw_only=True)
class ObjectState:
    """Mirror of ``tapping_cell_msgs/msg/ObjectState``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/ObjectState"

    header: Header = field(default_factory=Header)
    object_id: str = ""
    visible: bool = False
    hidden_by_arm: bool = False
    at_rest: bool = False
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    velocity: Twist = field(default_factory=Twist)
    frames_fused: int = 0
    at_rest_since: Time = field(default_factory=Time)
    references_used: list[int] = field(default_factory=list)
    error_code: int = 0
    error_msg: str = ""


@dataclass(slots=True, kw_only=True)
class ObjectStates:
    """Mirror of ``tapping_cell_msgs/msg/ObjectStates``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/ObjectStates"

    header: Header = field(default_factory=Header)
    objects: list[ObjectState] = field(default_factory=list)
    searches_unknown_objects: bool = False


@dataclass(slots=True, kw_only=True)
class PlannedTap:
    """Mirror of ``tapping_cell_msgs/msg/PlannedTap``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/PlannedTap"

    tap_id: int = 0
    object_id: str = ""
    number: int = 0
    object_pose: Pose = field(default_factory=Pose)
    strike_pose: Pose = field(default_factory=Pose)
    striker_speed: float = 0.0
    predicted_pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    reason: str = ""
    expected_taps: float = 0.0
    expected_seconds: float = 0.0
    answer_by: Time = field(default_factory=Time)


@dataclass(slots=True, kw_only=True)
class PlanState:
    """Mirror of ``tapping_cell_msgs/msg/PlanState``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/PlanState"
    CANCELED: ClassVar[int] = 9
    CONFIRMING: ClassVar[int] = 10
    FAILED: ClassVar[int] = 8
    FIRING: ClassVar[int] = 5
    IDLE: ClassVar[int] = 0
    LOOKING: ClassVar[int] = 2
    PLACING: ClassVar[int] = 4
    PLANNING: ClassVar[int] = 3
    REACHED: ClassVar[int] = 7
    SETTLING: ClassVar[int] = 6
    WAITING_FOR_CELL: ClassVar[int] = 1

    header: Header = field(default_factory=Header)
    state: int = 0
    object_id: str = ""
    planner: str = ""
    goal: PoseStamped = field(default_factory=PoseStamped)
    residual_distance: float = 0.0
    residual_rotation: float = 0.0
    position_tolerance: float = 0.0
    angle_tolerance: float = 0.0
    taps: int = 0
    last_tap: TapRecord = field(default_factory=TapRecord)
    planned_tap: PlannedTap = field(default_factory=PlannedTap)
    ask: bool = False
    learnt: LearntGains = field(default_factory=LearntGains)
    error_code: int = 0
    error_msg: str = ""


@dataclass(slots=True, kw_only=True)
class StopState:
    """Mirror of ``tapping_cell_msgs/msg/StopState``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/StopState"

    header: Header = field(default_factory=Header)
    stopped: bool = False
    sources: list[str] = field(default_factory=list)
    error_msg: str = ""


@dataclass(slots=True, kw_only=True)
class TapCommand:
    """Mirror of ``tapping_cell_msgs/msg/TapCommand``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/TapCommand"
    CLEAR_VIEW: ClassVar[int] = 2
    TAP: ClassVar[int] = 0
    WITHDRAW: ClassVar[int] = 1

    header: Header = field(default_factory=Header)
    request: int = 0
    tap_id: int = 0
    tapper: str = ""
    strike_pose: Pose = field(default_factory=Pose)
    striker_speed: float = 0.0
    object_id: str = ""
    expiry: Time = field(default_factory=Time)
    object_pose: Pose = field(default_factory=Pose)
    predicted_pose: Pose = field(default_factory=Pose)


@dataclass(slots=True, kw_only=True)
class TapperState:
    """Mirror of ``tapping_cell_msgs/msg/TapperState``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/TapperState"
    CHARGED: ClassVar[int] = 3
    CHARGING: ClassVar[int] = 2
    DISCONNECTED: ClassVar[int] = 0
    FAULT: ClassVar[int] = 5
    FIRED: ClassVar[int] = 1
    FIRING: ClassVar[int] = 4
    NONE: ClassVar[int] = 0
    NOT_FIRED: ClassVar[int] = 2
    SAFE: ClassVar[int] = 1
    STOPPED: ClassVar[int] = 6
    UNKNOWN: ClassVar[int] = 3

    header: Header = field(default_factory=Header)
    state: int = 0
    tappers: list[str] = field(default_factory=list)
    tapper: str = ""
    tap_id: int = 0
    outcome: int = 0
    measured_speed: float = 0.0
    shots_fired: int = 0
    boot_number: int = 0
    fixed_mounts: bool = False
    away: list[str] = field(default_factory=list)
    mounts_proven: bool = False
    interlock_closed: bool = False
    set_up: bool = False
    enabling_switch: bool = False
    last_stop: Time = field(default_factory=Time)
    error_code: int = 0
    error_msg: str = ""


@dataclass(slots=True, kw_only=True)
class Point32:
    """Mirror of ``geometry_msgs/msg/Point32``."""

    ROS_TYPE: ClassVar[str] = "geometry_msgs/msg/Point32"

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(slots=True, kw_only=True)
class Polygon:
    """Mirror of ``geometry_msgs/msg/Polygon``."""

    ROS_TYPE: ClassVar[str] = "geometry_msgs/msg/Polygon"

    points: list[Point32] = field(default_factory=list)


@dataclass(slots=True, kw_only=True)
class UnknownObjects:
    """Mirror of ``tapping_cell_msgs/msg/UnknownObjects``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/msg/UnknownObjects"

    header: Header = field(default_factory=Header)
    outlines: list[Polygon] = field(default_factory=list)


class ConfirmTap:
    """Mirror of ``tapping_cell_msgs/srv/ConfirmTap``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/srv/ConfirmTap"

    @dataclass(slots=True, kw_only=True)
    class Request:
        """Mirror of ``tapping_cell_msgs/srv/ConfirmTap.Request``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/srv/ConfirmTap.Request"

        tap_id: int = 0
        confirm: bool = False

    @dataclass(slots=True, kw_only=True)
    class Response:
        """Mirror of ``tapping_cell_msgs/srv/ConfirmTap.Response``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/srv/ConfirmTap.Response"

        accepted: bool = False
        error_code: int = 0
        error_msg: str = ""


class HoldStill:
    """Mirror of ``tapping_cell_msgs/srv/HoldStill``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/srv/HoldStill"

    @dataclass(slots=True, kw_only=True)
    class Request:
        """Mirror of ``tapping_cell_msgs/srv/HoldStill.Request``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/srv/HoldStill.Request"

        tap_id: int = 0
        duration: float = 0.0

    @dataclass(slots=True, kw_only=True)
    class Response:
        """Mirror of ``tapping_cell_msgs/srv/HoldStill.Response``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/srv/HoldStill.Response"

        granted: bool = False
        duration: float = 0.0
        error_code: int = 0
        error_msg: str = ""


class Jog:
    """Mirror of ``tapping_cell_msgs/srv/Jog``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/srv/Jog"

    @dataclass(slots=True, kw_only=True)
    class Request:
        """Mirror of ``tapping_cell_msgs/srv/Jog.Request``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/srv/Jog.Request"
        JOINTS: ClassVar[int] = 0
        PARK: ClassVar[int] = 2
        TIP: ClassVar[int] = 1

        kind: int = 0
        step: list[float] = field(default_factory=lambda: [0.0] * 4)

    @dataclass(slots=True, kw_only=True)
    class Response:
        """Mirror of ``tapping_cell_msgs/srv/Jog.Response``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/srv/Jog.Response"

        accepted: bool = False
        error_code: int = 0
        error_msg: str = ""


class ArrangeObjects:
    """Mirror of ``tapping_cell_msgs/action/ArrangeObjects``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/ArrangeObjects"

    @dataclass(slots=True, kw_only=True)
    class Goal:
        """Mirror of ``tapping_cell_msgs/action/ArrangeObjects.Goal``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/ArrangeObjects.Goal"

        goals: list[ObjectGoal] = field(default_factory=list)
        in_order: bool = False
        may_move: list[str] = field(default_factory=list)
        max_taps: int = 0
        time_limit: float = 0.0

    @dataclass(slots=True, kw_only=True)
    class Result:
        """Mirror of ``tapping_cell_msgs/action/ArrangeObjects.Result``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/ArrangeObjects.Result"

        error_code: int = 0
        error_msg: str = ""
        objects: list[ObjectProgress] = field(default_factory=list)
        taps: int = 0
        records: list[TapRecord] = field(default_factory=list)

    @dataclass(slots=True, kw_only=True)
    class Feedback:
        """Mirror of ``tapping_cell_msgs/action/ArrangeObjects.Feedback``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/ArrangeObjects.Feedback"

        object_id: str = ""
        state: int = 0
        taps: int = 0
        residual_distance: float = 0.0
        residual_rotation: float = 0.0


class PositionObject:
    """Mirror of ``tapping_cell_msgs/action/PositionObject``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/PositionObject"

    @dataclass(slots=True, kw_only=True)
    class Goal:
        """Mirror of ``tapping_cell_msgs/action/PositionObject.Goal``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/PositionObject.Goal"

        object_id: str = ""
        goal_pose: PoseStamped = field(default_factory=PoseStamped)
        position_tolerance: float = 0.0
        angle_tolerance: float = 0.0
        max_taps: int = 0
        probe: bool = False
        ask: bool = False
        time_limit: float = 0.0

    @dataclass(slots=True, kw_only=True)
    class Result:
        """Mirror of ``tapping_cell_msgs/action/PositionObject.Result``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/PositionObject.Result"

        error_code: int = 0
        error_msg: str = ""
        final_pose: PoseWithCovarianceStamped = field(default_factory=PoseWithCovarianceStamped)
        residual_distance: float = 0.0
        residual_rotation: float = 0.0
        taps: int = 0
        records: list[TapRecord] = field(default_factory=list)

    @dataclass(slots=True, kw_only=True)
    class Feedback:
        """Mirror of ``tapping_cell_msgs/action/PositionObject.Feedback``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/PositionObject.Feedback"

        state: int = 0
        taps: int = 0
        residual_distance: float = 0.0
        residual_rotation: float = 0.0


class SingleTap:
    """Mirror of ``tapping_cell_msgs/action/SingleTap``."""

    ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/SingleTap"

    @dataclass(slots=True, kw_only=True)
    class Goal:
        """Mirror of ``tapping_cell_msgs/action/SingleTap.Goal``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/SingleTap.Goal"

        striker_speed: float = 0.0
        tapper: str = ""
        incidence: float = 0.0
        direction: float = 0.0
        slack: float = 0.0
        at_nothing: bool = False

    @dataclass(slots=True, kw_only=True)
    class Result:
        """Mirror of ``tapping_cell_msgs/action/SingleTap.Result``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/SingleTap.Result"

        error_code: int = 0
        error_msg: str = ""
        record: TapRecord = field(default_factory=TapRecord)

    @dataclass(slots=True, kw_only=True)
    class Feedback:
        """Mirror of ``tapping_cell_msgs/action/SingleTap.Feedback``."""

        ROS_TYPE: ClassVar[str] = "tapping_cell_msgs/action/SingleTap.Feedback"

        state: int = 0
