"""Service server that can respond after its callback has returned; rclpy does not support this.

A callback that is a coroutine and waits for its result would block a single-threaded executor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

from rclpy.node import Node

Respond = Callable[[Any], None]


class _Sends(Protocol):
    """Service for which rclpy's executor calls ``send_response`` with the value that the callback
    has returned."""

    send_response: Callable[[Any, Any], None]


class _Later:
    """Placeholder that the callback returns until the response is available."""

    def __init__(self, send: Callable[[Any, Any], None]) -> None:
        self._send = send
        self._header: Any = None
        self._response: Any = None

    def respond(self, response: Any) -> None:
        self._response = response
        self._finish()

    def addressed(self, header: Any) -> None:
        self._header = header
        self._finish()

    def _finish(self) -> None:
        if self._header is not None and self._response is not None:
            self._send(self._response, self._header)


def create_deferred_service(
    node: Node, kind: Any, name: str, serve: Callable[[Any, Respond], None]
) -> None:
    """Create a service. ``serve`` receives each request together with a function that must be
    called once, immediately or later, with the response."""

    def callback(request: Any, _: Any) -> _Later:
        later = _Later(send)
        serve(request, later.respond)
        return later

    service = cast(_Sends, node.create_service(kind, name, callback))
    send = service.send_response
    service.send_response = lambda later, header: later.addressed(header)
