"""What the planning node says: ``plan_state``, the action's feedback and the markers."""

from __future__ import annotations

import math
import time

from rclpy.node import Node
from std_msgs.msg import Header
from tapping_cell_msgs.action import PositionObject, SingleTap
from tapping_cell_msgs.msg import GoalReport, ObjectState, PlanState, TapRecord
from visualization_msgs.msg import MarkerArray

from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.conversions import from_message
from tapping_cell.nodes.planner.goal_handling import GoalDesk, Request
from tapping_cell.nodes.planner.markers import cell_markers
from tapping_cell.nodes.planner.tap_task import Shot, SingleTapTask, Task
from tapping_cell.planning.prescribed import METHOD as PRESCRIBED
from tapping_cell.se2 import Pose

FINAL = (PlanState.REACHED, PlanState.FAILED, PlanState.CANCELED)
REMEMBERED = (
    "planner",
    "goal",
    "position_tolerance",
    "angle_tolerance",
    "residual_distance",
    "residual_rotation",
    "taps",
    "last_tap",
)
"""Fields of the last goal that stay readable after its end, for whoever joins late."""


class PlanReporter:
    """Publishes; keeps the last report."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._states = node.create_publisher(PlanState, "plan_state", LATCHED)
        self._reports = node.create_publisher(GoalReport, "goal_report", LATCHED)
        self._markers = node.create_publisher(MarkerArray, "markers", LATCHED)
        self._said_at = self._beat_at = -math.inf
        self.last = PlanState(residual_distance=math.nan, residual_rotation=math.nan)

    def age(self) -> float:
        """Seconds since the last report."""
        return time.monotonic() - self._said_at

    def beat(self, period: float) -> None:
        """Send the last report again where none was sent for ``period`` s: a sign of life."""
        now = time.monotonic()
        if now - max(self._said_at, self._beat_at) >= period:
            self._beat_at = now
            self.last.header.stamp = self._node.get_clock().now().to_msg()
            self._states.publish(self.last)

    def say(
        self,
        phase: int,
        trouble: tuple[int, str],
        task: Task | None,
        shot: Shot | None,
        pose: Pose | None,
        desk: GoalDesk | None,
    ) -> None:
        """Report a phase with its error code and sentence, and what is known of goal and object."""
        self._said_at = time.monotonic()
        code, sentence = trouble
        state = PlanState(state=phase, error_code=code, error_msg=sentence)
        state.header.stamp = self._node.get_clock().now().to_msg()
        state.header.frame_id = "table"
        state.residual_distance = state.residual_rotation = math.nan
        if task is not None:
            task.fill(state, pose)
            if task.handle is not None and task.handle.is_active:
                task.handle.publish_feedback(task.action.Feedback(plan_state=state))
        elif phase in FINAL:
            for name in REMEMBERED:
                setattr(state, name, getattr(self.last, name))
        self.last = state
        self._states.publish(state)
        if task is not None and phase in FINAL and state.planner != PRESCRIBED:
            self._report_end(state, task)
        if desk is not None:
            strike = shot.strike if shot is not None else None
            goal = task.goal if task is not None else None
            records = task.records if task is not None else ()
            way = [from_message(record.object_pose) for record in records]
            self._markers.publish(
                cell_markers(desk.cell, state, pose, goal, strike, way, desk.region, desk.others)
            )

    def refuse(self, trouble: tuple[int, str], request: Request) -> None:
        """Report a goal that was refused."""
        code, sentence = trouble
        self._reports.publish(
            GoalReport(
                header=Header(stamp=self._node.get_clock().now().to_msg(), frame_id="table"),
                refused=True,
                state=PlanState.FAILED,
                goal=request.message,
                position_tolerance=request.position_tolerance,
                angle_tolerance=request.angle_tolerance,
                residual_distance=math.nan,
                residual_rotation=math.nan,
                error_code=code,
                error_msg=sentence,
            )
        )

    def _report_end(self, state: PlanState, task: Task) -> None:
        report = GoalReport(header=state.header, state=state.state, records=task.records)
        for name in (
            "goal",
            "position_tolerance",
            "angle_tolerance",
            "planner",
            "taps",
            "residual_distance",
            "residual_rotation",
            "error_code",
            "error_msg",
        ):
            setattr(report, name, getattr(state, name))
        self._reports.publish(report)

    def result(
        self, trouble: tuple[int, str], task: Task | None, seen: ObjectState | None
    ) -> PositionObject.Result | SingleTap.Result:
        """The action's result, as last reported."""
        code, sentence = trouble
        records = task.records if task is not None else []
        if isinstance(task, SingleTapTask):
            record = records[-1] if records else TapRecord()
            return SingleTap.Result(error_code=code, error_msg=sentence, record=record)
        result = PositionObject.Result(
            error_code=code,
            error_msg=sentence,
            residual_distance=self.last.residual_distance,
            residual_rotation=self.last.residual_rotation,
            taps=len(records),
            records=records,
        )
        if seen is not None and seen.visible:
            result.final_pose.header = seen.header
            result.final_pose.pose = seen.pose
        return result
