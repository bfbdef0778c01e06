"""Invariants of the arm's node: which motions it begins and ends, and what it reports and
promises."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from tapping_cell.hardware.axis_units import joints_text
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic.clock import to_nanoseconds
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import ArmState, HoldStill, JointTrajectory, TapCommand
from tapping_cell.verification.host import HostClock
from tapping_cell.verification.physical_cell import PhysicalCell
from tapping_cell.verification.scheduler import Scheduler

BEFORE_FLIGHT_S, SLOWNESS = 0.17, 1.1
"""The arm promises to stand still for at most ``BEFORE_FLIGHT_S`` plus ``SLOWNESS`` times the
longest time of flight."""
FRESH_S = 0.251
"""Maximum age of the last bytes from the arm's board when the arm promises to stand still, s."""
STAMP_S = 0.001
"""Maximum time from the receipt of the last bytes from the arm's board to the stamp of the arm's
state, s."""
STEP_S = 10.0
"""Time after a step of the clock during which a stamp may have been made before the step, s."""
EXPIRED_S = 0.05
"""Maximum time from the expiry of a tap until the arm begins a further part of its way to the
strike pose, s."""
SETTLED_SHARE = 0.95
"""Minimum time from the end of a motion to a release, as a fraction of the arm's settling time."""
QUICK_SHARE = 0.95
"""Minimum duration of a move of a trajectory, as a fraction of the time that the trajectory
gives."""
SMALLEST_MOVE = 1e-3
"""Moves by less than this (rad, m) take no time that could be checked."""
ELSEWHERE_M, HEIGHT_M = 0.0025, 0.0005
"""Maximum deviations of the tip from a strike pose, horizontally and vertically, when the arm
reports that it is in position, m."""
ROUNDING = 1e-9


@dataclass(slots=True)
class ArmChecker:
    """Checks the arm's node. Times are in s from the start of the run."""

    scheduler: Scheduler
    physical: PhysicalCell
    violate: Callable[[str, str], None]
    clock: HostClock
    """Clock of the computer of the arm's node."""
    has_reference: Callable[[], bool]
    """Return whether the arm's board knows the arm's position."""
    _offset: float = math.nan
    """Offset of the clock at the last check, s."""
    _stepped_at: float = -math.inf
    """Time at which a step of the clock was last found."""
    _state: tuple[int, int] = (ArmState.DISCONNECTED, 0)
    _placed: set[int] = field(default_factory=set)
    """Ids of the taps for which the arm's process has begun to move to a strike pose."""
    _begun: int = 0
    """Id of the tap for which the arm has begun to move in the handler under way; 0: none."""
    _left: tuple[int, float] = (0, -math.inf)
    """Tap whose strike pose the arm has begun to leave in the handler under way, and the time."""
    _commands: dict[int, list[TapCommand]] = field(default_factory=dict)
    """TAP commands that the arm's process has handled, by id."""
    _follows: bool = False
    """Whether the arm has begun to follow a trajectory in the handler under way."""
    _targets: list[tuple[Joints, float]] = field(default_factory=list)
    """Joints and time from the start of the points of the trajectory that remain to be reached."""
    _invalid: list[tuple[JointTrajectory, str]] = field(default_factory=list)
    """Trajectories that the arm must refuse, each with what is wrong."""
    _point_at: float = 0.0
    """Time from the start of the last point of the trajectory, s."""
    _move: tuple[float, float] | None = None
    """Time at which the present move of a trajectory began, and its minimum duration."""
    _moved_at: float = -math.inf
    """Time of the arm's last motion."""

    def on_arm_state(self, message: ArmState) -> None:
        """Process a state that the arm's node has published."""
        before, self._state = self._state, (message.state, message.tap_id)
        self._check_stamp(message)
        if self._state == before:
            return
        tap_id = message.tap_id
        if message.state == ArmState.MOVING:
            self._follows = tap_id == 0
            self._begun = tap_id
            if tap_id in self._placed:
                self.violate(
                    "placed twice", f"the arm moves to the strike pose of tap {tap_id} again"
                )
            if tap_id:
                self._placed.add(tap_id)
        elif before[0] == ArmState.MOVING and message.state == ArmState.IN_POSITION:
            self._check_place(tap_id)
        elif message.state == ArmState.WITHDRAWING and before[0] in (
            ArmState.MOVING,
            ArmState.IN_POSITION,
        ):
            self._left = before[1], self.scheduler.now

    def _check_stamp(self, message: ArmState) -> None:
        if self.clock.offset != self._offset:
            self._offset, self._stepped_at = self.clock.offset, self.scheduler.now
        if not message.homed or self.scheduler.now < self._stepped_at + STEP_S:
            return
        now = self.clock.now()
        stamp = 1e-9 * (to_nanoseconds(message.header.stamp) - now.ros) + self.scheduler.now
        received = self.physical.arm_line.received_at
        if stamp > received + STAMP_S:
            self.violate(
                "state newer than its reading",
                f"the stamp of arm_state is {stamp - received:.3f} s newer than the last bytes from"
                " the arm's board",
            )

    def _check_place(self, tap_id: int) -> None:
        """Check that the arm truly stands at a strike pose of this tap."""
        if not self.has_reference():
            return
        tip, height = self.physical.tip(self.scheduler.now)
        for command in self._commands.get(tap_id, ()):
            off = from_message(command.strike_pose).distance_to(tip)
            if off <= ELSEWHERE_M and abs(height - self.physical.cell.strike_height) <= HEIGHT_M:
                return
        self.violate(
            "false position",
            f"the arm is reported in position for tap {tap_id}, but is not at its strike pose",
        )

    def on_tap_received(self, command: TapCommand) -> None:
        """Process a TAP that the arm's process has handled."""
        self._commands.setdefault(command.tap_id, []).append(command)
        begun, self._begun = self._begun, 0
        late = 1e-9 * (self.clock.now().ros - to_nanoseconds(command.expiry))
        if begun and begun == command.tap_id and late > EXPIRED_S:
            self.violate(
                "began an expired tap",
                f"the arm began to move for tap {begun} {late:.2f} s after its command had expired",
            )

    def on_handled(self, message: object, thawed: bool) -> None:
        """Process a message that the arm's process has handled. ``thawed``: whether the process has
        just ended a freeze, so that it handles several events at the same time."""
        (tap_id, at), self._left = self._left, (0, -math.inf)
        withdrawn = isinstance(message, TapCommand) and message.request == TapCommand.WITHDRAW
        if withdrawn and tap_id and at == self.scheduler.now and not thawed:
            assert isinstance(message, TapCommand)
            if message.tap_id != tap_id:
                self.violate(
                    "left for another tap",
                    f"the arm left the strike pose of tap {tap_id} because of the withdrawal of tap"
                    f" {message.tap_id}",
                )

    def on_trajectory_received(self, message: JointTrajectory, names: Sequence[str]) -> None:
        """Process a trajectory that the arm's process has handled. ``names``: joints of the arm."""
        follows, self._follows = self._follows, False
        if not follows:
            return
        if wrong := next((wrong for one, wrong in self._invalid if one == message), ""):
            self.violate("followed an invalid trajectory", f"the arm follows a trajectory: {wrong}")
            return
        self._targets, self._point_at = [], 0.0
        for point in message.points:
            by_name = dict(zip(message.joint_names, point.positions, strict=False))
            at = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
            self._targets.append((Joints(*(by_name[name] for name in names)), at))

    def on_invalid_trajectory(self, message: JointTrajectory, wrong: str) -> None:
        """Process that a program is about to publish a trajectory that the arm must refuse."""
        self._invalid.append((message, wrong))

    def on_start(self, target: Joints) -> None:
        """Check a move before it begins."""
        self._move = None
        state, tap_id = self._state
        if state == ArmState.MOVING and tap_id:
            self._check_expiry(tap_id)
        if (state, tap_id) != (ArmState.MOVING, 0) or not self._targets:
            return
        wanted, at = self._targets.pop(0)
        if any(abs(a - b) > ROUNDING for a, b in zip(target, wanted, strict=True)):
            self.violate(
                "other target",
                f"the arm moves to {joints_text(target)} instead of the next point of its"
                f" trajectory, {joints_text(wanted)}",
            )
        here = self.physical.joints(self.scheduler.now)
        way = max(abs(a - b) for a, b in zip(here, wanted, strict=True))
        if way > SMALLEST_MOVE and self.has_reference():
            self._move = self.scheduler.now, at - self._point_at
        self._point_at = at

    def on_end(self) -> None:
        """Check the duration of a move of a trajectory at its end."""
        move, self._move = self._move, None
        if move is None or not self.has_reference() or self._line_failed():
            return
        took = self.scheduler.now - move[0]
        if took < QUICK_SHARE * move[1]:
            self.violate(
                "moved too fast",
                f"a move of a trajectory took {took:.2f} s instead of {move[1]:.2f} s",
            )

    def _check_expiry(self, tap_id: int) -> None:
        commands = self._commands.get(tap_id)
        if not commands:
            return
        late = 1e-9 * (self.clock.now().ros - max(to_nanoseconds(one.expiry) for one in commands))
        if late > EXPIRED_S:
            self.violate(
                "moved on after the expiry",
                f"the arm began a move to the strike pose of tap {tap_id} {late:.2f} s after the"
                " expiry of its command",
            )

    def on_motion(self) -> None:
        """Process that the arm moves now."""
        self._moved_at = self.scheduler.now

    def on_release(self, shot: int) -> None:
        """Check that the arm has settled at a release."""
        rested = self.scheduler.now - self._moved_at
        least = SETTLED_SHARE * self.physical.cell.arm.settle_time
        if rested < least and self.has_reference() and not self._line_failed():
            self.violate(
                "not settled",
                f"shot {shot} was released {rested:.3f} s after the arm had come to rest (at least"
                f" {least:.3f} s)",
            )

    def _line_failed(self) -> bool:
        """Return whether the arm's line has changed bytes recently: some controllers' commands and
        replies have no checksum."""
        return self.physical.arm_line.failed_since(self.scheduler.now)

    def on_promise(self, request: HoldStill.Request) -> None:
        """Check a new promise to stand still."""
        tappers = self.physical.cell.tapper_sections.values()
        flight = max(tapper.stroke / tapper.curve().slowest for tapper in tappers)
        longest = BEFORE_FLIGHT_S + SLOWNESS * flight + ROUNDING
        if request.duration > longest:
            self.violate(
                "promise too long",
                f"the arm promised to stand still for {request.duration:.2f} s (limit {longest:.2f}"
                " s)",
            )
        age = self.scheduler.now - self.physical.arm_line.received_at
        if age > FRESH_S:
            self.violate(
                "promise on an old reading",
                f"the arm promised to stand still {age:.3f} s after the last bytes from its board",
            )

    def on_process_lost(self) -> None:
        """Process the end of the arm's process."""
        self._placed.clear()
        self._targets, self._begun, self._follows = [], 0, False
        self._state = ArmState.DISCONNECTED, 0
