"""Common base of the clients of the planner's actions: they send a goal, monitor the goal and the
devices, and can cancel the goal."""

from __future__ import annotations

import math
import queue
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, Generic, TypeVar

from action_msgs.srv import CancelGoal
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState, ErrorCode, PlanState, TapperState

from tapping_cell import messages
from tapping_cell.logic.goal_watch import Ended, GoalWatch
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.client_node import ClientNode
from tapping_cell.nodes.conversions import from_message
from tapping_cell.nodes.message_conversion import from_ros
from tapping_cell.nodes.private_names import PrivateNames
from tapping_cell.se2 import Pose

CALL_S = 1.0
"""Time after which a call is repeated: a planner that has just restarted misses calls until it is
discovered."""
POLL_S = 0.02

Event = TypeVar("Event")


class ActionFollower(ClientNode, Generic[Event]):
    """Client of one action that turns the planner's state and the result into events."""

    last_event: ClassVar[type]
    """The event that ends a goal."""

    def __init__(self, name: str, namespace: str, kind: type, action: str) -> None:
        super().__init__(name, namespace)
        self._events: queue.Queue[Event] = queue.Queue()
        self._handle: ClientGoalHandle | None = None
        self._has_goal = False
        """Whether a goal was sent, or is about to be sent."""
        self._under_way = False
        """Whether the planner has begun the last goal that was sent, so that ``plan_state`` and
        ``arrangement_state`` are about this goal."""
        self._sent = 0
        """Number of goals sent so far. This number also identifies the latest goal."""
        self.arm_state: ArmState | None = None
        self.tapper_state: TapperState | None = None
        self.planner_active = False
        """Whether a state of the planner has been received. The planner publishes its first state
        when it is activated."""
        self.last_run = ""
        """Folder of the run that the recorder finished last; empty before the first run."""
        self._plan: tuple[PlanState, float] | None = None
        """Last state of the planner since the goal was sent, with the time of its receipt."""
        self._watch: GoalWatch | None = None
        self._action = ActionClient(self.node, kind, action)
        self._private = PrivateNames(self.node)
        self._private.client("tap_planner", "cancel")
        subscribe = self.node.create_subscription
        subscribe(ArmState, "arm_state", self._on_arm_state, LATCHED)
        subscribe(TapperState, "tapper_state", self.keeper("tapper_state"), LATCHED)
        subscribe(PlanState, "plan_state", self._on_plan_state, LATCHED)
        subscribe(String, "last_run", self._on_last_run, LATCHED)

    def accepts_goals(self) -> bool:
        """Return whether the planner's action server is available."""
        return bool(self._action.server_is_ready())

    def _missing_devices(self) -> list[str]:
        """Return what prevents arm and tapper from serving a goal, as text."""
        reasons = []
        if self.tapper_state is not None and self.tapper_state.fixed_mounts:
            if not self.tapper_state.mounts_proven:
                reasons.append(
                    self.tapper_state.error_msg
                    or "the strikers are not yet confirmed to be at their mounts"
                )
        elif self.arm_state is None:
            reasons.append("the arm's driver is not running")
        elif self.arm_state.state == ArmState.DISCONNECTED:
            reasons.append(self.arm_state.error_msg or "the arm is not connected yet")
        elif self.arm_state.state != ArmState.IDLE:
            reasons.append(f"the arm is not idle ({self.arm_state.error_msg or 'busy'})")
        if self.tapper_state is None:
            reasons.append("the tapper's driver is not running")
        elif self.tapper_state.state != TapperState.SAFE:
            reasons.append(f"the tapper is not ready ({self.tapper_state.error_msg or 'busy'})")
        return reasons

    @property
    def answered(self) -> bool:
        """Return whether the planner has responded to the last goal."""
        return self._handle is not None

    def cancel(self, patience: float = 5.0) -> bool:
        """Cancel the goal and wait up to twice ``patience`` for the confirmation. Return False if
        the planner did not confirm that the goal has ended, so that the goal may go on."""
        if not self._has_goal:
            return True
        deadline = time.monotonic() + patience
        while self._handle is None and time.monotonic() < deadline:
            time.sleep(POLL_S)
        return self._cancel_own(deadline) or self._cancel_present(patience)

    def _cancel_own(self, deadline: float) -> bool:
        """Cancel the goal by its action. Return whether the planner knows this goal: a planner that
        has resumed it after a crash does not."""
        handle = self._handle
        if handle is None or not self.accepts_goals():
            return False
        patience = max(deadline - time.monotonic(), CALL_S)
        try:
            answer = self.result_of(handle.cancel_goal_async, patience)
        except TimeoutError:
            return False
        return bool(answer.return_code != CancelGoal.Response.ERROR_UNKNOWN_GOAL_ID)

    def _cancel_present(self, patience: float) -> bool:
        """End the present goal of the planner, whoever sent it, and the goal that a restarted
        planner would resume. Return whether the planner has answered."""
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline:
            try:
                self.result_of(
                    lambda: self._private.client("tap_planner", "cancel").call_async(
                        Trigger.Request()
                    ),
                    CALL_S,
                )
            except TimeoutError:
                continue
            return True
        return False

    def events(self, poll: float = 0.2) -> Iterator[Event | None]:
        """Yield events as they arrive. Yield None whenever no event has arrived within ``poll`` s,
        so that the caller can do other work."""
        while True:
            try:
                event: Event | None = self._events.get(timeout=poll)
            except queue.Empty:
                event = self._event_of_silence()
            yield event
            if isinstance(event, self.last_event):
                return

    def _planners(self) -> frozenset[bytes]:
        """Return the current publishers of ``plan_state``."""
        found = self.node.get_publishers_info_by_topic(self.node.resolve_topic_name("plan_state"))
        return frozenset(bytes(publisher.endpoint_gid) for publisher in found)

    def _send_goal(self, message: Any, resumed: Pose | None) -> None:
        """Send a goal. ``resumed``: the goal's pose if the planner resumes the goal after a
        crash."""
        self._plan = None  # it may contain the numbers of an earlier goal
        self._watch = GoalWatch(resumed, self._planners(), time.monotonic())
        self._send_later(self._send, message)

    def _end_without_result(self) -> Ended | None:
        """Return the end of a goal whose result can no longer arrive."""
        if self._watch is None:
            return None
        plan, at = self._plan if self._plan is not None else (None, -math.inf)
        pose = from_message(plan.goal.pose) if plan is not None else None
        mirror = from_ros(plan, messages.PlanState) if plan is not None else None
        return self._watch.check(mirror, pose, at, self._planners(), time.monotonic())

    def _on_arm_state(self, message: ArmState) -> None:
        self.arm_state = message

    def _on_plan_state(self, message: PlanState) -> None:
        self.planner_active = True
        self._plan = message, time.monotonic()

    def _on_last_run(self, message: String) -> None:
        self.last_run = message.data

    def _send_later(self, send: Callable[[Any], None], message: Any) -> None:
        """Send a goal from the executor's thread. If another thread sent it, the response could
        arrive before rclpy has registered the request, and would then be dropped."""
        self._handle = None
        self._has_goal, self._under_way = True, False
        self._executor.create_task(send, message)

    def _send(self, message: Any) -> None:
        # Numbered here, because the executor may run the tasks in another order.
        self._sent += 1
        number = self._sent
        future = self._action.send_goal_async(message, feedback_callback=self._on_feedback)
        future.add_done_callback(lambda done: self._on_response(done.result(), number))

    def _on_feedback(self, received: Any) -> None:
        self._under_way = True

    def _on_response(self, handle: Any, number: int) -> None:
        self._handle = handle

        def end(done: Any) -> None:
            result = done.result().result
            if number == self._sent or result.error_code != ErrorCode.GOAL_REPLACED:
                self._on_result(result)
            # Otherwise, this is the result of an earlier request. The response to that request was
            # late, so the goal was sent again, and the later request replaced the earlier one.

        handle.get_result_async().add_done_callback(end)

    @abstractmethod
    def _event_of_silence(self) -> Event | None:
        """Return the event that reports missing messages, or None if no messages are missing."""

    @abstractmethod
    def _on_result(self, result: Any) -> None:
        """Turn the result of the action into events."""
