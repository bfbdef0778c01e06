"""Safety invariants, checked against the ground truth after every event of a run."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from tapping_cell.hardware.axis_units import joints_text
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic.clock import to_nanoseconds, to_seconds
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import (
    ArmState,
    ConfirmTap,
    ErrorCode,
    HoldStill,
    ObjectState,
    PlanState,
    PositionObject,
    StopState,
    TapCommand,
    TapperState,
    Time,
)
from tapping_cell.se2 import Pose
from tapping_cell.verification.arm_invariants import ArmChecker
from tapping_cell.verification.board_invariants import BoardChecker
from tapping_cell.verification.command_invariants import CommandChecker
from tapping_cell.verification.confirmation_invariants import ConfirmationChecker
from tapping_cell.verification.host import HostClock
from tapping_cell.verification.peer_invariants import CAMERA, PeerChecker
from tapping_cell.verification.physical_cell import PhysicalCell, Release
from tapping_cell.verification.scheduler import Scheduler
from tapping_cell.verification.set_up_invariants import SetUpChecker

_ARM_STATES = {
    value: name for name, value in vars(ArmState).items() if name.isupper() and name != "ROS_TYPE"
}
_OUTCOMES = {
    TapperState.NONE: "NONE",
    TapperState.FIRED: "FIRED",
    TapperState.NOT_FIRED: "NOT_FIRED",
    TapperState.UNKNOWN: "UNKNOWN",
}

# The limits are written here and not imported from ``logic``, so that a wrong limit in the product
# is detected.
SKEW_LIMIT_S, CLOCK_TOLERANCE_S = 0.5, 1.0
"""Differences between two computers' clocks beyond which a state (first) or a command (second) has
an invalid stamp, s."""
WINDOW_S = 0.1
"""Maximum time from an event that forbids releases to a release that may still follow, s. The
command FIRE may already have been sent at the event, so this maximum is the board's longest firing
window."""
STRIKE_POSITION_M = 0.0025
STRIKE_ANGLE_RAD = 0.01
"""Maximum deviations of the tip's true pose from its commanded pose at a release, m and rad. They
allow for the errors of the arm."""
ENERGY_SHARE = 0.03
"""Maximum relative deviation of the energy of a release from the requested energy."""
STRIKE_HEIGHT_M = 0.0005
MOVED_M, MOVED_RAD = 0.002, math.radians(3.0)
"""Maximum distance and rotation of the object from the pose for which a tap is planned, when the
planner commands the tap."""
BUMP_M = 0.004
BUMP_RAD = math.radians(6.0)
"""Displacements of the object (m and rad) beyond which a planned tap must not be fired."""
LONGEST_WAY = 1.3
"""Multiple of the predicted displacement of a tapped object up to which the withdrawn arm must not
hide it."""
REPORTED_S = 0.5
"""Maximum time from when a device has latched a stop until it reports that it is stopped, s."""
CHARGED_LIMIT_S = 12.0
"""Maximum time that a striker may stay charged, regardless of any failure of the computers."""
READY_S = 6.0
"""Maximum time for which the tapper keeps the striker charged completely, s: 3 s until the arm is
in position and five requests to stand still."""
CHECK_S = 0.045
"""Maximum time from the last check before FIRE to the release, s. The board's deadline for the shot
limits this time."""
PULSE_S = 0.02
"""Duration of the release pulse, s. The arm's promise to stand still covers the pulse and the
striker's flight."""
HEARTBEAT_S = 0.45
"""Maximum time from the camera's last message to a release, s. The same maximum applies to the
planner's last message if the planner has reported that it waits for this tap. The checks add
``WINDOW_S`` to ``HEARTBEAT_S`` and to ``SILENCE_S``."""
SILENCE_S = 1.5
"""Maximum time from the planner's last message to a release if the planner has not yet reported
that it waits for its tap, s."""
ORPHAN_S = 1.5
"""Maximum time from the end of the planner's process to a release, s. After this time the planner's
heartbeat has timed out."""
HOMED_S = 3.0
"""Maximum time for which the arm may still be reported as homed after it has lost its reference, s.
This maximum allows for bytes that arrive late on the line. If the arm's process is frozen during
this time, the time begins at the end of the freeze."""
ARM_SILENCE_S = 0.3
"""Maximum time from the last arm_state that the tapper received to a release, s. The check adds
``WINDOW_S``."""
FUTURE_S = 9.0
"""Time for which the tapper must not fire after it has received a stamp that is more than
``SKEW_LIMIT_S`` ahead of its clock, s. The tapper estimates the differences between the clocks from
the messages of the last 10 s."""
WAIT_SLACK_S = 1.0
"""Maximum time by which the planner may exceed the time limit of a waiting state, s."""
CHARGE_AGE_S, CARRIED_S = 0.65, 2.5
"""The arm must not begin to move within ``CHARGE_AGE_S`` (s) after it has received a report that
the striker is charged, unless the striker has been charged for longer than ``CARRIED_S`` (s)."""
CONTINUED_S = 0.05
"""Maximum time from when the arm has processed the withdrawal of a tap until it begins a further
part of its way to the strike pose, s."""
AT_STRIKE_POSE_M = 0.0005
"""Maximum distance of the target of a move from a strike pose to which the move leads, m."""
ROUNDING_S = 1e-6
"""Tolerance for the rounding of times on the processes' clocks."""
MOVE_TOLERANCE = Joints(0.005, 0.005, 0.0005, 0.01)
"""Maximum difference between the target of a completed move and the true joints, rad and m. It
allows for the arm's errors."""
STOP_MOTION_S = 1.5
"""Maximum time from a stop until the arm is at rest, s. This time includes the delivery of the stop
to the controller and the braking."""


WITHDRAWN_S = 0.15
"""Maximum time from when the planner's process has received a change of the scene that forbids its
tap until it withdraws the tap, s. The planner's timer has a period of 0.1 s."""
LATE_END_S = 2.0
"""Maximum time from the time limit of a goal until the planner ends the goal, s. If the planner has
resumed the goal, or its process was frozen, after the time limit, the time begins then."""
KNOWN_DELAYS_S = 10.0
"""Time for which the planner uses the delay of an image to estimate the difference between the
camera's clock and its own, s."""
RESUMED_S = 21.0
"""Maximum time from a crash of the planner until it resumes its goal, s: its own limit of 15 s, the
start of its process and a freeze."""
DEACTIVATED_S = 0.2
"""Maximum time from when the arm's node has handled its deactivation until it begins a further part
of a motion, s."""
OUTCOME_S = 1.0
"""Maximum time from the withdrawal of a tap until the tapper, if it is SAFE, reports the outcome,
s."""
ENDED = (PlanState.IDLE, PlanState.REACHED, PlanState.FAILED, PlanState.CANCELED)
"""States of the planner without a goal."""
GAVE_UP = "no longer waits"
"""Part of the tapper's error message for a tap whose planner no longer waits for it."""
ACTIVATED_S = 0.5
"""Maximum time for which the arm still reports that its node is not active, s."""
TAPPING = (PlanState.PLACING, PlanState.FIRING)
"""States in which the planner waits for a commanded tap."""
NOT_CLEAR = (ArmState.HOMING, ArmState.MOVING, ArmState.IN_POSITION, ArmState.WITHDRAWING)
"""States in which the arm must not be reported clear of the camera."""


@dataclass(frozen=True, slots=True)
class Violation:
    """Violation of an invariant. ``time`` is in s from the start of the run."""

    name: str
    time: float
    sentence: str


@dataclass(slots=True)
class InvariantChecker:
    """Checks all messages and the ground truth against the invariants. Times are in s from the
    start of the run.

    By granting a ``hold_still`` request for a tap, the arm promises to stand still for the
    requested duration.

    ``stopped_at``: for each process, the time of a stop that nobody has cleared yet.
    ``ended_taps``: for each tap, the time at which a message that ends it (withdrawal, stop,
    cancel) was delivered to the tapper's process.
    """

    scheduler: Scheduler
    physical: PhysicalCell
    tapper_clock: HostClock
    violations: list[Violation] = field(default_factory=list)
    commands: dict[int, TapCommand] = field(default_factory=dict)
    ended_taps: dict[int, float] = field(default_factory=dict)
    ended_before_restart: set[int] = field(default_factory=set)
    """Taps that ended while an earlier process of the tapper ran."""
    outcomes: dict[int, int] = field(default_factory=dict)
    stopped_at: dict[str, float] = field(default_factory=dict)
    motion_allowed: bool = True
    """Whether a person has allowed motion since the last crash, stop or loss of power."""
    commanded_until: float = -math.inf
    """Time by which the arm's line has delivered all commands sent before motion was forbidden."""
    hidden_age: float = 0.0
    """Time by which the goal that the planner recalled was older than the clock of its computer
    showed, s."""
    hidden_since: float = math.inf
    moved_by_hand: tuple[float, Pose] | None = None
    """Time at which the object was last moved by hand, and the object's pose before this motion."""
    held_since: float = math.inf
    """Time since which the panel's emergency stop has been held."""
    arm_runs_since: Callable[[], float] = lambda: -math.inf
    """Return the time since which the arm's process has run. While it is ended or frozen, only the
    hard-wired emergency stop can stop the arm."""
    inactive_since: Callable[[str], float] = lambda process: math.inf
    """Return the time since which a process's node has been inactive, s; inf while it is active."""
    planner_gone_since: float = math.inf
    """Time at which the planner's process ended; inf while the process exists."""
    second_planner_until: float = -math.inf
    """Time at which the last planner ends that was started as a second one by mistake."""
    promises: dict[tuple[int, int], float] = field(default_factory=dict)
    """End of each of the arm's promises to stand still, by the tap id and key of the request."""
    keys_of_tapper: set[int] = field(default_factory=set)
    """Random keys of the tapper. Only a request with one of these keys can end the arm's promise
    early."""
    last_check: tuple[float, object | None] = (-math.inf, "no check was made")
    """Time of the last check that the tapper's state machine made before FIRE. If the check refused
    the shot, also the reason, otherwise None."""
    motor_weak_until: float = -math.inf
    """Time until which the tapper's motor may have lost steps due to missing power."""
    unseen_limit: float = 0.0
    """Maximum time from a change of the scene (the object is moved or hidden) to a release, s. This
    maximum is the sum of two times: the time for which the object may be unseen, and an allowance
    for delayed messages and for the board's firing window."""
    seen_by_tapper: deque[tuple[float, Pose]] = field(default_factory=lambda: deque(maxlen=100))
    """Poses of the object that the tapper's process received, each with the time of receipt."""
    motion_seen_by_tapper: bool = False
    """Whether the object moved in the last observation that the tapper's process received."""
    taken_by_tapper: dict[int, list[TapCommand]] = field(default_factory=dict)
    """TAP commands that the tapper's process received, by id. If another command with the same id
    has reached only other nodes, the tapper must not execute that other command."""
    planners: set[int] = field(default_factory=set)
    """Ids of the taps that the planner has commanded."""
    planner_received: float = -math.inf
    """Time at which the tapper's process last received a message of the planner."""
    planner_waits: bool = False
    """Whether, since the tapper's process received the last TAP, the planner has reported that it
    waits for its tap."""
    camera_received: float = math.inf
    """Time at which the tapper's process last received a usable observation."""
    planner_gave_up: float = math.inf
    """Time since which the planner's messages that the tapper's process received say that the
    planner no longer waits for its tap; inf while the planner waits or has never waited."""
    future_commands: set[int] = field(default_factory=set)
    """Ids of the TAP commands whose stamp was too far in the future when the tapper's process
    received them."""
    arm_received: float = math.inf
    """Time at which the tapper's process last received ``arm_state``; inf in a cell without an
    arm."""
    future_received: dict[str, tuple[float, float]] = field(default_factory=dict)
    """For each topic, the time at which the tapper's process last received a stamp too far in the
    future, and the offset of the process's clock at that time, s."""
    seen_moving: bool = False
    """Whether the object moved in the last observation that the planner's process received."""
    exposed: Callable[[int], float] = lambda stamp: -math.inf
    """Return the time of the exposure of the image with this stamp (ns)."""
    goal_time_limit: float = math.inf
    """Time limit of the goals, s."""
    time_limits: dict[int, float] = field(default_factory=dict)
    """Time limit of each goal with a limit of its own, by the index of its request, s."""
    tolerances: dict[int, tuple[float, float]] = field(default_factory=dict)
    """Requested tolerance of goals by the index of their request, m and rad."""
    tap_limit: int = 0
    """Limit of the number of taps that the goals request; 0: the limit of the cell's file."""
    planner_frozen_until: Callable[[], float] = lambda: -math.inf
    deadlines: dict[int, float] = field(default_factory=dict)
    """Time limit of each published state in which the planner waits for arm or tapper, s."""
    unhomed_since: float = math.inf
    """Time since which the arm has had no valid reference; inf while it has one."""
    unseen_by_tapper: float = 0.0
    """Maximum age of the last pose of the object that the tapper has received, s. If the pose is
    older, the tapper itself must refuse to fire."""
    charge_received: float = -math.inf
    """Time at which the arm's process last received a report that the striker is charged."""
    longest_view: float = 1.05
    """Maximum age of the image on which the planner bases a tap, s, if the smallest delay of its
    images is known."""
    _withdrawn_for_arm: tuple[int, float] = (0, math.inf)
    """Id of the last tap whose withdrawal the arm's process received while the arm served this tap,
    and the time of receipt."""
    over_for_arm: int = 0
    """Id of the last tap of which the arm's process has received that it is over, while the arm
    served this tap; 0 if there is none."""
    command_checker: CommandChecker = field(init=False)
    """Checker of the commands that arm and tapper execute."""
    board_checker: BoardChecker = field(init=False)
    """Checker of the stops of the tapper's boards."""
    peer_checker: PeerChecker = field(init=False)
    """Checker of the ages of the messages that the tapper has received."""
    arm_checker: ArmChecker | None = None
    """Checker of the arm's node."""
    set_up: SetUpChecker | None = None
    """Checker of a cell in set-up mode."""
    confirmation: ConfirmationChecker | None = None
    """Checker of a cell that asks a person before every tap."""
    _struck_until: float = -math.inf
    """Time at which the most recently released striker reaches the end of its stroke."""
    _asked_to_move: bool = True
    _released: int = 0
    _charged_since: float | None = None
    _ready_since: float = math.inf
    """Time since which the tapper's board has been charged completely; inf while it is not."""
    _moving_since: float | None = None
    _plan_state_since: float = 0.0
    arm_frozen_until: float = -math.inf
    """Time until which the arm's process is or was frozen."""
    _read_at: int = 0
    """Stamp of the arm's last reading, ns."""
    _arm: tuple[int, int] = (ArmState.DISCONNECTED, 0)
    """State and tap id in the arm's last message."""
    _placed_until: float = -math.inf
    """Time at which the arm last ceased to move to a strike pose."""
    _commanded_at: dict[int, float] = field(default_factory=dict)
    """For each tap, the time at which a tap at its object pose was first commanded. A program may
    copy an old command."""
    _planned_from: dict[int, float] = field(default_factory=dict)
    """For each tap of the planner, the exposure of the last image that the planner had received
    when it commanded the tap."""
    _placed_tap: int = 0
    """Last tap for which the arm has moved to a strike pose; 0 if there is none."""
    _clear: bool = False
    """Whether the arm's last message says that the arm does not hide the object."""
    _requests: list[tuple[Pose, bool]] = field(default_factory=list)
    """Goal pose of every request that was sent to the planner, and whether the request is a
    message, which the network may deliver twice."""
    _begun: set[int] = field(default_factory=set)
    """Indices of the requests whose goal the planner has begun."""
    _goal: int | None = None
    """Index of the request of the present goal; None if the planner has no goal."""
    _taps: dict[int, list[int]] = field(default_factory=dict)
    """Ids of the taps that the planner has commanded for each goal."""
    _taps_of_second: dict[int, int] = field(default_factory=dict)
    """Number of taps that a second planner has commanded during each goal."""
    _ids_of_second: set[int] = field(default_factory=set)
    """Ids of the taps that a second planner has commanded."""
    _forged: set[int] = field(default_factory=set)
    """Ids of the taps of which another node than the tapper has reported an outcome."""
    _report: TapperState | None = None
    """Last message of the tapper."""
    _crashed: tuple[int, float] | None = None
    """Goal that the planner had when its process was killed, and the time of the crash."""
    _new_taps: list[int] = field(default_factory=list)
    """Ids of the taps that the planner has commanded and that must still be checked."""
    _computation: int = 0
    """Number of the job that computes the decision for which the planner waits; 0 if there is
    none."""
    _seen: Pose | None = None
    """Pose of the object in the last image that shows it and that the planner's process received.
    """
    _received: dict[type, ArmState | TapperState] = field(default_factory=dict)
    """Last states of arm and tapper that the planner's process received."""
    _told_inactive: float = math.inf
    """Time since which the arm has reported that its node is not active, although it is."""
    _tapping_received: float = -math.inf
    """Time at which the tapper's process last received that the planner waits for its tap."""
    _first_taken: dict[int, float] = field(default_factory=dict)
    """For each tap, the time at which the tapper's process first received its command."""
    _is_crashed_cancelled: bool = False
    """Whether a person has cancelled the goal of the planner that crashed."""
    _tap_to_withdraw: int = 0
    """Id of the tap that the planner's process has commanded but not withdrawn; 0 if there is
    none."""
    _own_tap: TapCommand | None = None
    """Command of this tap."""
    _overdue: set[int] = field(default_factory=set)
    """Taps that the planner should have withdrawn."""
    _stops: set[int] = field(default_factory=set)
    """Stamps (ns) of the states that arm and tapper have published since they were stopped during
    the present goal. Each of these states must tell the planner of the stop, because the planner
    may miss the other ones."""
    _last_states: dict[str, ArmState | TapperState] = field(default_factory=dict)
    """Last state that the present process of arm or tapper has published."""
    _told_before: dict[str, int] = field(default_factory=dict)
    """For each device that was stopped, the time of the last stop (ns) that it reported before."""
    _told_of_stop: bool = False
    """Whether the planner's process has received since its start, without a goal, that the cell,
    the arm or the tapper was stopped during the goal of the planner that crashed."""
    _stopped: set[str] = field(default_factory=set)
    """Those of arm and tapper that were stopped during the present goal."""
    _latched: dict[str, float] = field(default_factory=dict)
    """Time at which each device last published that it keeps a stop; inf if it keeps none."""
    _image: float = -math.inf
    """Exposure of the image of the object that the planner's process received last; -inf if this
    image does not show the object."""
    _delays: deque[tuple[float, float]] = field(default_factory=deque)
    """Times at which the planner's process received images in the last ``KNOWN_DELAYS_S``, and the
    times from the exposure to the receipt, s."""
    _began_at: dict[int, float] = field(default_factory=dict)
    """For each goal, the time at which a planner first began it."""
    _goal_begun_at: float = -math.inf
    """Time at which the planner began, or resumed, its present goal."""
    _waiting: tuple[int, float, float, float] = (PlanState.IDLE, 0.0, 0.0, 0.0)
    """State in the planner's last message, and the goal (x, y, z) of that message."""

    def __post_init__(self) -> None:
        self.command_checker = CommandChecker(
            self.scheduler,
            self.tapper_clock,
            self.violate,
            lambda tap_id: self.taken_by_tapper.get(tap_id, ()),
            self.ended_taps,
        )

    def violate(self, name: str, sentence: str) -> None:
        """Record a violation of an invariant."""
        self.violations.append(Violation(name, self.scheduler.now, sentence))

    def on_publish(self, node: str, topic: str, message: object) -> None:
        """Process a message that a node publishes."""
        if isinstance(message, TapCommand):
            if message.request == TapCommand.TAP:
                self.command_checker.on_published(node, message.tap_id)
            if node == "tap_planner":
                self._note_tap(message)
            if (
                message.request == TapCommand.TAP
                and message.tap_id not in self.command_checker.invalid
            ):
                self._commanded_at.setdefault(message.tap_id, self._first_commanded(message))
                self.commands[message.tap_id] = message
                if node == "tap_planner (second)":
                    self._note_tap_of_second(message.tap_id)
                if node == "tap_planner":
                    self.planners.add(message.tap_id)
                    if self.confirmation is not None:
                        self.confirmation.on_tap(message)
                    self._check_goal_of(message.tap_id)
                    # Check after the planner has handled the current message: only then has the
                    # checker processed the observation on which the tap is based.
                    self._new_taps.append(message.tap_id)
                    self.scheduler.after(0.0, self.check_new_taps)
        elif isinstance(message, TapperState) and node == "tapper_trigger":
            self._on_tapper_state(message)
        elif isinstance(message, TapperState) and message.outcome != TapperState.NONE:
            self._forged.add(message.tap_id)
        elif isinstance(message, ArmState) and node == "scara_arm":
            if self._arm[0] == ArmState.MOVING:
                self._placed_until = self.scheduler.now
            if message.state == ArmState.MOVING and message.tap_id:
                self._placed_tap = message.tap_id
            self._arm = message.state, message.tap_id
            self.command_checker.on_arm_state(message)
            if self.arm_checker is not None:
                self.arm_checker.on_arm_state(message)
            self._check_reference(message)
            self._check_view(message)
            self._check_inactive(message.error_code)
            if message.clear_of_camera and message.state in NOT_CLEAR:
                state = _ARM_STATES[message.state]
                self.violate(
                    "false view", f"the arm is reported clear of the camera in state {state}"
                )
            self._note_stop(node, message, message.state == ArmState.STOPPED)
            if message.state == ArmState.IDLE or message.error_code == ErrorCode.NOT_ACTIVE:
                self._asked_to_move = False
        elif isinstance(message, StopState):
            self._note_stop_state(node, message.stopped)
        elif isinstance(message, PlanState) and node == "tap_planner":
            self._on_plan_state(message)
            if self.confirmation is not None:
                self.confirmation.on_plan_state(message)
        if (
            self.set_up is not None
            and isinstance(message, ArmState | TapperState)
            and node in ("scara_arm", "tapper_trigger")
        ):
            self.set_up.on_state(message)

    def _check_inactive(self, code: int) -> None:
        """Check that the arm does not report that its node is inactive while it is active."""
        now, active = self.scheduler.now, math.isinf(self.inactive_since("scara_arm"))
        told = active and code == ErrorCode.NOT_ACTIVE
        self._told_inactive = min(self._told_inactive, now) if told else math.inf
        if now > self._told_inactive + ACTIVATED_S:
            self.violate(
                "reported inactive",
                f"the arm's node has reported for {now - self._told_inactive:.1f} s that it is not"
                " active, but it is",
            )
            self._told_inactive = now

    def after_event(self) -> None:
        """Check the invariants of releases, charging and motion after an event."""
        releases = self.physical.releases
        while self._released < len(releases):
            self._check_release(releases[self._released], releases[: self._released])
            self._released += 1
        self._check_charge()
        self._check_motion()
        if self.set_up is not None:
            self.set_up.check_motion()

    # Releases

    def _check_release(self, release: Release, earlier: list[Release]) -> None:
        shot = release.shot
        self.command_checker.on_release(shot)
        self.peer_checker.on_release(shot)
        if self.arm_checker is not None:
            self.arm_checker.on_release(shot)
        if any(before.shot == shot for before in earlier):
            self.violate("fired twice", f"shot {shot} was released twice")
        if release.moving:
            self.violate("arm moving", f"shot {shot} was released while the arm moved")
        command = self._command_of(release)
        if command is None:
            self.violate(
                "no such tap", f"shot {shot} was released, but the tapper received no such tap"
            )
            return
        if self.set_up is not None:
            self.set_up.check_release(release)
        self._check_place(release, command)
        self._check_energy(release, command)
        self._struck_until = release.time + self.physical.flight(command.striker_speed)
        self._check_permit(release)
        self._check_last_check(release)
        self._check_time(release, command)
        gone_since = self.planner_gone_since
        if shot in self._ids_of_second:
            gone_since = max(gone_since, self.second_planner_until)
        absent = release.time - gone_since
        if absent > ORPHAN_S:
            self.violate(
                "no planner", f"shot {shot} was fired {absent:.2f} s after its planner had ended"
            )
        silent = release.time - self.planner_received
        patience = HEARTBEAT_S if self.planner_waits else SILENCE_S
        if shot in self.planners and silent > patience + WINDOW_S:
            self.violate(
                "planner silent",
                f"shot {shot} was released {silent:.2f} s after the tapper had last received a "
                "message from the planner that commanded the shot (limit "
                f"{patience + WINDOW_S:g} s)",
            )
        blind = release.time - self.camera_received
        if blind > HEARTBEAT_S + WINDOW_S:
            self.violate(
                "camera silent",
                f"shot {shot} was released {blind:.2f} s after the last camera message that the"
                f" tapper received (limit {HEARTBEAT_S + WINDOW_S:g} s)",
            )
        deaf = release.time - self.arm_received
        if deaf > ARM_SILENCE_S + WINDOW_S:
            self.violate(
                "arm silent",
                f"shot {shot} was released {deaf:.2f} s after the last arm_state that the tapper"
                f" received (limit {ARM_SILENCE_S + WINDOW_S:g} s)",
            )
        inactive = release.time - self.inactive_since("tapper_trigger")
        if inactive > WINDOW_S:
            self.violate(
                "tapper inactive",
                f"shot {shot} was released {inactive:.2f} s after the tapper's node had been"
                " deactivated",
            )
        given_up = release.time - self.planner_gave_up
        if given_up > WINDOW_S:
            self.violate(
                "planner gave up",
                f"shot {shot} was released {given_up:.2f} s after the tapper had received that the"
                " planner no longer waits for its tap",
            )
        if shot in self.future_commands:
            self.violate(
                "future command", f"shot {shot} was released, but its command came from the future"
            )
        self._check_stamps(release)
        self._check_scene(release, command)

    def on_tap_received(self, command: TapCommand) -> None:
        """Process a TAP command that the tapper's process received."""
        self.planner_waits, self.planner_gave_up = False, math.inf
        self.taken_by_tapper.setdefault(command.tap_id, []).append(command)
        self._first_taken.setdefault(command.tap_id, self.scheduler.now)
        ahead = to_seconds(command.header.stamp) - 1e-9 * self.tapper_clock.now().ros
        if ahead > CLOCK_TOLERANCE_S + ROUNDING_S:
            self.future_commands.add(command.tap_id)

    def on_plan_state_received(self, tapping: bool) -> None:
        """Process a message of the planner that the tapper's process received. ``tapping``: whether
        the planner says that it waits for its tap."""
        if tapping:
            self.planner_waits, self.planner_gave_up = True, math.inf
            self._tapping_received = self.scheduler.now
        elif self.planner_waits:
            self.planner_gave_up = min(self.planner_gave_up, self.scheduler.now)

    def on_stamp_received(self, topic: str, stamp: Time) -> None:
        """Process the stamp of a message that the tapper's process received."""
        ahead = to_seconds(stamp) - 1e-9 * self.tapper_clock.now().ros
        self.peer_checker.on_stamp_received(CAMERA if topic == "object_state" else topic, stamp)
        if ahead > SKEW_LIMIT_S + ROUNDING_S:
            self.future_received[topic] = self.scheduler.now, self.tapper_clock.offset

    def _check_stamps(self, release: Release) -> None:
        for topic, (received, offset) in self.future_received.items():
            # After a step of the tapper's own clock, the stamp may no longer be in the future.
            if release.time < received + FUTURE_S and offset == self.tapper_clock.offset:
                self.violate(
                    "future stamp",
                    f"shot {release.shot} was released {release.time - received:.2f} s after the"
                    f" tapper had received a message on {topic} whose stamp was more than"
                    f" {SKEW_LIMIT_S:g} s ahead of its clock",
                )

    def _command_of(self, release: Release) -> TapCommand | None:
        """Return the command that caused a release. If several commands have its id (two planners
        were started by mistake), return the command whose strike pose and energy are closest to
        those of the release. If several commands are for the same strike, return the command
        that expires last."""

        def difference(command: TapCommand) -> tuple[float, int]:
            excess = abs(release.energy / self.physical.energy_for(command.striker_speed) - 1.0)
            place = self._difference_of_place(command, release)
            return round(place + excess / ENERGY_SHARE, 6), -to_nanoseconds(command.expiry)

        variants = self.taken_by_tapper.get(release.shot)
        return min(variants, key=difference) if variants else None

    def _difference_of_place(self, command: TapCommand, release: Release) -> float:
        """Return how far the strike of a command is from a release, as a multiple of the limits."""
        pose = from_message(command.strike_pose)
        turn = abs(pose.rotation_to(release.tip))
        return pose.distance_to(release.tip) / STRIKE_POSITION_M + turn / STRIKE_ANGLE_RAD

    def _check_energy(self, release: Release, command: TapCommand) -> None:
        asked = self.physical.energy_for(command.striker_speed)
        weak = release.time < self.motor_weak_until
        # If the motor did not charge the spring completely, the shot is weaker than requested. No
        # sensor measures this.
        least = 0.0 if weak else 1.0 - ENERGY_SHARE
        if not least * asked <= release.energy <= (1.0 + ENERGY_SHARE) * asked:
            self.violate(
                "other energy",
                f"shot {release.shot} was released with {1e3 * release.energy:.2f} mJ, but"
                f" {1e3 * asked:.2f} mJ were requested",
            )

    def _check_place(self, release: Release, command: TapCommand) -> None:
        wanted = from_message(command.strike_pose)
        distance = wanted.distance_to(release.tip)
        turn = abs(wanted.rotation_to(release.tip))
        lift = abs(release.height - command.strike_pose.position.z)
        if distance > STRIKE_POSITION_M or turn > STRIKE_ANGLE_RAD or lift > STRIKE_HEIGHT_M:
            self.violate(
                "arm elsewhere",
                f"when shot {release.shot} was released, the tip was {1e3 * distance:.2f} mm"
                f" (horizontally), {1e3 * lift:.2f} mm (vertically) and"
                f" {math.degrees(turn):.2f} deg away from its strike pose",
            )

    def _check_permit(self, release: Release) -> None:
        ends = [
            end
            for (tap_id, key), end in self.promises.items()
            if tap_id == release.shot and key in self.keys_of_tapper
        ]
        end = max(ends, default=-math.inf)
        if self._struck_until + PULSE_S > end:
            self.violate(
                "outside the permit",
                f"shot {release.shot} was released when the arm's promise to stand still "
                + (
                    f"had only {end - release.time:.3f} s left, too short for the pulse and the"
                    " stroke"
                    if end > release.time
                    else "had ended or had never been made"
                ),
            )

    def _check_last_check(self, release: Release) -> None:
        asked, reason = self.last_check
        if reason is not None:
            self.violate(
                "against its check",
                f"shot {release.shot} was released although the last check refused it: {reason}",
            )
        elif release.time > asked + CHECK_S:
            self.violate(
                "check too old",
                f"shot {release.shot} was released {release.time - asked:.3f} s after the last"
                f" check (limit {CHECK_S:g} s)",
            )

    def _check_time(self, release: Release, command: TapCommand) -> None:
        ended = self.ended_taps.get(release.shot)
        if ended is not None and release.time > ended + WINDOW_S:
            self.violate(
                "after its end",
                f"shot {release.shot} was released {release.time - ended:.3f} s after the tapper"
                " had received the message that ended the tap",
            )
        stopped = self.stopped_at.get("tapper_trigger")
        if stopped is not None and release.time > stopped + WINDOW_S:
            self.violate(
                "after a stop",
                f"shot {release.shot} was released {release.time - stopped:.3f} s after a stop",
            )
        late = 1e-9 * (self.tapper_clock.now().ros - to_nanoseconds(command.expiry)) - WINDOW_S
        if late > 0:
            self.violate(
                "expired",
                f"shot {release.shot} was released {late + WINDOW_S:.3f} s after its command had"
                " expired",
            )

    def _check_scene(self, release: Release, command: TapCommand) -> None:
        if release.time > self.hidden_since + self.unseen_limit:
            self.violate(
                "unseen",
                f"shot {release.shot} was released {release.time - self.hidden_since:.2f} s after"
                f" the camera last saw the object (limit {self.unseen_limit:g} s)",
            )
        planned = from_message(command.object_pose)
        self._check_knowledge(release, planned)
        off, turned = (
            planned.distance_to(release.object_pose),
            abs(planned.rotation_to(release.object_pose)),
        )
        moved = self.moved_by_hand
        if (off > BUMP_M or turned > BUMP_RAD) and (
            moved is None or release.time > moved[0] + self.unseen_limit
        ):
            self.violate(
                "object elsewhere",
                f"shot {release.shot} was released with the object {1e3 * off:.1f} mm and"
                f" {math.degrees(turned):.1f} deg from its pose when the tap was planned",
            )

    def _check_knowledge(self, release: Release, planned: Pose) -> None:
        """Check that the poses that the tapper had received allowed the release, regardless of the
        object's true pose."""
        since, last = math.inf, self.seen_by_tapper[-1][0] if self.seen_by_tapper else math.inf
        if release.time > last + self.unseen_by_tapper + WINDOW_S:
            self.violate(
                "unseen by the tapper",
                f"shot {release.shot} was released {release.time - last:.3f} s after the tapper"
                " had last received a pose of the object (limit"
                f" {self.unseen_by_tapper + WINDOW_S:g} s)",
            )
        for received, pose in reversed(self.seen_by_tapper):
            if planned.distance_to(pose) <= BUMP_M and abs(planned.rotation_to(pose)) <= BUMP_RAD:
                break
            since = received
        if release.time > since + WINDOW_S:
            self.violate(
                "against what it saw",
                f"shot {release.shot} was released {release.time - since:.3f} s after the tapper"
                " had received a different pose of the object",
            )

    # States

    def _check_charge(self) -> None:
        state = self.physical.tapper_board.state
        self._check_charged(state in ("CHARGING", "CHARGED"))
        if state != "CHARGED":
            self._ready_since = math.inf
            return
        now = self.scheduler.now
        self._ready_since = min(self._ready_since, now)
        if now > self._ready_since + READY_S:
            self.violate(
                "kept charged",
                f"the striker has been ready to be fired for more than {READY_S:g} s",
            )
            self._ready_since = now

    def _check_charged(self, charged: bool) -> None:
        if not charged:
            self._charged_since = None
            return
        now = self.scheduler.now
        if self._charged_since is None:
            self._charged_since = now
        elif now - self._charged_since > CHARGED_LIMIT_S:
            self.violate(
                "left charged", f"the striker has been charged for more than {CHARGED_LIMIT_S:g} s"
            )
            self._charged_since = now

    def _check_motion(self) -> None:
        now = self.scheduler.now
        if not self.physical.moving(now):
            self._moving_since = None
            return
        if self.arm_checker is not None:
            self.arm_checker.on_motion()
        if self._moving_since is None:
            self._moving_since = now
            if not self._asked_to_move:
                self.violate("moved unasked", "the arm began to move without a request")
            if now < self._struck_until:
                self.violate(
                    "moved in flight",
                    f"the arm began to move {self._struck_until - now:.3f} s before the striker"
                    " can have completed its stroke",
                )
            self._check_striker()
            for (tap_id, _), end in self.promises.items():
                if now < end - ROUNDING_S:
                    self.violate(
                        "broken promise",
                        f"the arm began to move {end - now:.3f} s before the end of its promise to"
                        f" stand still for tap {tap_id}",
                    )
            inactive = now - self.inactive_since("scara_arm")
            if inactive > DEACTIVATED_S:
                self.violate(
                    "moved while inactive",
                    f"the arm began to move {inactive:.2f} s after its node had been deactivated",
                )
            if not self.motion_allowed and now > self.commanded_until + ROUNDING_S:
                self.violate(
                    "moved by itself",
                    "the arm began to move without a person's permission after a crash or a stop",
                )
        held_since = max(self.held_since, self.arm_runs_since())
        if now > held_since + STOP_MOTION_S:
            self.violate(
                "moves while the stop is pressed",
                f"the arm still moves {now - held_since:.2f} s after the panel's emergency stop"
                " was pressed and the arm's node runs, and the stop is still held",
            )
            self.held_since = math.inf
        stopped = self.stopped_at.get("scara_arm")
        if stopped is not None and now > stopped + STOP_MOTION_S:
            self.violate("moves while stopped", f"the arm moves {now - stopped:.2f} s after a stop")
            self.stopped_at["scara_arm"] = math.inf

    def _check_striker(self) -> None:
        """Check that, while the striker is charged, the arm begins no motion other than a motion to
        a strike pose."""
        now = self.scheduler.now
        # The arm may still send the next part of its way to the strike pose while it processes the
        # withdrawal of the tap.
        placing = self._arm[0] == ArmState.MOVING or now <= self._placed_until + CONTINUED_S
        if self._charged_since is None or placing:
            return
        age = now - self.charge_received
        if age < CHARGE_AGE_S and now - self._charged_since < CARRIED_S:
            self.violate(
                "carried charged",
                f"the arm began to move {age:.2f} s after it had received the report that the"
                " striker is charged",
            )

    def check_start(self, target: Joints, speed: float) -> None:
        """Check a move before it begins. ``speed`` is a fraction of the maximum joint speeds."""
        if self.set_up is not None:
            self.set_up.check_speed(speed)
        if self.arm_checker is not None:
            self.arm_checker.on_start(target)
        tap_id, withdrawn_at = self._withdrawn_for_arm
        command, late = self.commands.get(tap_id), self.scheduler.now - withdrawn_at
        if command is None or self._arm[1] != tap_id or late < CONTINUED_S:
            return
        tip = self.physical.geometry.forward(target)
        place = self.physical.cell.arm_base @ Pose(tip.x, tip.y, tip.yaw)
        off = place.distance_to(from_message(command.strike_pose))
        if off < AT_STRIKE_POSE_M and tip.z < command.strike_pose.position.z + AT_STRIKE_POSE_M:
            self.violate(
                "moved on after a withdrawal",
                f"the arm began to move to the strike pose of tap {tap_id} {late:.2f} s after it"
                " had received the withdrawal of this tap",
            )

    def check_move(self, target: Joints) -> None:
        """Check that the arm truly stands at the target of a move that its driver reports as
        completed. Do not check this if the arm's board has lost its position."""
        if self.arm_checker is not None:
            self.arm_checker.on_end()
        if math.isfinite(self.unhomed_since):
            return
        found = self.physical.joints(self.scheduler.now)
        off = [abs(a - b) for a, b in zip(found, target, strict=True)]
        if any(x > limit for x, limit in zip(off, MOVE_TOLERANCE, strict=True)):
            self.violate(
                "false arrival",
                f"a move to {joints_text(target)} was called completed, but the arm is at"
                f" {joints_text(found)}",
            )

    # Reports

    def forbid_motion(self) -> None:
        """Record that the arm may not begin to move until a person allows it; commands that its
        line still delivers are not the node's."""
        self.motion_allowed = False
        self.commanded_until = self.physical.arm_line.layer.delivered_by(self.scheduler.now)

    def lose_reference(self) -> None:
        """Record that the arm's board has lost its position. The position remains unknown until the
        arm is homed."""
        if self._arm[0] != ArmState.HOMING:  # homing that a person has requested may still go on
            self.forbid_motion()
        self.unhomed_since = min(self.unhomed_since, self.scheduler.now)

    def on_computing(self, job: int) -> None:
        """Process that the planner begins to compute a decision."""
        self._computation = job

    def on_computed(self, job: int, acted: bool) -> None:
        """Check that the planner acts only on the decision for which it waits."""
        if acted and job != self._computation:
            self.violate(
                "late decision",
                f"the planner acted on the decision of job {job}, for which it no longer waited",
            )

    def check_new_taps(self) -> None:
        """Check the basis of the taps that the planner has commanded."""
        taps, self._new_taps = self._new_taps, []
        for tap_id in taps:
            self._check_basis(tap_id)

    def _check_basis(self, tap_id: int) -> None:
        """Check that the planner commanded this tap while the observed object was at rest."""
        self._check_planned_pose(tap_id, self._seen)
        tapper = self._received.get(TapperState)
        if isinstance(tapper, TapperState) and not tapper.interlock_closed:
            self.violate(
                "tap with an open guard",
                f"tap {tap_id} was commanded although the last state of the tapper that the planner"
                " received says that the guard is open",
            )
        if math.isinf(self._image):
            self.violate(
                "planned without a view",
                f"tap {tap_id} was commanded although the planner's last image does not show the"
                " object",
            )
        if self.seen_moving:
            self.violate(
                "planned while it moved",
                f"tap {tap_id} was commanded although the object was observed in motion",
            )
        self._check_image(tap_id, self._image)

    def _check_planned_pose(self, tap_id: int, seen: Pose | None) -> None:
        """Check that the tap was planned for the pose that the planner's process last received."""
        planned = from_message(self.commands[tap_id].object_pose)
        if seen is None:
            return
        off, turned = planned.distance_to(seen), abs(planned.rotation_to(seen))
        if off > MOVED_M + ROUNDING_S or turned > MOVED_RAD + ROUNDING_S:
            self.violate(
                "planned for another pose",
                f"tap {tap_id} was commanded, but the planner last received the object"
                f" {1e3 * off:.2f} mm and {math.degrees(turned):.2f} deg away from the pose for"
                f" which the tap was planned (limits {1e3 * MOVED_M:g} mm and"
                f" {math.degrees(MOVED_RAD):g} deg)",
            )

    def _check_image(self, tap_id: int, exposed: float) -> None:
        """Check that the planner's last image of the tapped object was exposed after the last tap
        of the goal. The planner cannot know the smallest delay of its images."""
        self._planned_from[tap_id] = exposed
        shot, now = self._last_shot(), self.scheduler.now
        unknown = min((delay for _, delay in self._delays), default=math.inf)
        if -math.inf < exposed < now - self.longest_view - unknown:
            self.violate(
                "planned on a stale image",
                f"tap {tap_id} was commanded, but the last image of the object that the planner"
                f" received was exposed {now - exposed:.3f} s before (limit"
                f" {self.longest_view + unknown:.3f} s)",
            )
        if exposed < shot - unknown - ROUNDING_S:
            self.violate(
                "planned on an old image",
                f"tap {tap_id} was commanded, but the last image of the object that the planner"
                f" received was exposed {shot - exposed:.3f} s before the last shot of the goal"
                f" (limit {unknown:.3f} s)",
            )

    def _last_shot(self) -> float:
        """Return the time of the last release for the planner's present goal."""
        taps = self._taps.get(self._goal, []) if self._goal is not None else []
        return max(
            (one.time for one in self.physical.releases if one.shot in taps), default=-math.inf
        )

    def on_image_received_by_planner(self, state: ObjectState) -> None:
        """Process a state of the cell's own object that the planner's process received."""
        now = self.scheduler.now
        exposed = self.exposed(to_nanoseconds(state.header.stamp))
        self._image = exposed if state.visible else -math.inf
        self._delays.append((now, now - exposed))
        while self._delays[0][0] < now - KNOWN_DELAYS_S:
            self._delays.popleft()
        if state.visible:
            self.seen_moving = not state.at_rest
            self._seen = from_message(state.pose.pose)
            if state.error_code == ErrorCode.NONE:
                self._expect_withdrawal_if_moved(self._seen)

    def _observes_by_object_state(self) -> bool:
        """Return whether the planner observes the object of its present goal on the topic
        ``object_state``."""
        return True

    def _expect_withdrawal_if_moved(self, seen: Pose) -> None:
        """Check that the planner soon withdraws its tap, if its process has received that the
        tapped object is elsewhere."""
        if self._own_tap is None or not self._observes_by_object_state():
            return
        planned = from_message(self._own_tap.object_pose)
        off, turned = planned.distance_to(seen), abs(planned.rotation_to(seen))
        if off > BUMP_M or turned > BUMP_RAD:
            self.expect_withdrawal(
                f"the object is {1e3 * off:.1f} mm and {math.degrees(turned):.1f} deg away from the"
                " pose for which the tap was planned"
            )

    def expect_withdrawal(self, change: str) -> None:
        """Check that the planner soon withdraws its tap, because of a change of the scene that its
        process has received."""
        command, received = self._own_tap, self.scheduler.now
        if command is None or self._waiting[0] not in TAPPING or command.tap_id in self._overdue:
            return

        def check() -> None:
            frozen = self.planner_frozen_until() > received
            if self._own_tap is not command or self._waiting[0] not in TAPPING or frozen:
                return
            self._overdue.add(command.tap_id)
            self.violate(
                "tap not withdrawn",
                f"the planner has not withdrawn tap {command.tap_id}, although it received"
                f" {WITHDRAWN_S:g} s ago that {change}",
            )

        self.scheduler.after(WITHDRAWN_S, check)

    def _check_reference(self, message: ArmState) -> None:
        """Check that the arm's node does not report the arm as homed when the arm has no valid
        reference."""
        if message.state == ArmState.HOMING:
            self.unhomed_since = math.inf
        since = self.scheduler.now - max(self.unhomed_since, self.arm_frozen_until)
        stamp = to_nanoseconds(message.header.stamp)
        new, self._read_at = stamp != self._read_at, stamp
        if message.homed and new and since > HOMED_S:
            self.violate(
                "false reference",
                f"the arm is reported as homed {since:.1f} s after its board lost its position"
                " or its process was frozen",
            )
            self.unhomed_since = math.inf

    @property
    def _placed_tap_seen_at(self) -> float:
        """Exposure of the image from which the arm's last tap was planned; the time of the command
        if another program commanded the tap."""
        return self._seen_at_for(self._placed_tap)

    def _seen_at_for(self, tap_id: int) -> float:
        return self._planned_from.get(tap_id, self._commanded_at.get(tap_id, -math.inf))

    def _first_commanded(self, message: TapCommand) -> float:
        """Return the time at which a tap at the object pose of this command was first commanded."""
        for tap_id, earlier in self.commands.items():
            if earlier.object_pose == message.object_pose:
                return self._seen_at_for(tap_id)
        return self.scheduler.now

    def _check_view(self, message: ArmState) -> None:
        """Check that the arm does not hide the object when its node begins to report this."""
        before, self._clear = self._clear, message.clear_of_camera
        now, moved = self.scheduler.now, self.moved_by_hand
        # The arm leaves the view of the object that was tapped, wherever a hand has moved it since.
        elsewhere = moved is not None and moved[0] > self._placed_tap_seen_at
        if message.clear_of_camera and not before and not elsewhere:
            if self.physical.moving(now):
                self.violate("false view", "the arm is reported clear of the camera while it moves")
            elif self.physical.view(now) is None and not self._is_overshot():
                self.violate(
                    "false view", "the arm is reported clear of the camera but hides the object"
                )

    def _is_overshot(self) -> bool:
        """Return whether the tapped object has moved farther than the arm assumes. For example, the
        planner has learnt a gain from a shot without full energy, and has then tapped too hard."""
        command = self.commands.get(self._placed_tap)
        if command is None:
            return False
        start, predicted = from_message(command.object_pose), from_message(command.predicted_pose)
        way = start.distance_to(self.physical.object_pose(self.scheduler.now))
        return way > LONGEST_WAY * start.distance_to(predicted) + BUMP_M

    def ask_to_move(self) -> None:
        """Allow the arm to move until it is idle again, because it has received a command."""
        self._asked_to_move = True

    def on_answer(self, service: str, request: object, response: object) -> None:
        """Process the answer to a service call."""
        if self.confirmation is not None and isinstance(request, ConfirmTap.Request):
            assert isinstance(response, ConfirmTap.Response)
            self.confirmation.on_answer(request, response)
        if not isinstance(request, HoldStill.Request):
            return
        if isinstance(response, HoldStill.Response) and response.granted:
            end = self.scheduler.now + request.duration
            promise = request.tap_id, request.key
            before = self.promises.get(promise, -math.inf)
            if end <= before or request.duration <= 0:
                if request.key in self.keys_of_tapper:
                    self.promises[promise] = min(end, before)
                return
            if self.arm_checker is not None:
                self.arm_checker.on_promise(request)
            if self._arm != (ArmState.IN_POSITION, request.tap_id):
                self.violate(
                    "empty promise",
                    f"the arm promised to stand still for tap {request.tap_id} while it was in"
                    f" state {_ARM_STATES.get(self._arm[0], self._arm[0])} for tap {self._arm[1]}",
                )
            if request.tap_id == self.over_for_arm:
                self.violate(
                    "promise after the outcome",
                    f"the arm promised to stand still for tap {request.tap_id} after it had"
                    " received the outcome of this tap",
                )
            self.promises[promise] = end

    def on_outcome_received_by_arm(self, tap_id: int) -> None:
        """Process a report, received by the arm's process, that a tap is over. Only the tap that
        the arm serves counts."""
        if tap_id and tap_id == self._arm[1]:
            self.over_for_arm = tap_id

    def on_withdrawal_received_by_arm(self, tap_id: int) -> None:
        """Process a withdrawal, received by the arm's process, of the tap that the arm serves."""
        if tap_id and tap_id == self._arm[1] != self._withdrawn_for_arm[0]:
            self._withdrawn_for_arm = tap_id, self.scheduler.now

    def on_asked(self, process: str, job: str, answer: object | None) -> None:
        """Process the answer that a state machine gives to its running job."""
        if process == "tapper_trigger" and job == "fire":
            self.last_check = self.scheduler.now, answer
        if process == "tapper_trigger" and job == "charge" and answer is None:
            self.command_checker.on_charge_allowed()
        if process == "tapper_trigger" and self.set_up is not None:
            self.set_up.on_asked(job, answer)

    def on_goal_sent(self, goal: Pose, by_topic: bool) -> int:
        """Process a goal that a client sends to the planner by a topic or by an action. Return the
        index of the request."""
        self._requests.append((goal, by_topic))
        return len(self._requests) - 1

    def on_planner_killed(self, crash: bool) -> None:
        """Process the end of the planner's process. After a crash, the planner may resume its
        goal."""
        self.planner_gone_since = self.scheduler.now
        if not crash:
            self.on_planner_deactivated()  # an orderly end begins with a deactivation
        self._tap_to_withdraw, self._own_tap = 0, None
        self._told_of_stop = False
        self._delays.clear()
        if self.confirmation is not None:
            self.confirmation.on_planner_ended()
        goal, self._goal = self._goal, None
        if not crash:
            self._crashed = None
        elif goal is not None:  # otherwise the crash of an earlier process may still be pending
            self._crashed, self._is_crashed_cancelled = (goal, self.scheduler.now), False

    @property
    def planner_has_crashed(self) -> bool:
        """Whether a planner has crashed during a goal that another planner may still resume."""
        return self._crashed is not None

    def on_planner_deactivated(self) -> None:
        """Process that the planner's process has handled the deactivation of its node."""
        if self._goal is not None:
            self.violate(
                "goal outlives its deactivation",
                "the planner's node was deactivated, but the present goal has not ended",
            )

    def on_goal_cancelled(self) -> None:
        """Process that the planner has answered a person's request to end the present goal."""
        if self._goal is not None:
            self.violate("cancel without effect", "the cancelled goal has not ended")
        self._is_crashed_cancelled = True

    def _note_tap_of_second(self, tap_id: int) -> None:
        """Process a tap that a second planner commands, which by mistake uses the same files. It
        may count for the goal that a planner resumes from these files."""
        self._ids_of_second.add(tap_id)
        goal = self._goal if self._crashed is None else self._crashed[0]
        if goal is not None:
            self._taps_of_second[goal] = self._taps_of_second.get(goal, 0) + 1

    def _note_tap(self, message: TapCommand) -> None:
        """Process a command of the planner's process."""
        if message.request == TapCommand.TAP:
            self._tap_to_withdraw, self._own_tap = message.tap_id, message
        elif message.request == TapCommand.WITHDRAW and message.tap_id == self._tap_to_withdraw:
            self._tap_to_withdraw, self._own_tap = 0, None

    def _note_stop_state(self, node: str, stopped: bool) -> None:
        """Process that a node has published whether it keeps a stop."""
        self._told_before.pop(node, None)
        last = self._last_states.get(node)
        if stopped and math.isinf(self._latched.get(node, math.inf)) and last is not None:
            was_stopped = last.state in (ArmState.STOPPED, TapperState.STOPPED)
            if not was_stopped:
                self._told_before[node] = to_nanoseconds(last.last_stop)
        self._latched[node] = self.scheduler.now if stopped else math.inf

    def on_device_lost(self, node: str) -> None:
        """Process the end of the process of arm or tapper."""
        self._last_states.pop(node, None)
        self._told_before.pop(node, None)

    def _note_stop(self, node: str, message: ArmState | TapperState, stopped: bool) -> None:
        """Process a state of arm or tapper with respect to stops."""
        latched_for = self.scheduler.now - self._latched.get(node, math.inf)
        is_away = message.state in (ArmState.DISCONNECTED, TapperState.DISCONNECTED)
        if latched_for > REPORTED_S and not stopped and not is_away:
            self.violate(
                "stop not reported",
                f"{node} reports state {message.state}, although it has kept a stop for"
                f" {latched_for:.1f} s",
            )
            self._latched[node] = math.inf
        self._last_states[node] = message
        before = self._told_before.get(node)
        if latched_for > REPORTED_S and stopped and before == to_nanoseconds(message.last_stop):
            self.violate(
                "stop not told",
                f"{node} has kept a stop for {latched_for:.1f} s, but its state does not tell when"
                " it was stopped",
            )
            del self._told_before[node]
        if stopped:
            self._stopped.add(node)
        if node in self._stopped:
            self._stops.add(to_nanoseconds(message.header.stamp))

    def on_state_received_by_planner(self, message: ArmState | TapperState) -> None:
        """Process a state of arm or tapper that the planner's process has handled."""
        previous = self._received.get(type(message), message)
        self._received[type(message)] = message
        if self.confirmation is not None and isinstance(message, TapperState):
            self.confirmation.on_tapper_state(message)
        # Not every state after a stop tells of it: a device that was started again does not report
        # its stop at first.
        is_arm = isinstance(message, ArmState)
        stopped = ArmState.STOPPED if is_arm else TapperState.STOPPED
        fault = ArmState.FAULT if is_arm else TapperState.FAULT
        last = to_nanoseconds(message.last_stop)
        before = to_nanoseconds(previous.last_stop)
        tells = message.state == stopped or last not in (0, before)
        if message.state == fault and self._goal is not None:
            self.violate(
                "goal outlives a fault",
                "the planner has received that the arm or the tapper has a fault during the present"
                " goal, but has not ended this goal",
            )
        if tells and to_nanoseconds(message.header.stamp) in self._stops:
            self.on_stop_received_by_planner()

    def on_stop_received_by_planner(self) -> None:
        """Process that the planner's process has handled the message of a stop."""
        self._told_of_stop = True
        if self._goal is not None:
            self.violate(
                "goal outlives a stop",
                "the planner has received that the cell, the arm or the tapper was stopped during"
                " the present goal, but has not ended this goal",
            )

    def on_exception_in_planner(self) -> None:
        """Process that the planner has handled an exception of one of its handlers."""
        if self._goal is not None:
            self.violate(
                "goal outlives an exception",
                "a handler of the planner has raised an exception during the present goal, but the"
                " planner has not ended this goal",
            )

    def _begin_goal(self, message: PlanState) -> None:
        """Check that somebody has requested the goal that the planner begins."""
        self._check_planner_active("began a goal")
        pose = from_message(message.goal.pose)
        found = [
            index
            for index, (goal, _) in enumerate(self._requests)
            if goal.distance_to(pose) < ROUNDING_S and abs(goal.rotation_to(pose)) < ROUNDING_S
        ]
        if not found:
            self.violate("goal of nobody", f"the planner began the goal {pose}, which nobody sent")
            found = [self.on_goal_sent(pose, by_topic=True)]
        self._goal = found[-1]
        resumed = self._crashed is not None and self._crashed[0] == self._goal
        if self.confirmation is not None:
            self.confirmation.on_goal_begun(self._goal, resumed)
        if not resumed:
            self._stops.clear()
            self._stopped.clear()
        elif self._told_of_stop:
            # The planner ends the goal in the same handler.
            self.scheduler.after(0.0, self.on_stop_received_by_planner)
        crashed = self._crashed
        if crashed is not None and crashed[0] == self._goal and self._is_crashed_cancelled:
            self.violate(
                "cancelled goal resumed",
                "the planner resumed the goal of a planner that crashed, although a person had"
                " cancelled this goal",
            )
        if self._goal in self._begun and not self._requests[self._goal][1]:
            if crashed is None or crashed[0] != self._goal:
                self.violate(
                    "goal begun again", "the planner began a goal again that had already ended"
                )
            elif self.scheduler.now > crashed[1] + RESUMED_S + self.hidden_age:
                self.violate(
                    "old goal resumed",
                    f"the planner resumed a goal {self.scheduler.now - crashed[1]:.1f} s after its"
                    f" crash (limit {RESUMED_S:g} s; the computer's clock hid {self.hidden_age:.1f}"
                    " s)",
                )
        if self._crashed is None or self._crashed[0] != self._goal:
            self._taps.pop(self._goal, None)  # a goal message that was delivered twice
            self._began_at[self._goal] = self.scheduler.now
        self._goal_begun_at = self.scheduler.now
        self._crashed = None
        self._begun.add(self._goal)

    def _check_goal_of(self, tap_id: int) -> None:
        """Check that the planner has a goal and is active when it commands a tap."""
        self._check_planner_active(f"commanded tap {tap_id}")
        if self._goal is None:
            self.violate("tap without a goal", f"tap {tap_id} was commanded without a goal")
            return
        self._taps.setdefault(self._goal, []).append(tap_id)

    def _check_planner_active(self, action: str) -> None:
        inactive = self.scheduler.now - self.inactive_since("tap_planner")
        if inactive >= 0.0:
            self.violate(
                "works while inactive",
                f"the planner {action} {inactive:.2f} s after its node had been deactivated",
            )

    def check_result(
        self, request: int, result: PositionObject.Result, tolerance: tuple[float, float]
    ) -> None:
        """Check the result of an action goal against the ground truth. ``tolerance``: m and rad."""
        if result.error_code == ErrorCode.NONE:
            self._check_claim("the result says", self._requests[request][0], tolerance)
        self._check_count("the result gives", request, result.taps)
        if len(result.records) != result.taps:
            self.violate(
                "false count",
                f"the result gives {result.taps} taps, but {len(result.records)} records",
            )

    def _check_count(self, who: str, request: int, taps: int) -> None:
        """Check a reported number of taps of a goal, including taps before a crash of the
        planner."""
        limited = self.tap_limit and not self._requests[request][1]
        if limited and taps > self.tap_limit:
            self.violate(
                "too many taps", f"{who} {taps} taps, but the limit of the goal is {self.tap_limit}"
            )
        commanded = self._taps.get(request, [])
        told = set(commanded) - self._forged
        fired = sum(release.shot in told for release in self.physical.releases)
        if not fired <= taps <= len(commanded) + self._taps_of_second.get(request, 0):
            self.violate(
                "false count",
                f"{who} {taps} taps, but {fired} of {len(commanded)} commanded taps were fired",
            )

    def check_outcome(self) -> None:
        """Check that the tapper, which is SAFE, has reported an outcome of its last tap if this tap
        was withdrawn."""
        report = self._report
        if report is None or not report.tap_id or report.state != TapperState.SAFE:
            return
        ended = self.ended_taps.get(report.tap_id, math.inf)
        if report.tap_id in self.ended_before_restart:
            return  # the present process does not know that the tap was withdrawn
        if report.outcome == TapperState.NONE and self.scheduler.now > ended + OUTCOME_S:
            self.violate(
                "tap without an outcome",
                f"tap {report.tap_id} was withdrawn {self.scheduler.now - ended:.1f} s ago, but the"
                " tapper has not reported an outcome",
            )

    def _on_tapper_state(self, message: TapperState) -> None:
        self._report = message
        self.command_checker.on_tapper_state(message)
        latched = self._latched.get("tapper_trigger", math.inf)
        self.board_checker.on_tapper_state(message, latched)
        self._note_stop("tapper_trigger", message, message.state == TapperState.STOPPED)
        # A node that was frozen handles the command and the state at the same time.
        waited_for = self._tapping_received >= self._first_taken.get(message.tap_id, -math.inf)
        if GAVE_UP in message.error_msg and not waited_for:
            self.violate(
                "false reason",
                f"tap {message.tap_id} ended because the planner no longer waits for it, but the"
                " tapper has not received that a planner waited for it",
            )
        fired = any(release.shot == message.tap_id for release in self.physical.releases)
        if message.tap_id and message.outcome != TapperState.NONE:
            before = self.outcomes.get(message.tap_id, message.outcome)
            if TapperState.UNKNOWN not in (before, message.outcome) and before != message.outcome:
                self.violate(
                    "other outcome",
                    f"tap {message.tap_id} was reported with outcome"
                    f" {_OUTCOMES.get(before, before)}, now with"
                    f" {_OUTCOMES.get(message.outcome, message.outcome)}",
                )
            self.outcomes[message.tap_id] = message.outcome
            if message.outcome == TapperState.FIRED and not fired:
                self.violate(
                    "false report", f"tap {message.tap_id} is reported FIRED, but was not fired"
                )
        if message.state == TapperState.SAFE and self._charged_since is not None:
            since = self.scheduler.now - self._charged_since
            if since > 0.6 and message.tap_id != 0:
                self.violate(
                    "reported SAFE while charged",
                    f"the tapper is reported SAFE, but has been charged for {since:.2f} s",
                )

    def _on_plan_state(self, message: PlanState) -> None:
        goal = message.goal.pose.position
        before, after = self._waiting, (message.state, goal.x, goal.y, goal.z)
        self._waiting = after
        if before != after:
            self._plan_state_since = self.scheduler.now
        waited = self.scheduler.now - self._plan_state_since
        if waited > self.deadlines.get(message.state, math.inf) + WAIT_SLACK_S:
            self.violate(
                "waits too long",
                f"the planner has waited in PlanState {message.state} for {waited:.1f} s (limit"
                f" {self.deadlines[message.state] + WAIT_SLACK_S:g} s)",
            )
            self._plan_state_since = self.scheduler.now
        if message.state != PlanState.PLANNING:
            self._computation = 0
        if message.state == PlanState.FAILED and before[0] != PlanState.FAILED:
            self._check_cause(message.error_code)
        if message.state in ENDED:
            if self._goal is not None:
                self._check_count("the planner reports", self._goal, message.taps)
                self._check_withdrawn()
            self._goal = None
        elif self._goal is None or before[1:] != after[1:]:
            self._begin_goal(message)
        self._check_time_limit()
        self._check_tolerance(message)
        if message.state == PlanState.REACHED and before[0] != PlanState.REACHED:
            tolerance = message.position_tolerance, message.angle_tolerance
            self._check_claim("the planner reports", from_message(message.goal.pose), tolerance)

    def _check_tolerance(self, message: PlanState) -> None:
        """Check that the planner pursues its goal with the requested tolerance."""
        if self._goal is None or self._goal not in self.tolerances:
            return
        position, angle = self.tolerances[self._goal]
        off = abs(message.position_tolerance - position)
        if off > ROUNDING_S or abs(message.angle_tolerance - angle) > ROUNDING_S:
            self.violate(
                "other tolerance",
                f"the planner reports a tolerance of {1e3 * message.position_tolerance:.3f} mm and"
                f" {math.degrees(message.angle_tolerance):.3f} deg, but {1e3 * position:.3f} mm and"
                f" {math.degrees(angle):.3f} deg were requested",
            )

    def _check_cause(self, code: int) -> None:
        """Check that the goal did not fail because a device was busy if this device had told the
        planner of an error."""
        for kind, busy in (
            (ArmState, ErrorCode.ARM_BUSY),
            (TapperState, ErrorCode.TAPPER_BUSY),
        ):
            last = self._received.get(kind)
            if code == busy and last is not None and last.error_code:
                self.violate(
                    "vague cause",
                    f"the goal failed with code {code} (busy), but the last state that the planner"
                    f" received reports code {last.error_code}: {last.error_msg}",
                )

    def _check_time_limit(self) -> None:
        """Check that the present goal has not exceeded its time limit, also if the planner crashed
        since and resumed the goal."""
        if self._goal is None:
            return
        now, began = self.scheduler.now, self._began_at[self._goal]
        limit = self.time_limits.get(self._goal, self.goal_time_limit)
        end = max(began + limit, self._goal_begun_at, self.planner_frozen_until())
        if now > end + LATE_END_S:
            self.violate(
                "exceeds its time limit",
                f"the planner has worked on a goal for {now - began:.1f} s, but the goal's time"
                f" limit is {limit:.1f} s",
            )
            self._began_at[self._goal] = now

    def _check_withdrawn(self) -> None:
        """Check that no tap of the goal that has just ended can still be fired."""
        tap_id, self._tap_to_withdraw = self._tap_to_withdraw, 0
        if tap_id:
            self.violate(
                "tap outlives its goal",
                f"the planner has ended its goal without withdrawing tap {tap_id}",
            )

    def _check_claim(self, who: str, goal: Pose, tolerance: tuple[float, float]) -> None:
        """Check that the object is truly at the goal, within these tolerances (m and rad)."""
        true = self.physical.object_pose(self.scheduler.now)
        off, turned = goal.distance_to(true), abs(goal.rotation_to(true))
        position, angle = tolerance
        moved = self.moved_by_hand
        recently = moved is not None and self.scheduler.now - moved[0] < self.unseen_limit
        if (off > position or turned > angle) and not recently:
            self.violate(
                "false claim",
                f"{who} that the goal is reached, but the object is {1e3 * off:.3f} mm and"
                f" {math.degrees(turned):.3f} deg away from it (tolerance {1e3 * position:.3f} mm,"
                f" {math.degrees(angle):.3f} deg)",
            )

    def at_the_end(self) -> None:
        """Compare every reported outcome with all releases of the run, including releases after the
        report."""
        fired = {release.shot for release in self.physical.releases}
        for shot, outcome in self.outcomes.items():
            if outcome == TapperState.NOT_FIRED and shot in fired:
                self.violate("false report", f"tap {shot} was reported NOT_FIRED, but was fired")
