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
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.action import CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.duration import Duration
from rclpy.time import Time
from tapping_cell_msgs.action import PositionObject, SingleTap
from tapping_cell_msgs.msg import (
    ArmState,
    ErrorCode,
    ObjectState,
    PlanState,
    TapCommand,
    TapperState,
)

from tapping_cell.configuration.cell import load_cell, load_other_objects
from tapping_cell.configuration.schema import ConfigurationError, quantity, text
from tapping_cell.logic.tapper_peers import TAPPING
from tapping_cell.nodes.cell_identity import key_of, state_folder
from tapping_cell.nodes.cell_node import COMMAND, LATCHED, CellNode, run
from tapping_cell.nodes.conversions import from_message
from tapping_cell.nodes.planner.cell_monitor import CellMonitor
from tapping_cell.nodes.planner.deferred_action_server import ActionDoor
from tapping_cell.nodes.planner.goal_handling import GoalDesk, Request
from tapping_cell.nodes.planner.goal_persistence import GoalMemory
from tapping_cell.nodes.planner.goal_validation import REFUSALS, Refused
from tapping_cell.nodes.planner.other_objects import Neighbours
from tapping_cell.nodes.planner.plan_reporter import PlanReporter
from tapping_cell.nodes.planner.tap_task import LEAST_EFFECT, Shot, Task
from tapping_cell.planning import Done, LookAgain, PlanningError, Refusal, RefusalReason, Strike
from tapping_cell.se2 import Pose

TICK_S = 0.02
REPORT_PERIOD_S = 0.5
BEAT_PERIOD_S = 0.1
"""While a tap is under way: the tapper lets the striker down when these signs of life end."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of tap_planner."""

    autostart: bool = text("configure and activate without being asked", default=True)
    cell_file: str = text("path of the cell file; empty for the package's own", default="")
    object_file: str = text("path of the object file; empty for the cell file's", default="")
    other_object_files: str = text(
        "paths of the files of further objects on the table, separated by commas: kept clear of; "
        "the same as camera_pose's",
        default="",
    )
    others_memory: float = quantity(
        "time after which a further object that is no longer seen counts as taken away",
        "s",
        0.2,
        3600.0,
        default=5.0,
    )
    planner: str = text("planning method; empty for the cell file's", default="")
    adapt: bool = text("learn from every tap how the object answers", default=True)
    keep_gains: bool = text("remember what was learnt of an object between runs", default=False)
    probe: bool = text(
        "begin with up to three of the smallest taps where the object's friction is not known",
        default=False,
    )
    frames_needed: int = quantity(
        "pictures at rest that a look must be fused of", "", 1, 1000, default=10
    )
    goal_time_limit: float = quantity(
        "longest time for a goal that gives none itself", "s", 1.0, 86400.0, default=900.0
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
    resume_within: float = quantity(
        "a planner that crashed goes on with its goal when it is back so soon; 0 never does",
        "s",
        0.0,
        600.0,
        default=15.0,
    )
    attempts: int = quantity(
        "taps in a row that may end without a release or without an effect", "", 1, 100, default=3
    )


class TapPlanner(CellNode[Parameters]):
    """See the module's docstring."""

    carries_pictures = False
    changeable = ("planner",)

    def __init__(self) -> None:
        super().__init__("tap_planner", Parameters)
        self._desk: GoalDesk | None = None
        self._memory = GoalMemory(state_folder(key_of(self)), self.settings.resume_within)
        self._monitor = CellMonitor(self.settings.silence_limit)
        self._neighbours = Neighbours()
        self._left: Request | None = None
        self._task: Task | None = None
        self._shot: Shot | None = None
        self._phase = PlanState.IDLE
        self._deadline = math.inf
        self._look_after = Time(nanoseconds=0)
        self._last_tap_id = 0
        self._withdrawn_tap_id = 0
        self._commands = self.create_publisher(TapCommand, "tap_command", COMMAND)
        self._reporter = PlanReporter(self)
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal_pose, COMMAND)
        self.create_subscription(ObjectState, "object_state", self._monitor.on_object, LATCHED)
        self.create_subscription(ObjectState, "other_objects", self._neighbours.on_object, 10)
        self.create_subscription(ArmState, "arm_state", self._monitor.on_arm, LATCHED)
        self.create_subscription(TapperState, "tapper_state", self._monitor.on_tapper, LATCHED)
        self._door = ActionDoor(
            self,
            {
                "position_object": (PositionObject, self._on_action_goal),
                "single_tap": (SingleTap, self._on_single_tap),
            },
            self._on_cancel,
        )
        self.create_timer(TICK_S, self._tick)

    # Life cycle

    def configure(self) -> None:
        """Read the files, make the method and the map of the table."""
        cell = load_cell(self.settings.cell_file or None, self.settings.object_file or None)
        others = load_other_objects(self.settings.other_object_files, cell)
        self._neighbours.expect(others, self.settings.others_memory, self.settings.moved_limit)
        try:
            self._desk = GoalDesk(
                cell,
                self.settings.planner,
                self._neighbours,
                adapt=self.settings.adapt,
                probe=self.settings.probe,
                keep_for=key_of(self) if self.settings.keep_gains else "",
            )
        except PlanningError as error:
            raise ConfigurationError(f"{cell.path}: {error}") from error

    def activate(self) -> None:
        """Go on with the goal of a planner that crashed a moment ago."""
        self._left = self._memory.recall()

    def cleanup(self) -> None:
        """An orderly end is an end of the goal, too."""
        self._memory.forget()

    def change(self, name: str, value: object) -> None:
        """Take another planning method at run time."""
        if self._desk is not None:
            self._desk.use(str(value))

    def destroy_node(self) -> None:
        """End the actions, too: rclpy leaves them where they are, and clients would see half of a
        planner until they are collected as garbage."""
        self._door.close()
        super().destroy_node()

    def deactivate(self) -> None:
        """Give up the goal."""
        if self._task is not None:
            self._abandon()
            self._finish(PlanState.FAILED, ErrorCode.NOT_ACTIVE, "the planner was deactivated")

    def stop_now(self) -> None:
        """Give up the goal; arm and tapper stop, and stay stopped, by themselves."""
        if self._task is not None:
            self._abandon()
            self._finish(
                PlanState.FAILED,
                ErrorCode.EMERGENCY_STOP,
                "emergency stop: make the cell safe, clear the faults, then send the goal again",
            )

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """The phase and the goal's residual."""
        last = self._reporter.last
        values: dict[str, object] = {
            "phase": self._phase,
            "taps": last.taps,
            "residual distance (mm)": f"{1000 * last.residual_distance:.3f}",
            "residual rotation (deg)": f"{math.degrees(last.residual_rotation):.3f}",
        }
        if self._desk is not None:
            values.update(self._desk.learnt())
        if last.error_code:
            return DiagnosticStatus.WARN, last.error_msg, values
        return DiagnosticStatus.OK, "ok", values

    # Goals

    def _on_goal_pose(self, message: PoseStamped) -> None:
        request = Request(message)
        refused = self._take(request)
        if refused is not None:
            self._reporter.refuse((refused.code, refused.sentence), request)
            self.get_logger().error(f"goal refused ({refused.code}): {refused.sentence}")
            self._say(refused.code, refused.sentence)

    def _on_action_goal(self, handle: ServerGoalHandle) -> None:
        asked = handle.request
        request = Request(
            asked.goal_pose,
            asked.position_tolerance,
            asked.angle_tolerance,
            asked.max_taps,
            asked.time_limit,
            handle,
        )
        refused = self._take(request)
        if refused is not None:
            self._reporter.refuse((refused.code, refused.sentence), request)
            self.get_logger().error(f"goal refused ({refused.code}): {refused.sentence}")
            trouble = (refused.code, refused.sentence)
            self._door.answer(handle, self._reporter.result(trouble, None, self._monitor.object))

    def _on_single_tap(self, handle: ServerGoalHandle) -> None:
        refused = self._take(handle)
        if refused is not None:
            self.get_logger().error(f"single tap refused ({refused.code}): {refused.sentence}")
            self._door.answer(
                handle, SingleTap.Result(error_code=refused.code, error_msg=refused.sentence)
            )

    def _take(self, asked: Request | ServerGoalHandle) -> Refused | None:
        """Take a goal in place of the present one, or a single tap; or say why not."""
        if not self.active or self._desk is None:
            return Refused(ErrorCode.NOT_ACTIVE, "the planner is not active; activate it first")
        if isinstance(asked, Request):
            task = self._desk.accept(asked, self.get_clock().now().nanoseconds * 1e-9)
        elif self._task is not None:
            return Refused(
                ErrorCode.PLANNER_BUSY, "a goal is under way; wait for its end, or cancel it"
            )
        else:
            task = self._desk.accept_tap(asked, self._monitor.pose)
        if isinstance(task, Refused):
            return task
        fault = self._monitor.fault()
        if fault is not None:
            code, sentence = fault
            return Refused(code, f"the cell is faulted: {sentence}")
        asked_limit = asked.time_limit if isinstance(asked, Request) else 0.0
        task.deadline = time.monotonic() + (asked_limit or self.settings.goal_time_limit)
        self._begin(task)
        return None

    def _begin(self, task: Task) -> None:
        if self._task is not None:
            self._abandon()
            self._finish(
                PlanState.CANCELED, ErrorCode.GOAL_REPLACED, "a newer goal took this one's place"
            )
        self._task = task
        try:
            if task.resumable:
                self._memory.keep(task)
        except OSError as error:
            self.get_logger().warning(f"a crash would lose this goal: {error}")
        self.get_logger().info(task.words())
        self._enter(PlanState.WAITING_FOR_CELL, self.settings.ready_deadline)

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        task = self._task
        if task is None or task.handle is not handle:
            return CancelResponse.REJECT
        task.canceled = True
        return CancelResponse.ACCEPT

    # The cycle

    def _tick(self) -> None:
        if not self.active:
            return
        if self._left is not None:
            request, self._left = self._left, None
            self.get_logger().warning("going on with the goal of a planner that crashed")
            self._take(request)
        if self._task is not None:
            if self._task.canceled:
                self._abandon()
                self._finish(PlanState.CANCELED, ErrorCode.GOAL_CANCELED, "the goal was canceled")
            elif time.monotonic() > self._task.deadline:
                self._abandon()
                self._fail(
                    ErrorCode.DEADLINE_EXCEEDED,
                    "the goal's time limit is over; send it again, with a longer time_limit if the"
                    " cell worked all the time",
                )
            else:
                {
                    PlanState.WAITING_FOR_CELL: self._wait_for_cell,
                    PlanState.LOOKING: self._look,
                    PlanState.PLACING: self._wait_for_arm,
                    PlanState.FIRING: self._wait_for_tapper,
                    PlanState.SETTLING: self._wait_for_withdrawal,
                }[self._phase]()
        if self._reporter.age() > REPORT_PERIOD_S:
            self._memory.touch()
            self._say(self._reporter.last.error_code, self._reporter.last.error_msg)
        if self._phase in TAPPING:
            self._reporter.beat(BEAT_PERIOD_S)

    def _wait_for_cell(self) -> None:
        """Wait until arm, tapper and camera are ready; end a tap that a restart left behind."""
        missing = self._monitor.missing()
        if missing is None:
            self._look_after = self.get_clock().now()
            self._enter(PlanState.LOOKING, self.settings.look_deadline)
            return
        orphan = self._monitor.left_behind()
        if orphan:
            self._withdraw(orphan)
        if self._late():
            code, sentence = missing
            self._fail(code, f"the cell was not ready: {sentence}")

    def _look(self) -> None:
        """Look at the object at rest, take in the last tap, decide on the next."""
        task, seen = self._task, self._monitor.object
        assert task is not None and self._desk is not None
        fresh = self._monitor.usable(self._look_after, self.settings.frames_needed)
        if seen is None or not fresh:
            if self._monitor.silent("object"):
                # Its node may be on the way back: it has as long as any part of the cell.
                self._enter(PlanState.WAITING_FOR_CELL, self.settings.ready_deadline)
            elif self._late():
                self._fail(*self._monitor.blind(self.settings.look_deadline))
            return
        shot, self._shot = self._shot, None
        if shot is not None and shot.outcome != TapperState.NOT_FIRED:
            task.take_in(shot, seen)
            warning = task.session.edge_warning(from_message(seen.pose.pose))
            if warning:
                self.get_logger().warning(warning)
            self._say(ErrorCode.NONE, "")
        unknown = self._desk.room_for(task, self._look_after)
        if unknown is not None:
            if self._late():
                self._fail(*unknown)
            return
        frames = 0 if self._late() else self.settings.frames_needed
        decision = task.decide(seen, frames)
        if isinstance(decision, LookAgain):
            return  # the look gets longer with every picture
        if isinstance(decision, Done):
            self._finish(task.done_phase, ErrorCode.NONE, "")
        elif isinstance(decision, Refusal):
            # A look that is too uncertain gets better with every picture.
            if decision.reason is not RefusalReason.CAMERA_TOO_COARSE or self._late():
                self._fail(REFUSALS[decision.reason], decision.sentence)
        elif task.without_effect >= self.settings.attempts:
            self._fail(
                ErrorCode.TAP_WITHOUT_EFFECT,
                f"{task.without_effect} taps in a row moved the object by less than "
                f"{100 * LEAST_EFFECT:.0f} % of what was wanted; look whether the striker reaches "
                "it at the right height, and calibrate arm and tapper",
            )
        elif len(task.records) >= task.max_taps:
            last = self._reporter.last
            self._fail(
                ErrorCode.TAP_LIMIT_REACHED,
                f"{len(task.records)} taps did not bring the object to the goal, the limit is "
                f"{task.max_taps}; {1000 * last.residual_distance:.2f} mm and "
                f"{math.degrees(last.residual_rotation):.2f} deg remain",
            )
        elif self._monitor.missing() is not None:
            self._enter(PlanState.WAITING_FOR_CELL, self.settings.ready_deadline)
        else:
            self._command(decision, from_message(seen.pose.pose))

    def _disturbed(self, shot: Shot) -> bool:
        """True when the object, or another one, was moved since the tap was planned."""
        moved = self._monitor.seen_away_from(shot.before, self.settings.moved_limit)
        return moved or (self._desk is not None and self._desk.others_moved())

    def _command(self, strike: Strike, before: Pose) -> None:
        """Publish one tap, under an id that was never used before."""
        assert self._task is not None and self._desk is not None
        # Whole seconds of the system clock: ids rise over restarts of every node, and fit the
        # tapper's 32 bits until 2106. Two taps are always more than a second apart.
        # A clock that was set back must not bring ids that the tapper has seen.
        tapper = self._monitor.tapper
        seen_last = tapper.tap_id if tapper is not None else 0
        self._last_tap_id = max(self._last_tap_id, seen_last, int(time.time()) - 1) + 1
        self._shot = Shot(self._last_tap_id, strike, before)
        now = self.get_clock().now()
        allowance = self.settings.place_deadline + self.settings.fire_deadline
        expiry = now + Duration(seconds=allowance)
        height = self._desk.cell.file.arm.strike_height
        self._commands.publish(self._shot.command(now, expiry, height))
        if strike.detour:
            self.get_logger().info(f"tap {len(self._task.records) + 1}: {strike.detour}")
        self._enter(PlanState.PLACING, self.settings.place_deadline)

    def _wait_for_arm(self) -> None:
        """The arm brings the striker to its place; the tapper waits for it."""
        shot = self._shot
        assert shot is not None
        if self._disturbed(shot):
            self.get_logger().warning("an object was moved before the tap; looking again")
            self._abandon()
        elif self._tapper_answered(shot):
            return
        elif self._monitor.in_position(shot.tap_id):
            self._enter(PlanState.FIRING, self.settings.fire_deadline)
        else:
            self._guard(
                ErrorCode.ARM_TIMEOUT,
                f"the striker was not in its place within {self.settings.place_deadline:.0f} s",
            )

    def _wait_for_tapper(self) -> None:
        """The tapper draws and fires once."""
        shot = self._shot
        assert shot is not None
        if self._disturbed(shot):
            # It may be the tap itself, seen before the tapper's report: withdrawing is right in
            # both cases, and the outcome stays what the tapper says.
            self._withdraw(shot.tap_id)
        if self._tapper_answered(shot):
            return
        if self._late() or self._monitor.lost():
            shot.outcome = TapperState.UNKNOWN
            self.get_logger().warning("the tap's outcome is not known; looking at the object")
            self._withdraw(shot.tap_id)
            self._enter(PlanState.SETTLING, self.settings.withdraw_deadline)

    def _tapper_answered(self, shot: Shot) -> bool:
        """Take in the outcome that the tapper reports for this tap, if it does."""
        outcome, tapper, task = self._monitor.outcome(shot.tap_id), self._monitor.tapper, self._task
        if outcome == TapperState.NONE or tapper is None or task is None:
            return False
        shot.outcome = outcome
        shot.measured_speed = tapper.measured_speed
        shot.fired_at = self.get_clock().now()
        self._withdraw(shot.tap_id)
        task.not_fired = task.not_fired + 1 if outcome == TapperState.NOT_FIRED else 0
        if outcome == TapperState.NOT_FIRED:
            sentence = tapper.error_msg or "the tapper did not fire"
            self.get_logger().warning(f"tap not fired: {sentence}")
            if task.not_fired >= self.settings.attempts:
                self._fail(tapper.error_code or ErrorCode.TAPPER_FAULT, sentence)
                return True
        self._enter(PlanState.SETTLING, self.settings.withdraw_deadline)
        return True

    def _wait_for_withdrawal(self) -> None:
        """The arm gives the camera a free view."""
        shot = self._shot
        if shot is not None:
            shot.outcome = self._monitor.outcome(shot.tap_id) or shot.outcome
        if self._monitor.withdrawn():
            self._look_after = self.get_clock().now()
            self._enter(PlanState.LOOKING, self.settings.look_deadline)
            return
        self._guard(
            ErrorCode.ARM_TIMEOUT,
            f"the arm did not withdraw within {self.settings.withdraw_deadline:.0f} s",
        )

    def _guard(self, code: int, sentence: str) -> None:
        """What may end any wait for arm or tapper: a fault, a lost driver, the deadline."""
        fault = self._monitor.fault()
        if fault is not None:
            self._abandon()
            self._fail(*fault)
        elif self._monitor.lost():
            self._abandon()
            self._enter(PlanState.WAITING_FOR_CELL, self.settings.ready_deadline)
        elif self._late():
            self._abandon()
            self._fail(code, sentence + "; look after the arm, then send the goal again")

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
        if self._shot is not None:
            task.lose(self._shot)
        self._say(code, sentence)
        self._task = self._shot = None
        self._memory.forget()
        assert self._desk is not None
        try:
            self._desk.learn(task)
        except OSError as error:
            self.get_logger().warning(f"what was learnt of the object was not kept: {error}")
        if code:
            self.get_logger().error(f"goal ended ({code}): {sentence}")
        else:
            self.get_logger().info(f"goal done after {len(task.records)} taps")
        if task.handle is not None:
            result = self._reporter.result((code, sentence), task, self._monitor.object)
            self._door.answer(task.handle, result)

    def _say(self, code: int, sentence: str) -> None:
        self._reporter.say(
            self._phase, (code, sentence), self._task, self._shot, self._monitor.pose, self._desk
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(TapPlanner, arguments)


if __name__ == "__main__":
    sys.exit(main())
