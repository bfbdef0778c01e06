"""A service that answers when the answer is known; rclpy answers when its callback returns.

A callback that waited as a coroutine would keep a single-threaded executor from everything else.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

from rclpy.node import Node

Respond = Callable[[Any], None]


class _Sends(Protocol):
    """What rclpy's executor hands a callback's result to."""

    send_response: Callable[[Any, Any], None]


class _Later:
    """What the callback returns in place of a response, until there is one."""

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
    """Offer a service. ``serve`` gets a request and what to call once with its response."""

    def callback(request: Any, _: Any) -> _Later:
        later = _Later(send)
        serve(request, later.respond)
        return later

    service = cast(_Sends, node.create_service(kind, name, callback))
    send = service.send_response
    service.send_response = lambda later, header: later.addressed(header)
