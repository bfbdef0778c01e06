"""Client of a running cell: checks that the cell is ready, sends a goal, reports every tap and the
result.

The verbs `demo` and `goal` use this client. There is no separate executable for it.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import PoseStamped
from tapping_cell_msgs.action import PositionObject
from tapping_cell_msgs.msg import (
    ObjectState,
    ObjectStates,
    PlannedTap,
    PlanState,
    TapRecord,
)
from tapping_cell_msgs.srv import ConfirmTap

from tapping_cell.logic.goal_watch import FINAL_STATES
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.action_follower import ActionFollower
from tapping_cell.nodes.conversions import from_message, position_goal
from tapping_cell.report.words import PHASES
from tapping_cell.se2 import Pose


@dataclass(frozen=True, slots=True)
class PhaseChanged:
    """Event: the planner entered another phase of a tap."""

    phase: str
    taps: int


@dataclass(frozen=True, slots=True)
class TapDone:
    """Event: the result of a tap was measured. ``true_pose`` is None if no ground truth is
    published."""

    record: TapRecord
    residual_distance: float
    residual_rotation: float
    true_pose: Pose | None


@dataclass(frozen=True, slots=True)
class Finished:
    """Event: the goal has ended; error_code 0 means success."""

    error_code: int
    error_msg: str
    final_pose: Pose | None
    residual_distance: float
    residual_rotation: float
    taps: int


@dataclass(frozen=True, slots=True)
class TapProposed:
    """Event: a tap waits for a person's confirmation."""

    tap: PlannedTap


@dataclass(frozen=True, slots=True)
class PlannerLost:
    """Event: the planner that pursues the goal has ended or is silent. It may restart and resume
    the goal."""


Event = PhaseChanged | TapDone | TapProposed | PlannerLost | Finished


class GoalClient(ActionFollower[Event]):
    """Client that sends a goal and monitors its progress. Use as a context manager."""

    last_event = Finished

    def __init__(self, name: str = "goal_client", namespace: str = "") -> None:
        super().__init__(name, namespace, PositionObject, "position_object")
        self.object_state: ObjectState | None = None
        """Last state of the cell's own object."""
        self.true_pose: Pose | None = None
        self._true_pose_received = 0.0
        self._taps_received = 0
        self._phase = ""
        self._proposed = 0
        self._confirm = self.node.create_client(ConfirmTap, "confirm_tap")
        subscribe = self.node.create_subscription
        subscribe(ObjectStates, "object_states", self._on_states, LATCHED)
        subscribe(PoseStamped, "ground_truth", self._on_ground_truth, 10)

    def _on_states(self, message: ObjectStates) -> None:
        self.object_state = next(iter(message.objects), None)

    def missing(self) -> list[str]:
        """Return the conditions that still prevent the cell from accepting a goal, as text; empty
        when the cell is ready."""
        reasons = []
        if not self._action.server_is_ready():
            reasons.append("the planner is not running")
        reasons += self._missing_devices()
        if self.object_state is None:
            reasons.append("camera_pose has not reported the object yet")
        elif not (self.object_state.visible and self.object_state.at_rest):
            reasons.append(
                f"the object is not seen at rest ({self.object_state.error_msg or 'moving'})"
            )
        return reasons

    def object_pose(self) -> Pose:
        """Return the object's measured pose in ``table``."""
        assert self.object_state is not None
        return from_message(self.object_state.pose.pose)

    def send(
        self,
        goal: Pose,
        tolerance: tuple[float, float] = (0.0, 0.0),
        observed: ObjectState | None = None,
        *,
        probe: bool = False,
        ask: bool = False,
    ) -> None:
        """Send a goal in ``table``. A tolerance (m, rad) of 0 selects the cell's default.
        ``probe``: start with a few of the smallest taps. ``ask``: every tap waits for confirmation.

        ``observed``: observation from which the goal was computed. The goal gets the stamp of this
        observation; otherwise none, because the cell's time may be that of /clock.
        """
        stamp = observed.header.stamp if observed is not None else TimeMessage()
        message = position_goal(goal, tolerance, stamp)
        message.probe, message.ask = probe, ask
        self._taps_received, self._phase, self._proposed = 0, "", 0
        self._send_goal(message, goal)

    def confirm(self, tap_id: int, confirm: bool, patience: float = 5.0) -> ConfirmTap.Response:
        """Confirm or skip a tap that waits for confirmation.

        Raises:
            TimeoutError: the planner did not respond.
        """
        request = ConfirmTap.Request(tap_id=tap_id, confirm=confirm)
        try:
            return self.result_of(lambda: self._confirm.call_async(request), patience)
        except TimeoutError:
            raise TimeoutError(
                f"the planner did not answer within {patience:.0f} s; is tap_planner running?"
            ) from None

    def _event_of_silence(self) -> PlannerLost | Finished | None:
        """Return PlannerLost once when the planner has ended, or Finished for a goal whose result
        can no longer arrive."""
        watch = self._watch
        was_gone = watch is not None and watch.gone
        ended = self._end_without_result()
        if ended is None:
            return PlannerLost() if watch is not None and watch.gone and not was_gone else None
        plan = self._plan[0] if self._plan is not None else None
        seen = self.object_state
        return Finished(
            ended.code,
            ended.sentence,
            self.object_pose() if seen is not None and seen.visible else None,
            plan.residual_distance if plan is not None else math.nan,
            plan.residual_rotation if plan is not None else math.nan,
            plan.taps if plan is not None else self._taps_received,
        )

    def settled_truth(self, patience: float = 1.0) -> Pose | None:
        """Return the object's true pose from a message newer than this call; None if none
        arrives."""
        asked = time.monotonic()
        while time.monotonic() < asked + patience:
            if self._true_pose_received > asked:
                return self.true_pose
            time.sleep(0.01)
        return None

    def _on_plan_state(self, message: PlanState) -> None:
        super()._on_plan_state(message)
        # A planner that has resumed the goal sends no feedback.
        resumed = self._watch is not None and self._watch.gone
        if (self._under_way or resumed) and message.state not in (PlanState.IDLE, *FINAL_STATES):
            self._follow(message)

    def _on_ground_truth(self, message: PoseStamped) -> None:
        self.true_pose = from_message(message.pose)
        self._true_pose_received = time.monotonic()

    def _follow(self, state: PlanState) -> None:
        self._receive(state.last_tap, state)
        phase = PHASES[state.state]
        if phase != self._phase:
            self._phase = phase
            self._events.put(PhaseChanged(phase, state.taps))
        proposed = state.planned_tap.tap_id if state.state == PlanState.CONFIRMING else 0
        if proposed not in (0, self._proposed):
            self._events.put(TapProposed(state.planned_tap))
        self._proposed = proposed

    def _receive(self, record: TapRecord, of: PlanState | PositionObject.Result) -> None:
        if record.number > self._taps_received:
            self._taps_received = record.number
            distance, rotation = of.residual_distance, of.residual_rotation
            self._events.put(TapDone(record, distance, rotation, self.true_pose))

    def _on_result(self, result: PositionObject.Result) -> None:
        if result.records:
            self._receive(result.records[-1], result)
        final, measured = result.final_pose, bool(result.final_pose.header.frame_id)
        self._events.put(
            Finished(
                result.error_code,
                result.error_msg,
                from_message(final.pose.pose) if measured else None,
                result.residual_distance,
                result.residual_rotation,
                result.taps,
            )
        )
