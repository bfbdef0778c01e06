"""Planning node: hosts the planner's state machine and receives goals by topic or action."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from tapping_cell_msgs.action import ArrangeObjects, PositionObject, SingleTap
from visualization_msgs.msg import MarkerArray

from tapping_cell import messages
from tapping_cell.configuration.cell import load_cell, load_further_objects
from tapping_cell.configuration.schema import ConfigurationError, text
from tapping_cell.logic import effects
from tapping_cell.logic.fixed_goal_handling import goal_handling_class
from tapping_cell.logic.host import Configured
from tapping_cell.logic.objects_on_table import ObjectsOnTable
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.logic.planner_reports import Scene
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.nodes.cell_identity import key_of, state_folder
from tapping_cell.nodes.cell_node import BEST_EFFORT_COMMAND, COMMAND, LATCHED, run
from tapping_cell.nodes.cell_parameters import FRAME_PREFIX
from tapping_cell.nodes.frame_names import add_prefix, remove_table_prefix
from tapping_cell.nodes.logic_host import LogicHost, LogicNode
from tapping_cell.nodes.message_conversion import from_ros, to_ros
from tapping_cell.nodes.planner.markers import cell_markers
from tapping_cell.nodes.planner.tf_frames import open_frames
from tapping_cell.planning import PlanningError


class DeferredActionServer:
    """Action servers of one node that finish a goal when its result is known, long after its
    callback returned. They accept every goal, because only an accepted goal has a
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


@dataclass(frozen=True, slots=True)
class Parameters(PlannerSettings):
    """Parameters of tap_planner."""

    autostart: bool = text("configure and activate automatically at start-up", default=True)
    cell_file: str = text("path of the cell file; if empty, the package's default", default="")
    frame_prefix: str = text(FRAME_PREFIX, default="")
    object_file: str = text(
        "path of the object file; if empty, the one named in the cell file", default=""
    )
    other_object_files: str = text(
        "paths of the object files of obstacles on the table, separated by commas; give "
        "camera_pose the same value",
        default="",
    )


class PlannerHost(LogicHost[PlannerLogic]):
    """Host of the planner's state machine; publishes the scenes of this machine as markers."""

    def _publish(self, effect: effects.Publish) -> None:
        if not isinstance(effect.message, Scene):
            super()._publish(effect)
            return
        goals = self._logic.goals
        markers = cell_markers(goals.cell, effect.message, goals.outline())
        self._publishers["markers"].publish(markers)


class TapPlanner(LogicNode[Parameters]):
    """See the module's docstring."""

    changeable = ("planner", "ask")

    def __init__(self) -> None:
        super().__init__("tap_planner", Parameters)
        self.logic = PlannerLogic(self.settings)
        host = self.host = PlannerHost(self, self.logic, state_folder(key_of(self)))
        self._tokens: dict[bytes, int] = {}
        host.publishes(messages.TapCommand, "tap_command", COMMAND)
        host.publishes(messages.PlanState, "plan_state", LATCHED)
        host.publishes(messages.ArrangementState, "arrangement_state", LATCHED)
        host.publishes(messages.GoalReport, "goal_report", LATCHED)
        host.offers(MarkerArray, "markers", LATCHED)
        # A reliable subscription does not match best-effort publishers, and a best-effort
        # subscription may miss messages of a reliable publisher. Therefore both are used, and a
        # goal that is received twice counts once.
        self._goals_received: deque[int] = deque(maxlen=COMMAND.depth)
        for profile in (COMMAND, BEST_EFFORT_COMMAND):
            self.create_subscription(
                PoseStamped,
                "goal_pose",
                cast(Callable[[PoseStamped], None], self._on_goal_pose),
                profile,
            )
        host.subscribes(messages.ObjectStates, "object_states", LATCHED)
        host.subscribes(messages.UnknownObjects, "unknown_objects", LATCHED)
        host.subscribes(messages.PoseStamped, "camera/pose", LATCHED)
        host.subscribes(messages.ArmState, "arm_state", LATCHED)
        host.subscribes(messages.TapperState, "tapper_state", LATCHED)
        host.serves(messages.ConfirmTap, "confirm_tap")
        host.serves(messages.Trigger, "~/cancel")
        self._frames = open_frames(self, self.settings.frame_prefix)
        self._actions = DeferredActionServer(
            self,
            {
                name: (kind, partial(self._on_goal, name, goal))
                for name, kind, goal in (
                    ("arrange_objects", ArrangeObjects, messages.ArrangeObjects.Goal),
                    ("position_object", PositionObject, messages.PositionObject.Goal),
                    ("single_tap", SingleTap, messages.SingleTap.Goal),
                )
            },
            self._on_cancel,
        )

    # Life cycle

    def configure(self) -> None:
        """Read the files, create the planning method and the map of the table."""
        settings = self.settings
        cell = load_cell(settings.cell_file or None, settings.object_file or None)
        objects = (cell.object, *load_further_objects(cell, settings.other_object_files))
        try:
            goals = goal_handling_class(cell)(
                cell,
                settings.planner,
                ObjectsOnTable(objects, settings.others_memory, settings.moved_limit),
                self.host.now(),
                objective=settings.objective,
                adapt=settings.adapt,
                probe=settings.probe,
                keep_for=key_of(self) if settings.keep_gains else "",
                time_limit=settings.goal_time_limit,
                frames=self._frames,
            )
        except PlanningError as error:
            raise ConfigurationError(f"{cell.path}: {error}") from error
        self.host.start(None)
        if self.host.goal_file.is_of_earlier_boot():
            # The age does not tell: a computer may start faster, or with a wrong clock.
            self.host.goal_file.keep(None)
            self.get_logger().warning(
                "the goal that was under way when this computer lost power or was restarted is not"
                " resumed; send the goal again"
            )
        kept = self.host.goal_file.recall()
        age = self.host.goal_file.age() if kept is not None else math.inf
        self.host.lifecycle(Configured(cell, goals, kept_goal=kept, kept_goal_age=age))

    def change(self, name: str, value: object) -> None:
        """Change the planning method, or whether every tap requires confirmation."""
        if name == "ask":
            request = messages.SetBool.Request(data=bool(value))
            self.host.request("ask", request, lambda _: None)
        elif self.configured:
            self.logic.goals.use(str(value))

    def has_unsent_results(self) -> bool:
        """Return whether goals have ended whose clients have not received the result yet."""
        return self._actions.has_unsent_results

    def destroy_node(self) -> None:
        """Also destroy the action servers, which rclpy does not destroy. Otherwise, clients would
        see an incomplete planner until garbage collection."""
        self._actions.close()
        LogicNode.destroy_node(self)

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Report the state and the remaining error of the goal."""
        last = self.logic.last
        values: dict[str, object] = {
            "state": self.logic.state.value,
            "taps": last.taps,
            "residual distance (mm)": f"{1000 * last.residual_distance:.3f}",
            "residual rotation (deg)": f"{math.degrees(last.residual_rotation):.3f}",
        }
        if self.configured:
            values.update(self.logic.goals.learnt())
        if last.error_code:
            return DiagnosticStatus.WARN, last.error_msg, values
        return DiagnosticStatus.OK, "ok", values

    def _on_goal_pose(self, message: PoseStamped, info: dict[str, int]) -> None:
        sent = info["source_timestamp"]
        if sent not in self._goals_received:
            self._goals_received.append(sent)
            self.host.receive("goal_pose", from_ros(message, messages.PoseStamped))

    # Actions

    def _on_goal(self, action: str, kind: type[Any], handle: ServerGoalHandle) -> None:
        goal = bytes(handle.goal_id.uuid)
        answered = False  # a refused goal is answered before ``request`` returns

        def answer(result: Any) -> None:
            nonlocal answered
            answered = True
            self._tokens.pop(goal, None)
            self._actions.keep(handle, self._to_wire(result))
            self.host.later(lambda: self._actions.finish(handle))

        def feedback(content: Any) -> None:
            if handle.is_active:
                handle.publish_feedback(self._to_wire(content))

        remove_table_prefix(handle.request, self.settings.frame_prefix)
        token = self.host.request(action, from_ros(handle.request, kind), answer, feedback)
        if not answered:
            self._tokens[goal] = token

    def _to_wire(self, content: Any) -> Any:
        message = to_ros(content)
        add_prefix(message, self.settings.frame_prefix)
        return message

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        token = self._tokens.get(bytes(handle.goal_id.uuid))
        if token is None:
            return CancelResponse.REJECT
        # The cancellation is processed after this callback has returned, because the goal must be
        # in state "canceling" before its result is set.
        self.host.later(lambda: self.host.cancel(token))
        return CancelResponse.ACCEPT


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(TapPlanner, arguments)


if __name__ == "__main__":
    sys.exit(main())
