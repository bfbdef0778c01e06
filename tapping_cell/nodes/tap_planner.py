"""The planning node: a goal in, tap after tap out, until the object is seen to be there.

One tap: look at the object at rest, decide, command the tap, wait until the striker was released,
withdraw, wait for rest, look again. Every wait has a deadline and a worded failure; what is not
known is looked at, and nothing is fired twice.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.duration import Duration
from rclpy.time import Time
from tapping_cell_msgs.action import PositionObject
from tapping_cell_msgs.msg import (
    ArmState,
    ErrorCode,
    ObjectState,
    PlanState,
    TapCommand,
    TapperState,
    TapRecord,
)
from visualization_msgs.msg import MarkerArray

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.schema import ConfigurationError, quantity, text
from tapping_cell.nodes.cell_node import COMMAND, LATCHED, CellNode, run
from tapping_cell.nodes.conversions import (
    covariance_from_message,
    from_message,
    to_message,
)
from tapping_cell.nodes.goals import REFUSALS, Refused, read_goal, read_tolerance
from tapping_cell.nodes.markers import cell_markers
from tapping_cell.planning import (
    Done,
    FreeSpace,
    Planner,
    PlannerSettings,
    PlanningError,
    PositioningSession,
    Refusal,
    RefusalReason,
    Strike,
    StrikeSpace,
    check_goal,
    make_planner,
)
from tapping_cell.se2 import Pose

TICK_S = 0.02
LEAST_EFFECT = 0.2
"""Share of the wanted distance below which a tap counts as without effect."""
FINAL = (PlanState.REACHED, PlanState.FAILED, PlanState.CANCELED)


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of tap_planner."""

    autostart: bool = text("configure and activate without being asked", default=True)
    cell_file: str = text("path of the cell file; empty for the package's own", default="")
    object_file: str = text("path of the object file; empty for the cell file's", default="")
    planner: str = text("planning method; empty for the cell file's", default="")
    frames_needed: int = quantity(
        "pictures at rest that a look must be fused of", "", 1, 1000, default=10
    )
    ready_deadline: float = quantity(
        "longest wait for arm, tapper and camera", "s", 1.0, 3600.0, default=30.0
    )
    look_deadline: float = quantity(
        "longest wait for the object at rest and seen", "s", 0.5, 600.0, default=10.0
    )
    place_deadline: float = quantity(
        "longest time to bring the striker to its place", "s", 1.0, 600.0, default=20.0
    )
    fire_deadline: float = quantity("longest time to draw and fire", "s", 0.5, 60.0, default=8.0)
    withdraw_deadline: float = quantity(
        "longest time to withdraw the arm", "s", 1.0, 600.0, default=20.0
    )
    silence_limit: float = quantity(
        "greatest age of what arm, tapper and camera say", "s", 0.1, 60.0, default=1.0
    )
    moved_limit: float = quantity(
        "distance by which the object may differ from where the tap was planned",
        "m",
        0.0001,
        0.1,
        default=0.002,
    )
    attempts: int = quantity(
        "taps in a row that may end without a release or without an effect", "", 1, 100, default=3
    )


@dataclass(slots=True, eq=False)
class Task:
    """One goal from its acceptance to its end."""

    message: PoseStamped
    goal: Pose
    tolerance: tuple[float, float]
    max_taps: int
    session: PositioningSession
    handle: ServerGoalHandle | None
    records: list[TapRecord] = field(default_factory=list)
    not_fired: int = 0
    without_effect: int = 0
    canceled: bool = False


@dataclass(slots=True, eq=False)
class Shot:
    """One tap from its command to its measured result."""

    tap_id: int
    task: Task
    strike: Strike
    before: Pose
    fired_at: Time | None = None
    outcome: int = TapperState.NONE
    measured_speed: float = math.nan


class TapPlanner(CellNode[Parameters]):
    """See the module's docstring."""

    def __init__(self) -> None:
        super().__init__("tap_planner", Parameters)
        self._cell: Cell | None = None
        self._space: StrikeSpace | None = None
        self._free: FreeSpace | None = None
        self._planners: dict[str, Planner] = {}
        self._object: ObjectState | None = None
        self._arm: ArmState | None = None
        self._tapper: TapperState | None = None
        self._heard = {"object": -math.inf, "arm": -math.inf, "tapper": -math.inf}
        self._task: Task | None = None
        self._shot: Shot | None = None
        self._phase = PlanState.IDLE
        self._deadline = math.inf
        self._look_after = Time(nanoseconds=0)
        self._last_tap_id = 0
        self._withdrawn_tap_id = 0
        self._said_at = 0.0
        self._last = PlanState()
        self._commands = self.create_publisher(TapCommand, "tap_command", COMMAND)
        self._states = self.create_publisher(PlanState, "plan_state", LATCHED)
        self._markers = self.create_publisher(MarkerArray, "markers", LATCHED)
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal_pose, COMMAND)
        self.create_subscription(ObjectState, "object_state", self._on_object_state, LATCHED)
        self.create_subscription(ArmState, "arm_state", self._on_arm_state, LATCHED)
        self.create_subscription(TapperState, "tapper_state", self._on_tapper_state, LATCHED)
        self._action = ActionServer(
            self,
            PositionObject,
            "position_object",
            execute_callback=self._conclude,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            handle_accepted_callback=self._on_action_goal,
            cancel_callback=self._on_cancel,
        )
        self._results: dict[bytes, PositionObject.Result] = {}
        self.create_timer(TICK_S, self._tick)

    # Life cycle

    def configure(self) -> None:
        """Read the files, make the method and the map of the table."""
        cell = load_cell(self.settings.cell_file or None, self.settings.object_file or None)
        self._cell = cell
        self._planners.clear()
        self._space = assembly.make_strike_space(cell)
        self._free = FreeSpace(self._space)
        try:
            self._planner_for(cell.tolerance)
        except PlanningError as error:
            raise ConfigurationError(f"{cell.path}: key 'goal.planner': {error}") from error

    def deactivate(self) -> None:
        """Give up the goal."""
        if self._task is not None:
            self._abandon()
            self._finish(PlanState.FAILED, ErrorCode.NOT_ACTIVE, "the planner was deactivated")

    def stop_now(self) -> None:
        """Give up the goal; arm and tapper stop by themselves."""
        if self._task is not None:
            self._abandon()
            self._finish(
                PlanState.FAILED,
                ErrorCode.EMERGENCY_STOP,
                "emergency stop: make the cell safe, clear the faults, then send the goal again",
            )

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """The phase and the goal's residual."""
        values: dict[str, object] = {
            "phase": self._phase,
            "taps": self._last.taps,
            "residual distance (mm)": f"{1000 * self._last.residual_distance:.3f}",
            "residual rotation (deg)": f"{math.degrees(self._last.residual_rotation):.3f}",
        }
        if self._last.error_code:
            return DiagnosticStatus.WARN, self._last.error_msg, values
        return DiagnosticStatus.OK, "ok", values

    # Goals

    def _on_goal_pose(self, message: PoseStamped) -> None:
        refused = self._take(message, 0.0, 0.0, 0, None)
        if refused is not None:
            self.get_logger().error(f"goal refused ({refused.code}): {refused.sentence}")
            self._say(refused.code, refused.sentence)

    def _on_action_goal(self, handle: ServerGoalHandle) -> None:
        request = handle.request
        refused = self._take(
            request.goal_pose,
            request.position_tolerance,
            request.angle_tolerance,
            request.max_taps,
            handle,
        )
        if refused is not None:
            self.get_logger().error(f"goal refused ({refused.code}): {refused.sentence}")
            self._answer(handle, self._result(refused.code, refused.sentence, []))

    def _take(
        self,
        message: PoseStamped,
        position_tolerance: float,
        angle_tolerance: float,
        max_taps: int,
        handle: ServerGoalHandle | None,
    ) -> Refused | None:
        """Take a goal in place of the present one, or say why not."""
        if not self.active or self._cell is None or self._space is None:
            return Refused(ErrorCode.NOT_ACTIVE, "the planner is not active; activate it first")
        if self.stopped:
            return Refused(
                ErrorCode.EMERGENCY_STOP,
                "the emergency stop is latched; make the cell safe, clear the faults, then send "
                "the goal again",
            )
        goal = read_goal(message, self.get_clock().now().nanoseconds * 1e-9)
        if isinstance(goal, Refused):
            return goal
        tolerance = read_tolerance(position_tolerance, angle_tolerance, self._cell.tolerance)
        if isinstance(tolerance, Refused):
            return tolerance
        limit = self._cell.file.goal.max_taps
        if max_taps > limit:
            return Refused(
                ErrorCode.GOAL_BAD_TAP_LIMIT,
                f"max_taps is {max_taps}, the cell allows {limit}; ask for at most that many",
            )
        unreachable = check_goal(goal, self._space, self._free)
        if unreachable is not None:
            return Refused(REFUSALS[unreachable.reason], unreachable.sentence)
        session = PositioningSession(
            goal, self._planner_for(tolerance), self._space, self._free, most_taps=max_taps or limit
        )
        self._begin(Task(message, goal, tolerance, max_taps or limit, session, handle))
        return None

    def _planner_for(self, tolerance: tuple[float, float]) -> Planner:
        """The planning method for a tolerance, made once and kept."""
        assert self._cell is not None
        settings: PlannerSettings = assembly.make_planner_settings(self._cell, tolerance)
        key = settings.key()
        if key not in self._planners:
            name = self.settings.planner or self._cell.file.goal.planner
            self._planners[key] = make_planner(name, settings, background=True)
        return self._planners[key]

    def _begin(self, task: Task) -> None:
        if self._task is not None:
            self._abandon()
            self._finish(
                PlanState.CANCELED, ErrorCode.GOAL_REPLACED, "a newer goal took this one's place"
            )
        self._task = task
        self.get_logger().info(
            f"goal x {1000 * task.goal.x:.1f} mm, y {1000 * task.goal.y:.1f} mm, "
            f"{math.degrees(task.goal.theta):.1f} deg"
        )
        self._enter(PlanState.WAITING_FOR_CELL, self.settings.ready_deadline)

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        task = self._task
        if task is None or task.handle is not handle:
            return CancelResponse.REJECT
        task.canceled = True
        return CancelResponse.ACCEPT

    # What is heard

    def _on_object_state(self, message: ObjectState) -> None:
        self._object = message
        self._heard["object"] = time.monotonic()

    def _on_arm_state(self, message: ArmState) -> None:
        self._arm = message
        self._heard["arm"] = time.monotonic()

    def _on_tapper_state(self, message: TapperState) -> None:
        self._tapper = message
        self._heard["tapper"] = time.monotonic()

    def _silent(self, who: str) -> bool:
        return time.monotonic() - self._heard[who] > self.settings.silence_limit

    # The cycle

    def _tick(self) -> None:
        if not self.active:
            return
        if self._task is not None:
            if self._task.canceled:
                self._abandon()
                self._finish(PlanState.CANCELED, ErrorCode.GOAL_CANCELED, "the goal was canceled")
            else:
                {
                    PlanState.WAITING_FOR_CELL: self._wait_for_cell,
                    PlanState.LOOKING: self._look,
                    PlanState.PLACING: self._wait_for_arm,
                    PlanState.FIRING: self._wait_for_tapper,
                    PlanState.SETTLING: self._wait_for_withdrawal,
                }[self._phase]()
        if time.monotonic() - self._said_at > 0.5:
            self._say(self._last.error_code, self._last.error_msg)

    def _wait_for_cell(self) -> None:
        """Wait until arm, tapper and camera are ready; end a tap that a restart left behind."""
        missing = self._missing()
        if missing is None:
            self._look_after = self.get_clock().now()
            self._enter(PlanState.LOOKING, self.settings.look_deadline)
            return
        arm = self._arm
        if arm is not None and arm.tap_id and arm.state in (ArmState.IN_POSITION, ArmState.MOVING):
            self._withdraw(arm.tap_id)
        if self._late():
            code, sentence = missing
            self._fail(code, f"the cell was not ready: {sentence}")

    def _missing(self) -> tuple[int, str] | None:
        """What keeps the cell from tapping; None when nothing does."""
        arm, tapper = self._arm, self._tapper
        if arm is None or self._silent("arm"):
            return ErrorCode.ARM_SILENT, "the arm's driver says nothing; start scara_arm"
        if arm.state != ArmState.IDLE or not arm.homed:
            code = arm.error_code or ErrorCode.ARM_BUSY
            return code, arm.error_msg or "the arm is busy"
        if tapper is None or self._silent("tapper"):
            return ErrorCode.TAPPER_SILENT, "the tapper's driver says nothing; start tapper_trigger"
        if tapper.state != TapperState.SAFE:
            code = tapper.error_code or ErrorCode.TAPPER_BUSY
            return code, tapper.error_msg or "the tapper is busy"
        if not tapper.interlock_closed:
            return ErrorCode.TAPPER_INTERLOCK_OPEN, "the tapper's interlock is open; close it"
        if self._object is None or self._silent("object"):
            return ErrorCode.CAMERA_SILENT, "the camera's node says nothing; start camera_pose"
        return None

    def _fault(self) -> tuple[int, str] | None:
        """A fault of arm or tapper that needs a person; None where there is none."""
        for state, faults in (
            (self._arm, (ArmState.FAULT, ArmState.STOPPED, ArmState.NOT_HOMED)),
            (self._tapper, (TapperState.FAULT, TapperState.STOPPED)),
        ):
            if state is not None and state.state in faults:
                return state.error_code or ErrorCode.NOT_READY, state.error_msg
        return None

    def _lost(self) -> bool:
        """True when arm or tapper went away: their drivers come back by themselves."""
        arm, tapper = self._arm, self._tapper
        return (
            self._silent("arm")
            or self._silent("tapper")
            or (arm is not None and arm.state == ArmState.DISCONNECTED)
            or (tapper is not None and tapper.state == TapperState.DISCONNECTED)
        )

    def _look(self) -> None:
        """Look at the object at rest, take in the last tap, decide on the next."""
        seen = self._object
        fresh = (
            seen is not None
            and not self._silent("object")
            and Time.from_msg(seen.header.stamp) > self._look_after
        )
        if seen is not None and fresh and self._usable(seen):
            decision = self._decide(seen)
            waiting = (
                isinstance(decision, Refusal)
                and decision.reason is RefusalReason.CAMERA_TOO_COARSE
                and not self._late()
            )
            if not waiting:
                self._act(decision, seen)
            return
        if not self._late():
            return
        if self._silent("object"):
            self._fail(ErrorCode.CAMERA_SILENT, "the camera's node says nothing; look after it")
        elif seen is not None and seen.error_code:
            self._fail(seen.error_code, seen.error_msg)
        elif seen is not None and not seen.visible:
            self._fail(ErrorCode.OBJECT_NOT_SEEN, "the object is not seen; uncover its marker")
        else:
            self._fail(
                ErrorCode.OBJECT_NOT_AT_REST,
                f"the object was not at rest within {self.settings.look_deadline:.0f} s; hold "
                "nothing against it and send the goal again",
            )

    def _usable(self, seen: ObjectState) -> bool:
        return bool(
            seen.visible
            and seen.at_rest
            and seen.error_code == ErrorCode.NONE
            and seen.frames_fused >= self.settings.frames_needed
        )

    def _decide(self, seen: ObjectState) -> Done | Strike | Refusal:
        assert self._task is not None
        pose = from_message(seen.pose.pose)
        covariance = covariance_from_message(seen.pose.covariance)
        shot, self._shot = self._shot, None
        if shot is not None and shot.outcome != TapperState.NOT_FIRED and shot.task is self._task:
            self._task.session.observe(shot.strike, shot.before, pose, covariance)
            self._task.records.append(self._record(shot, seen))
            wanted = math.hypot(shot.strike.wanted.x, shot.strike.wanted.y)
            moved = shot.before.distance_to(pose) > LEAST_EFFECT * wanted
            self._task.without_effect = 0 if moved else self._task.without_effect + 1
            self._said_at = 0.0
        return self._task.session.decide(pose, covariance)

    def _act(self, decision: Done | Strike | Refusal, seen: ObjectState) -> None:
        assert self._task is not None
        if isinstance(decision, Done):
            self._finish(PlanState.REACHED, ErrorCode.NONE, "")
        elif isinstance(decision, Refusal):
            self._fail(REFUSALS[decision.reason], decision.sentence)
        elif self._task.without_effect >= self.settings.attempts:
            self._fail(
                ErrorCode.TAP_WITHOUT_EFFECT,
                f"{self._task.without_effect} taps in a row moved the object by less than "
                f"{100 * LEAST_EFFECT:.0f} % of what was wanted; look whether the striker reaches "
                "it at the right height, and calibrate arm and tapper",
            )
        elif len(self._task.records) >= self._task.max_taps:
            self._fail(
                ErrorCode.TAP_LIMIT_REACHED,
                f"{len(self._task.records)} taps did not bring the object to the goal, the limit "
                f"is {self._task.max_taps}; {1000 * self._last.residual_distance:.2f} mm and "
                f"{math.degrees(self._last.residual_rotation):.2f} deg remain",
            )
        else:
            missing = self._missing()
            if missing is not None:
                self._enter(PlanState.WAITING_FOR_CELL, self.settings.ready_deadline)
                return
            self._command(decision, from_message(seen.pose.pose))

    def _command(self, strike: Strike, before: Pose) -> None:
        """Publish one tap, under an id that was never used before."""
        assert self._task is not None
        # Whole seconds of the system clock: ids rise over restarts of every node, and fit the
        # tapper's 32 bits until 2106. Two taps are always more than a second apart.
        self._last_tap_id = max(self._last_tap_id + 1, int(time.time()))
        now = self.get_clock().now()
        allowance = self.settings.place_deadline + self.settings.fire_deadline
        command = TapCommand(
            request=TapCommand.TAP,
            tap_id=self._last_tap_id,
            striker_speed=strike.plan.striker_speed,
            expiry=(now + Duration(seconds=allowance)).to_msg(),
        )
        command.header.stamp = now.to_msg()
        command.header.frame_id = "table"
        assert self._cell is not None
        command.strike_pose = to_message(strike.plan.strike_pose, self._cell.file.arm.strike_height)
        command.object_pose = to_message(before)
        command.predicted_pose = to_message(strike.predicted)
        self._shot = Shot(self._last_tap_id, self._task, strike, before)
        self._commands.publish(command)
        if strike.detour:
            self.get_logger().info(f"tap {len(self._task.records) + 1}: {strike.detour}")
        self._enter(PlanState.PLACING, self.settings.place_deadline)

    def _wait_for_arm(self) -> None:
        """The arm brings the striker to its place; the tapper waits for it."""
        shot, arm = self._shot, self._arm
        assert shot is not None
        if self._object_was_moved(shot):
            self.get_logger().warning("the object was moved before the tap; looking again")
            self._abandon()
            return
        if self._tapper_answered(shot):
            return
        if arm is not None and arm.tap_id == shot.tap_id and arm.state == ArmState.IN_POSITION:
            self._enter(PlanState.FIRING, self.settings.fire_deadline)
            return
        self._guard(
            ErrorCode.ARM_TIMEOUT,
            f"the striker was not in its place within {self.settings.place_deadline:.0f} s",
        )

    def _wait_for_tapper(self) -> None:
        """The tapper draws and fires once."""
        shot = self._shot
        assert shot is not None
        if self._object_was_moved(shot):
            # It may be the tap itself, seen before the tapper's report: withdrawing is right in
            # both cases, and the outcome stays what the tapper says.
            self._withdraw(shot.tap_id)
        if self._tapper_answered(shot):
            return
        if self._late() or self._lost():
            shot.outcome = TapperState.UNKNOWN
            self.get_logger().warning("the tap's outcome is not known; looking at the object")
            self._withdraw(shot.tap_id)
            self._enter(PlanState.SETTLING, self.settings.withdraw_deadline)

    def _tapper_answered(self, shot: Shot) -> bool:
        """Take in the outcome that the tapper reports for this tap, if it does."""
        tapper = self._tapper
        if (
            tapper is None
            or tapper.tap_id != shot.tap_id
            or tapper.outcome == TapperState.NONE
            or self._task is None
        ):
            return False
        shot.outcome = tapper.outcome
        shot.measured_speed = tapper.measured_speed
        shot.fired_at = self.get_clock().now()
        self._withdraw(shot.tap_id)
        if tapper.outcome == TapperState.NOT_FIRED:
            self._task.not_fired += 1
            sentence = tapper.error_msg or "the tapper did not fire"
            self.get_logger().warning(f"tap not fired: {sentence}")
            if self._task.not_fired >= self.settings.attempts:
                self._fail(tapper.error_code or ErrorCode.TAPPER_FAULT, sentence)
                return True
        else:
            self._task.not_fired = 0
        self._enter(PlanState.SETTLING, self.settings.withdraw_deadline)
        return True

    def _wait_for_withdrawal(self) -> None:
        """The arm gives the camera a free view."""
        arm, tapper, shot = self._arm, self._tapper, self._shot
        if (
            shot is not None
            and tapper is not None
            and tapper.tap_id == shot.tap_id
            and tapper.outcome != TapperState.NONE
        ):
            shot.outcome = tapper.outcome
        if (
            arm is not None
            and tapper is not None
            and arm.state == ArmState.IDLE
            and arm.clear_of_camera
            and tapper.state == TapperState.SAFE
            and not self._lost()
        ):
            self._look_after = self.get_clock().now()
            self._enter(PlanState.LOOKING, self.settings.look_deadline)
            return
        self._guard(
            ErrorCode.ARM_TIMEOUT,
            f"the arm did not withdraw within {self.settings.withdraw_deadline:.0f} s",
        )

    def _guard(self, code: int, sentence: str) -> None:
        """What may end any wait for arm or tapper: a fault, a lost driver, the deadline."""
        fault = self._fault()
        if fault is not None:
            self._abandon()
            self._fail(*fault)
        elif self._lost():
            self._abandon()
            self._enter(PlanState.WAITING_FOR_CELL, self.settings.ready_deadline)
        elif self._late():
            self._abandon()
            self._fail(code, sentence + "; look after the arm, then send the goal again")

    def _object_was_moved(self, shot: Shot) -> bool:
        """True when the object is seen away from where this tap was planned."""
        seen = self._object
        if seen is None or not seen.visible or seen.error_code:
            return False
        return shot.before.distance_to(from_message(seen.pose.pose)) > self.settings.moved_limit

    def _abandon(self) -> None:
        """Give up the tap under way; whether it was fired is seen by looking."""
        if self._shot is None:
            return
        if self._phase in (PlanState.PLACING, PlanState.FIRING):
            self._withdraw(self._shot.tap_id)
            if self._shot.outcome == TapperState.NONE:
                self._shot.outcome = (
                    TapperState.NOT_FIRED
                    if self._phase == PlanState.PLACING
                    else TapperState.UNKNOWN
                )
            self._enter(PlanState.SETTLING, self.settings.withdraw_deadline)

    def _withdraw(self, tap_id: int) -> None:
        """Tell arm and tapper, once, that this tap is over."""
        if tap_id == self._withdrawn_tap_id:
            return
        self._withdrawn_tap_id = tap_id
        command = TapCommand(request=TapCommand.WITHDRAW, tap_id=tap_id)
        command.header.stamp = self.get_clock().now().to_msg()
        command.header.frame_id = "table"
        self._commands.publish(command)

    # Phases and their ends

    def _enter(self, phase: int, patience: float) -> None:
        self._phase = phase
        self._deadline = time.monotonic() + patience
        self._say(ErrorCode.NONE, "")

    def _late(self) -> bool:
        return time.monotonic() > self._deadline

    def _fail(self, code: int, sentence: str) -> None:
        self._finish(PlanState.FAILED, code, sentence)

    def _finish(self, phase: int, code: int, sentence: str) -> None:
        """End the goal; whoever sent it as an action gets its result."""
        task = self._task
        assert task is not None
        self._phase = phase
        self._say(code, sentence)
        self._task = self._shot = None
        if code:
            self.get_logger().error(f"goal ended ({code}): {sentence}")
        else:
            self.get_logger().info(f"goal reached after {len(task.records)} taps")
        if task.handle is not None:
            self._answer(task.handle, self._result(code, sentence, task.records))

    def _answer(self, handle: ServerGoalHandle, result: PositionObject.Result) -> None:
        # The goal is executed only now, when its result is known: an execute callback that waits
        # would keep the single-threaded executor busy at full load.
        self._results[bytes(handle.goal_id.uuid)] = result
        handle.execute()

    def _conclude(self, handle: ServerGoalHandle) -> PositionObject.Result:
        result = self._results.pop(bytes(handle.goal_id.uuid))
        if handle.is_cancel_requested:
            handle.canceled()
        elif result.error_code == ErrorCode.NONE:
            handle.succeed()
        else:
            handle.abort()
        return result

    def _result(self, code: int, sentence: str, records: list[TapRecord]) -> PositionObject.Result:
        result = PositionObject.Result(
            error_code=code,
            error_msg=sentence,
            residual_distance=self._last.residual_distance,
            residual_rotation=self._last.residual_rotation,
            taps=len(records),
            records=records,
        )
        if self._object is not None and self._object.visible:
            result.final_pose.header = self._object.header
            result.final_pose.pose = self._object.pose
        return result

    # What is said

    def _say(self, code: int, sentence: str) -> None:
        """Publish plan_state, the action's feedback and the markers."""
        self._said_at = time.monotonic()
        task = self._task
        state = PlanState(state=self._phase, error_code=code, error_msg=sentence)
        state.header.stamp = self.get_clock().now().to_msg()
        state.header.frame_id = "table"
        state.residual_distance = state.residual_rotation = math.nan
        if task is not None:
            state.planner = task.session.planner.name
            state.goal = task.message
            state.position_tolerance, state.angle_tolerance = task.tolerance
            state.taps = len(task.records)
            if task.records:
                state.last_tap = task.records[-1]
            if self._object is not None and self._object.visible:
                pose = from_message(self._object.pose.pose)
                state.residual_distance = pose.distance_to(task.goal)
                state.residual_rotation = pose.rotation_to(task.goal)
            if task.handle is not None and task.handle.is_active:
                task.handle.publish_feedback(PositionObject.Feedback(plan_state=state))
        elif self._phase in FINAL:
            # The last goal's end stays readable for whoever joins late.
            state.planner, state.goal = self._last.planner, self._last.goal
            state.position_tolerance = self._last.position_tolerance
            state.angle_tolerance = self._last.angle_tolerance
            state.residual_distance = self._last.residual_distance
            state.residual_rotation = self._last.residual_rotation
            state.taps, state.last_tap = self._last.taps, self._last.last_tap
        self._last = state
        self._states.publish(state)
        if self._cell is not None:
            seen = self._object
            pose = from_message(seen.pose.pose) if seen is not None and seen.visible else None
            strike = self._shot.strike if self._shot is not None else None
            self._markers.publish(
                cell_markers(self._cell, state, pose, task.goal if task else None, strike)
            )

    def _record(self, shot: Shot, seen: ObjectState) -> TapRecord:
        strike = shot.strike
        record = TapRecord(
            tap_id=shot.tap_id,
            number=len(shot.task.records) + 1,
            planner=strike.method,
            dx=strike.commanded.x,
            dy=strike.commanded.y,
            dtheta=strike.commanded.theta,
            striker_speed=strike.plan.striker_speed,
            measured_speed=shot.measured_speed,
            contact_angle=strike.plan.contact_angle,
            outcome=shot.outcome,
            at_rest_at=seen.at_rest_since,
        )
        record.object_pose = to_message(shot.before)
        record.predicted_pose = to_message(strike.predicted)
        record.measured_pose = seen.pose
        record.strike_pose = to_message(strike.plan.strike_pose)
        if shot.fired_at is not None:
            record.fired_at = shot.fired_at.to_msg()
        return record


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(TapPlanner, arguments)


if __name__ == "__main__":
    sys.exit(main())
