"""Action servers that finish a goal when its result is known, long after its callback returned."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node


class DeferredActionServer:
    """Action servers of one node. They accept every goal, because only an accepted goal has a
    result. If the planner then refuses the goal, the result contains the error code for the
    client."""

    def __init__(
        self,
        node: Node,
        actions: Mapping[str, tuple[type, Callable[[ServerGoalHandle], None]]],
        on_cancel: Callable[[ServerGoalHandle], CancelResponse],
    ) -> None:
        """``actions``: for each action name, its type and a callback for each goal."""
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

    @property
    def has_unsent_results(self) -> bool:
        """Return whether results wait for the executor, which sends them."""
        return bool(self._results)

    def close(self) -> None:
        """Destroy the action servers. Call this before destroying the node, because
        ``destroy_node`` does not destroy them."""
        for server in self._servers:
            server.destroy()

    def keep(self, handle: ServerGoalHandle, result: Any) -> None:
        """Keep the result of a goal until :meth:`finish`. May be called from any thread."""
        self._results[bytes(handle.goal_id.uuid)] = result

    def finish(self, handle: ServerGoalHandle) -> None:
        """Finish a goal with the result that was kept. Call this from the executor's thread only,
        because a cancellation at the same time would be an error."""
        # The goal is executed only now that its result is known, because an execute callback that
        # waits for the result would block the single-threaded executor.
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
