"""Client of the planner's run-time parameters: reads the planning method, and sets parameters at
the request of a page."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future

from tapping_cell.nodes.page.calls import answer_to, call_service
from tapping_cell.nodes.page.server import Answer

READ_PERIOD_S = 1.0
TIMEOUT_S = 3.0
"""Timeout of a request, after which the planning method is requested again."""


class PlannerParameters:
    """Parameters of the planner. Use an instance only in the executor's thread."""

    def __init__(self, node: Node) -> None:
        self.method: str | None = None
        """Value of the planner's parameter ``planner``: the planning method, or empty for the
        method of the cell file. None if the planner is not running or has not responded yet."""
        self._node = node
        self._connect("tap_planner")

    def _connect(self, planner: str) -> None:
        self._planner = planner
        self._get_client: Client = self._node.create_client(
            GetParameters, f"{planner}/get_parameters"
        )
        self._set_client: Client = self._node.create_client(
            SetParameters, f"{planner}/set_parameters"
        )
        self.forget()

    def follow(self, planner: str) -> None:
        """Use the planner's node of this name from now on."""
        if planner != self._planner:
            self._node.destroy_client(self._get_client)
            self._node.destroy_client(self._set_client)
            self._connect(planner)

    def forget(self) -> None:
        """Discard the planning method, so that it is read again."""
        self.method = None
        self._requested: Future | None = None
        self._requested_at = -math.inf

    def refresh(self) -> None:
        """Request the planning method if the last request is old enough."""
        period = READ_PERIOD_S if self._requested is None else TIMEOUT_S
        if time.monotonic() - self._requested_at >= period:
            self._read()

    def _read(self) -> None:
        """Request the planning method, in place of an earlier request without a response."""
        if self._requested is not None:
            self._get_client.remove_pending_request(self._requested)
        if not self._get_client.service_is_ready():
            self.forget()
            return
        self._requested_at = time.monotonic()
        self._requested = self._get_client.call_async(GetParameters.Request(names=["planner"]))
        self._requested.add_done_callback(self._on_values)

    def _on_values(self, future: Future) -> None:
        if future is not self._requested:
            return
        self._requested = None
        values = [
            value.string_value
            for value in future.result().values
            if value.type == ParameterType.PARAMETER_STRING
        ]
        self.method = values[0] if values else None

    def set(
        self, name: str, value: bool | str, text: str, answer: Answer, on_set: Callable[[], None]
    ) -> None:
        """Set a parameter. The page receives ``text``, or the reason of the refusal. ``on_set`` is
        called if the parameter was set."""

        def on_reply(response: SetParameters.Response) -> None:
            result = response.results[0]
            answer(answer_to("settings", result.successful, result.reason or text))
            if result.successful:
                on_set()
            self._read()

        changed = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[changed])
        call_service(self._set_client, request, "settings", "the planner", answer, on_reply)
