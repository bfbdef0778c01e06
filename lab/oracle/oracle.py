"""Oracle of a run: truths that a high-speed camera and a recorder beside the cell can check.

The oracle sees the ground truth (what moved, what was fired), the wire (what was published,
delivered, promised and answered) and what people did. It knows neither the states of the product's
logic nor its timing; every limit is that of the safety argument (docs/safety.md).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from lab.virtual_cell.host import HostClock
from lab.virtual_cell.network import Network
from lab.virtual_cell.physical_cell import PhysicalCell, Release
from lab.virtual_cell.scheduler import Scheduler
from tapping_cell.hardware.axis_units import joints_text
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic.clock import to_nanoseconds
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import (
    ArmState,
    Bool,
    ErrorCode,
    HoldStill,
    JointTrajectory,
    ObjectState,
    ObjectStates,
    PlanState,
    PositionObject,
    TapCommand,
    TapperState,
)
from tapping_cell.se2 import Pose

WINDOW_S = 0.1
"""Longest firing window of the board: a FIRE that was sent before an event may release after it."""
STRIKE_M, STRIKE_RAD, STRIKE_HEIGHT_M = 0.0025, 0.01, 0.0005
"""Maximum deviations of the true tip from the commanded strike pose."""
ENERGY_SHARE = 0.03
"""Maximum relative excess of the energy of a shot."""
BUMP_M, BUMP_RAD = 0.004, math.radians(6.0)
"""Displacement of the object beyond which its tap must not be fired."""
PULSE_S = 0.02
"""Duration of the release pulse, which the arm's promise covers in addition to the flight."""
SILENCE_S = {"camera": 0.45, "plan_state": 1.5, "arm_state": 0.3}
"""Maximum time from the last message that the tapper received to the last check before FIRE."""
CHARGED_S = 12.0
"""Maximum time for which a striker may stay charged, whatever fails."""
CARRIED_S, RELAXED_S = 0.65, 2.5
"""Within these times after the report and after the begin of charging, the arm must not leave."""
STOPPED_S = 1.5
"""Maximum time from the delivery of a stop until the arm is at rest."""
DEACTIVATED_S = 0.2
"""Maximum time from the deactivation of the arm's node until it begins no further motion."""
HOMED_S = 3.0
"""Maximum time for which an arm that has lost its reference may still be reported as homed."""
SAFE_S = 0.6
"""Maximum time for which a charged striker may be reported as SAFE."""
ROUNDING_S = 1e-6
"""Tolerance for the rounding of times on the clocks of the processes."""
CHARGED_BOARD = ("CHARGING", "CHARGED")
"""States of a tapper's board in which its striker is or may be charged."""
CHARGED = (TapperState.CHARGING, TapperState.CHARGED, TapperState.FIRING)
"""Published states in which the striker is or may be charged."""
ENDED = (PlanState.IDLE, PlanState.REACHED, PlanState.FAILED, PlanState.CANCELED)
"""States of the planner without a goal."""
BLIND = (
    ErrorCode.CAMERA_SILENT,
    ErrorCode.CAMERA_NOT_CALIBRATED,
    ErrorCode.IMAGE_INVALID,
    ErrorCode.STAMP_INVALID,
)
"""Error codes of an object's state that is not based on a usable image."""
MOVE_TOLERANCE = Joints(0.005, 0.005, 0.0005, 0.01)
"""Maximum difference between the target of a completed move and the true joints, rad and m."""


@dataclass(frozen=True, slots=True)
class Violation:
    """Violation of an invariant. ``time`` is in s from the start of the run."""

    name: str
    time: float
    sentence: str


@dataclass(slots=True)
class Sight:
    """Ground truth on one object, and what the tapper has received of it. Times are in s."""

    hidden_since: float = math.inf
    seen_again: float = -math.inf
    """Time at which the object was last uncovered."""
    moved_by_hand: float = -math.inf
    received: deque[tuple[float, Pose]] = field(default_factory=lambda: deque(maxlen=100))


@dataclass(slots=True)
class Request:
    """Request of a goal: goal of each object, and tolerance (m, rad) of the claim."""

    goals: dict[str, Pose]
    tolerance: tuple[float, float]
    commanded: int
    """Number of taps that planners had commanded before the request."""


@dataclass
class Oracle:
    """Checks one run. Times are in s from the start of the run."""

    scheduler: Scheduler
    physical: PhysicalCell
    network: Network
    tapper_clock: HostClock
    unseen_limit: float
    """Time for which the object may be unseen or moved before a release."""
    violations: list[Violation] = field(default_factory=list)

    # Commands
    commands: dict[int, TapCommand] = field(default_factory=dict)
    """Last valid TAP with each id."""
    planners: list[int] = field(default_factory=list)
    """Ids of the taps that planners have commanded."""
    invalid: dict[int, str] = field(default_factory=dict)
    """Wrong field of the TAP with each of these ids."""
    invalid_trajectories: list[tuple[JointTrajectory, str]] = field(default_factory=list)
    _taken: dict[int, list[TapCommand]] = field(default_factory=dict)
    """TAP commands that the tapper's process has received."""
    _ended: dict[int, float] = field(default_factory=dict)
    """Time at which the tapper's process received the withdrawal of each tap."""
    _inactive_commands: set[int] = field(default_factory=set)
    """Taps that the tapper's process received only while its node was inactive."""

    refused_by_arm: set[int] = field(default_factory=set)
    """Those of them that the arm, too, must refuse."""

    # Stops and permissions
    stopped_at: dict[str, float] = field(default_factory=dict)
    """Time of the delivery of a stop to each device's node, until a person has cleared it."""
    motion_allowed: bool = True
    """Whether a person has allowed motion since the last crash, stop or loss of power."""
    _commanded_until: float = -math.inf
    """Time by which the arm's line has delivered what was sent before motion was forbidden."""
    _asked_to_move: bool = True
    inactive_since: dict[str, float] = field(default_factory=dict)
    """Time since which each node has been deactivated."""
    _levels: dict[str, list[Bool]] = field(default_factory=dict)
    """Messages of ``emergency_stop`` that each process has received since its start."""

    # What the tapper has heard, and the arm has promised
    _heard: dict[str, float] = field(default_factory=dict)
    promises: dict[int, float] = field(default_factory=dict)
    """End of each promise of the arm to stand still, by tap id."""
    sights: dict[str, Sight] = field(default_factory=dict)

    # Devices
    unhomed_since: float = math.inf
    """Time since which the arm has had no valid reference."""
    arm_frozen_until: float = -math.inf
    _struck_until: float = -math.inf
    """End of the flight of the striker that was released last."""
    _released: int = 0
    _charged_since: float = math.inf
    _charge_reported: float = -math.inf
    """Time at which the arm's process last received that the striker is charged."""
    _moves: bool = False
    _arm: tuple[int, int] = (ArmState.DISCONNECTED, 0)
    """State and tap id in the arm's last message."""
    _left_at: float = -math.inf
    """Time of the arm's last message of a move to a strike pose."""
    _refused_stamp: int = 0

    # Reports and goals
    outcomes: dict[int, int] = field(default_factory=dict)
    requests: list[Request] = field(default_factory=list)
    plan: PlanState = field(default_factory=PlanState)
    """Last message of the planner."""

    @property
    def own(self) -> str:
        """Name of the cell's own object."""
        return self.physical.cell.object.name

    def sight(self, name: str) -> Sight:
        """Return what is known of an object; empty: the cell's own object."""
        return self.sights.setdefault(name or self.own, Sight())

    def violate(self, name: str, sentence: str) -> None:
        """Record a violation of an invariant."""
        self.violations.append(Violation(name, self.scheduler.now, sentence))

    def on_invalid(self, tap_id: int, wrong: str, arm_refuses: bool) -> None:
        """Record that a program is about to publish a TAP with a wrong field."""
        self.invalid[tap_id] = wrong
        if arm_refuses:
            self.refused_by_arm.add(tap_id)

    # The wire: what is published

    def on_publish(self, node: str, topic: str, message: Any) -> None:
        """Record a message that a node publishes."""
        if isinstance(message, TapCommand):
            if message.request == TapCommand.TAP:
                self._on_tap(node, message)
        elif isinstance(message, TapperState) and node == "tapper_trigger":
            self._on_tapper_state(message)
        elif isinstance(message, ArmState) and node == "scara_arm":
            self._on_arm_state(message)
        elif isinstance(message, PlanState) and node == "tap_planner":
            self._on_plan_state(message)

    def _on_tap(self, node: str, command: TapCommand) -> None:
        tap_id = command.tap_id
        if node != "program":
            self.invalid.pop(tap_id, "")  # the id does not identify the invalid command any more
        if tap_id in self.invalid:
            return
        self.commands[tap_id] = command
        if node.startswith("tap_planner"):
            self.planners.append(tap_id)
        if node == "tap_planner" and self.plan.state in ENDED:
            self.violate("tap without a goal", f"tap {tap_id} was commanded without a goal")

    def _on_tapper_state(self, message: TapperState) -> None:
        tap_id, outcome = message.tap_id, message.outcome
        if tap_id in self.invalid and outcome == TapperState.NONE:
            self._violate_invalid("the tapper has accepted", tap_id)
        charged_for = self.scheduler.now - self._charged_since
        if message.state == TapperState.SAFE and tap_id and charged_for > SAFE_S:
            self.violate(
                "reported SAFE while charged",
                f"the tapper is reported SAFE, but has been charged for {charged_for:.2f} s",
            )
        if not tap_id or outcome == TapperState.NONE:
            return
        before = self.outcomes.get(tap_id, outcome)
        if TapperState.UNKNOWN not in (before, outcome) and before != outcome:
            self.violate(
                "other outcome", f"tap {tap_id} was reported with outcome {before}, now {outcome}"
            )
        self.outcomes[tap_id] = outcome
        if outcome == TapperState.FIRED and not self._fired(tap_id):
            self.violate("false report", f"tap {tap_id} is reported FIRED, but was not fired")

    def _on_arm_state(self, message: ArmState) -> None:
        now = self.scheduler.now
        if self._arm[0] == ArmState.MOVING:
            self._left_at = now
        arrived = message.state == ArmState.IN_POSITION != self._arm[0]
        self._arm = message.state, message.tap_id
        works = message.state in (ArmState.MOVING, ArmState.IN_POSITION)
        if works and message.tap_id in self.invalid.keys() & self.refused_by_arm:
            self._violate_invalid("the arm executes", message.tap_id)
        if arrived:
            self._check_arrival(message.tap_id)
        if message.clear_of_camera and self.physical.moving(now):
            self.violate("false view", "the arm is reported clear of the camera while it moves")
        if message.state == ArmState.HOMING:
            self.unhomed_since = math.inf
        lost = now - max(self.unhomed_since, self.arm_frozen_until)
        stamp = to_nanoseconds(message.header.stamp)
        if message.homed and stamp != self._refused_stamp and lost > HOMED_S:
            self.violate(
                "false reference",
                f"the arm is reported as homed {lost:.1f} s after its board lost its position",
            )
            self.unhomed_since = math.inf
        self._refused_stamp = stamp
        if message.state == ArmState.IDLE or message.error_code == ErrorCode.NOT_ACTIVE:
            self._asked_to_move = False

    def _check_arrival(self, tap_id: int) -> None:
        """Check that an arm that is reported in position is at a strike pose of its tap."""
        known = [one for one in self._variants(tap_id) if tap_id]
        if math.isfinite(self.unhomed_since) or not known:
            return
        tip, height = self.physical.tip(self.scheduler.now)
        if not any(self._is_at(one, tip, height) for one in known):
            self.violate(
                "false position",
                f"the arm is reported in position for tap {tap_id}, but is not at its strike pose",
            )

    @staticmethod
    def _is_at(command: TapCommand, tip: Pose, height: float) -> bool:
        wanted = from_message(command.strike_pose)
        return (
            wanted.distance_to(tip) <= STRIKE_M
            and abs(wanted.rotation_to(tip)) <= STRIKE_RAD
            and abs(height - command.strike_pose.position.z) <= STRIKE_HEIGHT_M
        )

    def _variants(self, tap_id: int) -> list[TapCommand]:
        """Return all commands with this id that are known from the wire."""
        commands = [one for one in self.network.history.get("tap_command", ())]
        found = [one for one in commands if one.tap_id == tap_id]
        return [one for one in found if one.request == TapCommand.TAP] + self._taken.get(tap_id, [])

    def _on_plan_state(self, message: PlanState) -> None:
        before, self.plan = self.plan, message
        goal, name = from_message(message.goal.pose), message.object_id or self.own
        if self.is_pursuing() and not any(map(self._is_plan_of, self.requests)):
            self.violate("goal of nobody", f"the planner pursues {goal} of '{name}', not requested")
        if message.state == PlanState.REACHED != before.state:
            tolerance = message.position_tolerance, message.angle_tolerance
            self._check_claim("the planner reports", name, goal, tolerance)

    def _violate_invalid(self, who: str, tap_id: int) -> None:
        wrong = self.invalid[tap_id]
        self.violate("executed an invalid command", f"{who} tap {tap_id}; wrong field: {wrong}")

    # The wire: what is delivered and answered

    def on_delivered(self, process: str, topic: str, message: Any, active: bool) -> None:
        """Record a message that a process has handled. ``active``: whether its node is active."""
        now = self.scheduler.now
        if topic == "emergency_stop":
            self._levels.setdefault(process, []).append(message)
            if process == "tap_planner" and message.data and self.plan.state not in ENDED:
                self.violate("goal outlives a stop", "the planner goes on after a stop")
        elif process == "scara_arm":
            self._on_delivered_to_arm(topic, message)
        elif process != "tapper_trigger":
            return
        elif topic in ("arm_state", "plan_state"):
            self._heard[topic] = now
        elif isinstance(message, ObjectStates):
            if message.objects[0].error_code not in BLIND:
                self._heard["camera"] = now
            for state in message.objects:
                self._on_sight(state)
        elif topic == "tap_command" and message.request == TapCommand.TAP:
            taken = self._taken.setdefault(message.tap_id, [])
            if not taken or taken[-1].header.stamp != message.header.stamp:
                self._ended.pop(message.tap_id, None)  # a new command, not a copy
            taken.append(message)
            change = self._inactive_commands.discard if active else self._inactive_commands.add
            change(message.tap_id)
        elif topic == "tap_command" and message.request == TapCommand.WITHDRAW:
            if message.tap_id in self._taken:
                self._ended.setdefault(message.tap_id, now)

    def _on_sight(self, state: ObjectState) -> None:
        """Record the pose of an object that the tapper's process has received."""
        if state.visible:
            pose = from_message(state.pose.pose)
            self.sight(state.object_id).received.append((self.scheduler.now, pose))

    def _on_delivered_to_arm(self, topic: str, message: Any) -> None:
        if topic == "tapper_state" and message.state in CHARGED:
            self._charge_reported = self.scheduler.now
        if topic == "joint_trajectory" and self._arm == (ArmState.MOVING, 0) and self._moves:
            return  # an earlier trajectory is under way
        if topic == "joint_trajectory" and self._arm == (ArmState.MOVING, 0):
            for one, wrong in self.invalid_trajectories:
                if one == message:
                    self.violate("followed an invalid trajectory", f"the arm follows it: {wrong}")

    def ask_to_move(self) -> None:
        """Record that the arm was asked to move; this counts until it is idle again."""
        self._asked_to_move = True

    def on_answer(self, node: str, request: Any, response: Any) -> None:
        """Record the answer of a node to a service call."""
        if node != "scara_arm" or not isinstance(request, HoldStill.Request):
            return
        if not (isinstance(response, HoldStill.Response) and response.granted):
            return
        before = self.promises.get(request.tap_id, -math.inf)
        if self._arm != (ArmState.IN_POSITION, request.tap_id):
            self.violate(
                "empty promise",
                f"the arm promised to stand still for tap {request.tap_id} in state {self._arm[0]}"
                f" for tap {self._arm[1]}",
            )
        self.promises[request.tap_id] = max(before, self.scheduler.now + request.duration)

    def on_cleared(self, node: str, asked: bool) -> None:
        """Record that a node has published that it keeps no stop. ``asked``: whether a person has
        asked for it since the last stop."""
        received = self._levels.get(node, ())
        for level in self.network.latched("emergency_stop").values():
            if level.data and any(level is one for one in received) and asked:
                self.violate("cleared while pressed", f"{node} has cleared a stop that is asserted")
        if asked:
            self.stopped_at.pop(node, None)

    # Life of the processes

    def on_process_lost(self, node: str) -> None:
        """Record the end of a process."""
        self._levels.pop(node, None)
        self.inactive_since.pop(node, None)
        if node == "scara_arm":
            self.forbid_motion()
            self._arm = ArmState.DISCONNECTED, 0
        elif node == "tapper_trigger":
            self._heard = dict.fromkeys(self._heard, -math.inf)
            for sight in self.sights.values():
                sight.received.clear()
        elif node == "tap_planner":
            self.plan = PlanState()

    def on_lifecycle(self, node: str, active: bool) -> None:
        """Record the activation or deactivation of a node."""
        if active:
            self.inactive_since.pop(node, None)
            return
        self.inactive_since[node] = self.scheduler.now
        if node == "tap_planner" and self.plan.state not in ENDED:
            self.violate("goal outlives its deactivation", "the goal has not ended")

    def forbid_motion(self) -> None:
        """Record that the arm may not begin to move until a person allows it."""
        self.motion_allowed = False
        self._commanded_until = self.physical.arm_line.layer.delivered_by(self.scheduler.now)

    def lose_reference(self) -> None:
        """Record that the arm's board has lost its position."""
        if self._arm[0] != ArmState.HOMING:
            self.forbid_motion()
        self.unhomed_since = min(self.unhomed_since, self.scheduler.now)

    def note_hand(self, name: str = "") -> None:
        """Record that a hand moves an object now."""
        self.sight(name).moved_by_hand = self.scheduler.now

    def hide(self, name: str = "") -> None:
        """Record that something covers an object from now on."""
        sight = self.sight(name)
        sight.hidden_since = min(sight.hidden_since, self.scheduler.now)

    def uncover(self, name: str = "") -> None:
        """Record that an object is in view again."""
        sight = self.sight(name)
        sight.hidden_since, sight.seen_again = math.inf, self.scheduler.now

    # The world

    def after_event(self) -> None:
        """Check the releases, the charge and the motion after an event."""
        releases = self.physical.releases
        while self._released < len(releases):
            earlier = releases[: self._released]
            self._check_release(releases[self._released], earlier)
            self._released += 1
        self._check_charge()
        self._check_motion()

    def _check_release(self, release: Release, earlier: list[Release]) -> None:
        shot, now = release.shot, release.time
        if any(before.shot == shot for before in earlier):
            self.violate("fired twice", f"shot {shot} was released twice")
        if release.moving:
            self.violate("arm moving", f"shot {shot} was released while the arm moved")
        if shot in self.invalid:
            self._violate_invalid("the tapper has fired", shot)
        command = self.command_of(release)
        if command is None:
            self.violate("no such tap", f"shot {shot} was released without a command")
            return
        self._check_strike(release, command)
        self._struck_until = now + self.physical.flight(command.striker_speed)
        self._check_promise(release)
        expiry = 1e-9 * (self.tapper_clock.now().ros - to_nanoseconds(command.expiry))
        self.require_before("expired", release, now - expiry, "its command had expired")
        stopped, inactive = (
            since.get("tapper_trigger") for since in (self.stopped_at, self.inactive_since)
        )
        self.require_before("after a stop", release, stopped, "a stop was delivered")
        self.require_before("tapper inactive", release, inactive, "its deactivation")
        self.require_before("after its end", release, self._ended.get(shot), "its withdrawal")
        for source, limit in SILENCE_S.items():
            if source in self._heard and (source != "plan_state" or shot in self.planners):
                self.require_before(
                    f"{source} silent",
                    release,
                    self._heard[source] + limit,
                    f"the tapper should have refused it, without {source} for {limit:g} s",
                )
        if shot in self._inactive_commands:
            self.violate("command while inactive", f"shot {shot} was commanded while inactive")
        self._check_scene(release, command, release.object_pose)

    def require_before(self, name: str, release: Release, time: float | None, what: str) -> None:
        """Check that a release was at most ``WINDOW_S`` after an event that forbids it."""
        if time is not None and release.time > time + WINDOW_S:
            self.violate(
                name,
                f"shot {release.shot} was released {release.time - time:.3f} s after {what}",
            )

    def command_of(self, release: Release) -> TapCommand | None:
        """Return the command that caused a release: of all with its id, that of the nearest
        strike."""

        def difference(command: TapCommand) -> tuple[float, int]:
            excess = abs(release.energy / self.physical.energy_for(command.striker_speed) - 1.0)
            off = self.difference_of_place(command, release) + excess / ENERGY_SHARE
            return round(off, 6), -to_nanoseconds(command.expiry)

        variants = self._taken.get(release.shot)
        return min(variants, key=difference) if variants else None

    def difference_of_place(self, command: TapCommand, release: Release) -> float:
        """Return how far the strike of a command is from a release, as a multiple of the limits."""
        pose = from_message(command.strike_pose)
        turn = abs(pose.rotation_to(release.tip))
        return pose.distance_to(release.tip) / STRIKE_M + turn / STRIKE_RAD

    def _check_strike(self, release: Release, command: TapCommand) -> None:
        """Check place and energy of a strike."""
        asked = self.physical.energy_for(command.striker_speed)
        if release.energy > (1.0 + ENERGY_SHARE) * asked:
            self.violate(
                "too much energy",
                f"shot {release.shot} was released with {1e3 * release.energy:.2f} mJ, but"
                f" {1e3 * asked:.2f} mJ were requested",
            )
        self.check_place(release, command)

    def check_place(self, release: Release, command: TapCommand) -> None:
        """Check that the striker was at the commanded strike pose."""
        if not self._is_at(command, release.tip, release.height):
            wanted = from_message(command.strike_pose)
            self.violate(
                "arm elsewhere",
                f"shot {release.shot} was released"
                f" {1e3 * wanted.distance_to(release.tip):.2f} mm from its strike pose",
            )

    def _check_promise(self, release: Release) -> None:
        """Check that the arm has promised to stand still until the end of the flight."""
        if self._struck_until + PULSE_S > self.promises.get(release.shot, -math.inf):
            self.violate(
                "outside the promise",
                f"shot {release.shot} was released without a promise of the arm to stand still"
                " until the end of the stroke",
            )

    def _check_scene(self, release: Release, command: TapCommand, true: Pose) -> None:
        """Check that the object was seen, where the tap was planned for it, at a release."""
        sight, planned = self.sight(command.object_id), from_message(command.object_pose)
        limit = self.unseen_limit - WINDOW_S
        self.require_before("unseen", release, sight.hidden_since + limit, "the object was unseen")
        if _is_bumped(planned, true) and release.time > sight.moved_by_hand + self.unseen_limit:
            self.violate(
                "object elsewhere",
                f"shot {release.shot} was released with the object"
                f" {1e3 * planned.distance_to(true):.1f} mm from where its tap was planned",
            )
        since = math.inf
        for received, pose in reversed(sight.received):
            if not _is_bumped(planned, pose):
                break
            since = received
        self.require_before("against what it saw", release, since, "the tapper saw it elsewhere")

    def _check_charge(self) -> None:
        now = self.scheduler.now
        if not self.is_charged():
            self._charged_since = math.inf
            return
        self._charged_since = min(self._charged_since, now)
        if now > self._charged_since + CHARGED_S:
            self.violate("left charged", f"a striker has been charged for over {CHARGED_S:g} s")
            self._charged_since = now

    def is_charged(self) -> bool:
        """Return whether a striker is or may be charged."""
        return self.physical.tapper_board.state in CHARGED_BOARD

    def _check_motion(self) -> None:
        now = self.scheduler.now
        before, self._moves = self._moves, self.physical.moving(now)
        if self._moves and not before:
            self._check_begin(now)
        stopped = self.stopped_at.get("scara_arm", math.inf)
        if self._moves and now > stopped + STOPPED_S:
            self.violate("moves while stopped", f"the arm moves {now - stopped:.2f} s after a stop")
            self.stopped_at["scara_arm"] = math.inf

    def _check_begin(self, now: float) -> None:
        """Check that the arm may begin to move."""
        if not self._asked_to_move:
            self.violate("moved unasked", "the arm began to move without a request")
        if now < self._struck_until:
            self.violate(
                "moved in flight",
                f"the arm began to move {self._struck_until - now:.3f} s before the end of the"
                " stroke",
            )
        for tap_id, end in self.promises.items():
            if now < end - ROUNDING_S:
                self.violate(
                    "broken promise",
                    f"the arm began to move {end - now:.3f} s before the end of its promise to"
                    f" stand still for tap {tap_id}",
                )
        inactive = now - self.inactive_since.get("scara_arm", math.inf)
        if inactive > DEACTIVATED_S:
            self.violate("moved while inactive", f"{inactive:.2f} s after its deactivation")
        if not self.motion_allowed and now > self._commanded_until + ROUNDING_S:
            self.violate(
                "moved by itself",
                "the arm began to move without a person's permission after a crash or a stop",
            )
        # The arm goes on to its strike pose while the tapper charges.
        placing = self._arm[0] == ArmState.MOVING or now <= self._left_at + WINDOW_S
        reported, charged = now - self._charge_reported, now - self._charged_since
        if not placing and 0.0 <= charged < RELAXED_S and reported < CARRIED_S:
            self.violate(
                "carried charged",
                f"the arm left {reported:.2f} s after it had received that the striker is charged",
            )

    def check_move(self, target: Joints) -> None:
        """Check that the arm truly stands at the target of a move that its driver reports as
        completed."""
        found = self.physical.joints(self.scheduler.now)
        off = [abs(a - b) for a, b in zip(found, target, strict=True)]
        beyond = any(x > limit for x, limit in zip(off, MOVE_TOLERANCE, strict=True))
        if beyond and math.isinf(self.unhomed_since):
            self.violate(
                "false arrival",
                f"a move to {joints_text(target)} was called completed, but the arm is at"
                f" {joints_text(found)}",
            )

    # Goals

    def on_goal_sent(self, goals: dict[str, Pose], tolerance: tuple[float, float]) -> Request:
        """Record a goal that a client sends to the planner."""
        self.requests.append(Request(goals, tolerance, len(self.planners)))
        return self.requests[-1]

    def is_pursuing(self) -> bool:
        """Return whether the planner reports that it pursues a goal."""
        return self.plan.state not in ENDED

    def pursued(self) -> dict[str, Pose]:
        """Return the goals of the request that the planner pursues, by object."""
        found = [one for one in self.requests if self.is_pursuing() and self._is_plan_of(one)]
        return found[-1].goals if found else {}

    def _is_plan_of(self, request: Request) -> bool:
        """Return whether the planner's last message is on a goal of this request."""
        here = from_message(self.plan.goal.pose)
        goal = request.goals.get(self.plan.object_id or self.own)
        return (
            goal is not None
            and goal.distance_to(here) < ROUNDING_S
            and abs(goal.rotation_to(here)) < ROUNDING_S
        )

    def check_result(self, request: Request, result: Any, tap_limit: int) -> None:
        """Check the result of a goal of an action against the ground truth. ``tap_limit``: most
        taps that the goal allows; 0: any number."""
        if result.error_code == ErrorCode.NONE:
            for name, goal in request.goals.items():
                self._check_claim("the result says", name, goal, request.tolerance)
        commanded = len(self.planners) - request.commanded
        most = min(commanded, tap_limit or commanded)
        if result.taps > most or len(result.records) != result.taps:
            self.violate(
                "false count",
                f"the result gives {result.taps} taps and {len(result.records)} records; at most"
                f" {most} are possible",
            )
        if not isinstance(result, PositionObject.Result):
            self._check_progress(result, request)

    def _check_progress(self, result: Any, request: Request) -> None:
        """Check the state of each object in the result of an arrangement."""
        for progress in result.objects:
            pose, goal = from_message(progress.pose.pose), from_message(progress.goal_pose)
            off, turned = pose.distance_to(goal), abs(pose.rotation_to(goal))
            reached = progress.state == type(progress).REACHED
            inside = off <= progress.position_tolerance and turned <= progress.angle_tolerance
            if reached and not inside:
                self.violate("false progress", f"'{progress.object_id}' is not at its goal")
            missed = not reached and progress.object_id in request.goals
            if result.error_code == ErrorCode.NONE and missed:
                self.violate("false claim", f"'{progress.object_id}' has not reached its goal")

    def _check_claim(self, who: str, name: str, goal: Pose, tolerance: tuple[float, float]) -> None:
        """Check that an object is truly at its goal, within these tolerances (m and rad)."""
        with self.regarding(name):
            true = self.physical.object_pose(self.scheduler.now)
        off, turned = goal.distance_to(true), abs(goal.rotation_to(true))
        recently = self.scheduler.now < self.sight(name).moved_by_hand + self.unseen_limit
        if (off > tolerance[0] or turned > tolerance[1]) and not recently:
            self.violate(
                "false claim",
                f"{who} that '{name}' is at its goal, but it is {1e3 * off:.3f} mm and"
                f" {math.degrees(turned):.3f} deg away from it",
            )

    @contextmanager
    def regarding(self, name: str) -> Iterator[None]:
        """Let the ground truth report this object."""
        yield

    def _fired(self, tap_id: int) -> bool:
        return any(release.shot == tap_id for release in self.physical.releases)

    def at_the_end(self) -> None:
        """Compare every reported outcome with all releases of the run."""
        for shot, outcome in self.outcomes.items():
            if outcome == TapperState.NOT_FIRED and self._fired(shot):
                self.violate("false report", f"tap {shot} was reported NOT_FIRED, but was fired")


def _is_bumped(planned: Pose, pose: Pose) -> bool:
    """Return whether an object is so far from where its tap was planned that it must not be
    fired."""
    return planned.distance_to(pose) > BUMP_M or abs(planned.rotation_to(pose)) > BUMP_RAD
