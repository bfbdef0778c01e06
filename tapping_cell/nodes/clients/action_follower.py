"""What the clients of the planner's actions do alike: send one goal, follow it, cancel it."""

from __future__ import annotations

import queue
import threading
from abc import abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, Generic, TypeVar

from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from tapping_cell_msgs.msg import ErrorCode

from tapping_cell.nodes.clients.client_node import ClientNode

Event = TypeVar("Event")


class ActionFollower(ClientNode, Generic[Event]):
    """A client of one action, whose feedback and result become events."""

    last_event: ClassVar[type]
    """The event that ends a goal."""

    def __init__(self, name: str, namespace: str, kind: type, action: str) -> None:
        super().__init__(name, namespace)
        self._events: queue.Queue[Event] = queue.Queue()
        self._handle: ClientGoalHandle | None = None
        self._sent = 0
        """Goals sent so far; the latest one's number."""
        self._action = ActionClient(self.node, kind, action)

    def accepts_goals(self) -> bool:
        """Whether the planner's action is there."""
        return bool(self._action.server_is_ready())

    @property
    def answered(self) -> bool:
        """Whether the planner has answered the goal sent last."""
        return self._handle is not None

    def cancel(self, patience: float = 5.0) -> bool:
        """Cancel the goal and wait until the cell has taken that in; False where there is none."""
        handle = self._handle
        if handle is None:
            return False
        done = threading.Event()

        def ask() -> None:
            handle.cancel_goal_async().add_done_callback(lambda _: done.set())

        self._executor.create_task(ask)
        return done.wait(patience)

    def events(self, poll: float = 0.2) -> Iterator[Event | None]:
        """Events as they come, and None in between so that the caller can look at other things."""
        while True:
            try:
                event: Event | None = self._events.get(timeout=poll)
            except queue.Empty:
                event = self._event_of_silence()
            yield event
            if isinstance(event, self.last_event):
                return

    def _send_goal(self, message: Any) -> None:
        self._handle = None
        # Sent from the executor's thread: from another one the response can overtake rclpy's own
        # note of the request, and is then dropped.
        self._executor.create_task(self._send, message)

    def _send(self, message: Any) -> None:
        self._sent += 1
        number = self._sent
        future = self._action.send_goal_async(
            message, feedback_callback=lambda heard: self._on_feedback(heard.feedback)
        )
        future.add_done_callback(lambda done: self._on_response(done.result(), number))

    def _on_response(self, handle: Any, number: int) -> None:
        self._handle = handle

        def end(done: Any) -> None:
            result = done.result().result
            if number == self._sent or result.error_code != ErrorCode.GOAL_REPLACED:
                self._on_result(result)
            # Else a goal that was sent again, unanswered, took its own place.

        handle.get_result_async().add_done_callback(end)

    def _event_of_silence(self) -> Event | None:
        """What it means that nothing is heard now."""
        return None

    @abstractmethod
    def _on_feedback(self, feedback: Any) -> None:
        """Make events of the action's feedback."""

    @abstractmethod
    def _on_result(self, result: Any) -> None:
        """Make events of the action's result."""
