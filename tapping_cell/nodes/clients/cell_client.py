"""Client that monitors and commands a whole cell from a terminal, as the page does in a browser.

The verbs `up`, `status`, `home`, `jog`, `stop`, `clear` and `commission` use this client. There is
no separate executable for it.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from rclpy.client import Client
from rclpy.task import Future
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import GoalReport, PlanState, StopState

from tapping_cell.messages import Jog
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.client_node import ClientNode
from tapping_cell.nodes.message_conversion import to_ros
from tapping_cell.nodes.page.cell_view import CellView, Mode, with_code
from tapping_cell.nodes.page.node_watch import ACTORS, ARM, CAMERAS, NOT_YET, NodeWatch
from tapping_cell.nodes.private_names import PrivateNames

NAME = "cell_client"
STOP_TIMEOUT_S = 2.0
PERIOD_S = 0.02


class NoCell(RuntimeError):
    """No node of a cell responds. The message states the remedy."""


class NotDone(RuntimeError):
    """The cell did not execute a command. The message states the reason."""


class CellClient(ClientNode):
    """Client that monitors and commands a whole cell. Use as a context manager."""

    def __init__(self, namespace: str = "") -> None:
        super().__init__(NAME, namespace)
        self._view = CellView()
        subscribe, view = self.node.create_subscription, self._view
        for kind, topic, process in view.device_topics():
            subscribe(kind, topic, process, LATCHED)
        subscribe(PlanState, "plan_state", view.on_plan, LATCHED)
        subscribe(GoalReport, "goal_report", view.on_report, LATCHED)
        subscribe(Bool, "emergency_stop", self._on_stop_level, LATCHED)
        # The clients exist from the start, because the discovery of a server takes time.
        self._private = PrivateNames(self.node)
        self._private.client(ARM, "home")
        self._private.client(ARM, "jog")
        self._private.client("sim_world", "press_clear_button")
        for actor in ACTORS:
            for service in ("stop", "clear_fault"):
                self._private.client(actor, service)
            process = partial(view.on_stop, actor)
            self._private.subscribe(StopState, actor, "stop_state", process, LATCHED)
        self._watch = NodeWatch(self.node)

    def _on_stop_level(self, message: Bool) -> None:
        self._view.emergency_stop = message.data

    # State

    def mode(self) -> Mode:
        """Return the mode of the whole cell, with message and code."""
        return self.in_executor(self._view.mode)

    def state(self) -> dict[str, Any]:
        """Return the state that the page shows, with the rows of the page's list of nodes
        (``nodes``) and whether ``sim_world`` runs (``simulated``)."""

        def gather() -> dict[str, Any]:
            self._view.simulated = self._watch.runs("sim_world")
            self._watch.has_arm = self._view.has_arm
            state, simulated = self._view.state(), self._view.simulated
            return {**state, "nodes": self._watch.rows(), "simulated": simulated}

        return self.in_executor(gather)

    def wait_for_cell(self, patience: float) -> dict[str, Any]:
        """Return the state once every required node has sent its diagnostics and the mode is no
        longer "not ready". After ``patience`` s, return the state as it is.

        Raises:
            NoCell: no node of a cell is running. Without any ROS node, this is known early.
        """
        deadline = time.monotonic() + patience
        while True:
            self.in_executor(self._watch.check)
            state = self.state()
            received = [row for row in state["nodes"] if row["life"] != "not running"]
            known = {row["role"] for row in received if row["sentence"] != NOT_YET}
            measured = self.in_executor(lambda: self._watch.has_camera)
            has_camera = not known.isdisjoint(CAMERAS) or measured
            complete = known.issuperset(self._watch.core) and has_camera
            if (complete and state["mode"] != "not ready") or (
                received and time.monotonic() > deadline
            ):
                return state
            if time.monotonic() > deadline or self.is_alone():
                raise NoCell(self.no_answer())
            time.sleep(0.1)

    # Commands

    def stop(self) -> None:
        """Stop arm and tapper; this also ends the planner's goal. Return when both devices have
        confirmed the stop.

        Raises:
            NotDone: a device did not confirm the stop. The message names the device.
        """
        asked: dict[str, Future] = {}
        actors = self._actors()

        def ask() -> None:
            for actor in ACTORS:
                client = self._private.client(actor, "stop")
                if actor not in asked and client.service_is_ready():
                    asked[actor] = client.call_async(Trigger.Request())

        deadline = time.monotonic() + STOP_TIMEOUT_S
        missing = list(actors)
        while missing and time.monotonic() < deadline:
            self.in_executor(ask)
            missing = [actor for actor in actors if actor not in asked or not asked[actor].done()]
            time.sleep(PERIOD_S)
        if missing:
            raise NotDone(
                f"{' and '.join(missing)} did not confirm the stop within {STOP_TIMEOUT_S:.0f} s:"
                " use the wired emergency stop"
            )

    def _actors(self) -> tuple[str, ...]:
        """Return the roles of the nodes that move hardware in this cell: without the arm if the
        cell has fixed tappers."""
        has_arm = self.in_executor(lambda: self._view.has_arm)
        return tuple(actor for actor in ACTORS if has_arm or actor != ARM)

    def clear(self) -> list[str]:
        """Clear the stop and the faults of arm and tapper. Return their responses.

        Raises:
            NotDone: a device refuses, with the message of that device.
        """
        answers = [self._call(actor, "clear_fault") for actor in self._actors()]
        refused = [message for good, message in answers if not good]
        if refused:
            raise NotDone("; ".join(refused))
        return [message for _, message in answers]

    def home(self) -> str:
        """Start homing the arm. Raises NotDone with the message of the arm's node."""
        return self._command(ARM, "home")

    def jog(self, request: Jog.Request) -> None:
        """Start a manual motion of the arm. Raises NotDone with the reason of a refusal."""
        answer = self._response(ARM, "jog", to_ros(request))
        if not answer.accepted:
            raise NotDone(with_code(answer.error_msg, answer.error_code))

    def press_button(self) -> str:
        """Press the clear button of the simulated tapper. Raises NotDone if there is none."""
        return self._command("sim_world", "press_clear_button")

    def _command(self, role: str, service: str) -> str:
        good, message = self._call(role, service)
        if not good:
            raise NotDone(message)
        return message

    def _call(self, role: str, service: str) -> tuple[bool, str]:
        try:
            answer = self._response(role, service, Trigger.Request())
        except NotDone as error:
            return False, str(error)
        return bool(answer.success), f"{role}: {answer.message}"

    def _response(self, role: str, service: str, request: Any, patience: float = 5.0) -> Any:
        """Return the response of a service. Raises NotDone if there is none."""
        deadline = time.monotonic() + patience
        # The client is another one as soon as the node is found under another name.
        while not (client := self._ready_client(role, service)):
            if time.monotonic() > deadline:
                raise NotDone(f"{role} does not answer; is it running?")
            time.sleep(PERIOD_S)
        try:
            return self.result_of(lambda: client.call_async(request), patience)
        except TimeoutError:
            raise NotDone(f"{role} did not answer within {patience:.0f} s") from None

    def _ready_client(self, role: str, service: str) -> Client | None:
        def find() -> Client | None:
            client = self._private.client(role, service)
            return client if client.service_is_ready() else None

        return self.in_executor(find)
