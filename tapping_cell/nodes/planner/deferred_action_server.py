"""Action servers whose goals are worked on by a timer, and answered when the result is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node


class ActionDoor:
    """The actions of one node; every goal is accepted, so that its refusal is a numbered result."""

    def __init__(
        self,
        node: Node,
        actions: Mapping[str, tuple[type, Callable[[ServerGoalHandle], None]]],
        on_cancel: Callable[[ServerGoalHandle], CancelResponse],
    ) -> None:
        """``actions``: by name, the type and what to call with each goal."""
        self._results: dict[bytes, Any] = {}
        self._servers = [
            ActionServer(
                node,
                kind,
                name,
                execute_callback=self._conclude,
                goal_callback=lambda _: GoalResponse.ACCEPT,
                handle_accepted_callback=on_goal,
                cancel_callback=on_cancel,
            )
            for name, (kind, on_goal) in actions.items()
        ]

    def close(self) -> None:
        """Withdraw the actions; to be called before the node is destroyed, which leaves them."""
        for server in self._servers:
            server.destroy()

    def answer(self, handle: ServerGoalHandle, result: Any) -> None:
        """End a goal with its result."""
        # The goal is executed only now, when its result is known: an execute callback that waits
        # would keep the single-threaded executor busy at full load.
        self._results[bytes(handle.goal_id.uuid)] = result
        handle.execute()

    def _conclude(self, handle: ServerGoalHandle) -> Any:
        result = self._results.pop(bytes(handle.goal_id.uuid))
        if handle.is_cancel_requested:
            handle.canceled()
        elif result.error_code == 0:
            handle.succeed()
        else:
            handle.abort()
        return result
