"""HTTP server of STOP, on its own port, so that no other traffic of the pages can delay a stop.

A request is one JSON object in plain text, ``{"do": "stop", "token": ...}`` or ``{"do": "check",
...}``, and the response is ``{"held": ...}``. A stop needs no existing connection. When too many
connections are open, the oldest one is closed to accept the newest, so that no client can occupy
all connections. Connections that have sent an admitted request belong to pages and are closed last,
so that a page keeps its connection even during a flood of new connections. Checks and refused
requests are answered slowly, to limit the request rate of a connection.
"""

from __future__ import annotations

import asyncio
import json
import resource
import time
from collections.abc import Callable
from functools import partial
from http.client import responses
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream
from tornado.web import Application, RequestHandler

from tapping_cell.nodes.page.guard import Guard

LONGEST_BODY = 1024
MAX_CONNECTIONS = 256
SPARE_FILES = 16
"""Files that the process may open besides the connections, for example to accept one more."""
REPEAT_PERIOD_S = 0.02
"""Minimum time (s) from a published stop or release to the next published stop. All stops that
arrive earlier are published together, as one stop, at the end of this time."""
SLOW_ANSWER_S = 0.1


def connections_within_limit(open_files: int) -> tuple[int, int]:
    """Raise the process's limit of open files as far as needed and allowed. Return how many
    connections fit into it, and the limit.

    ``open_files``: number of files that the process has open now.
    """
    limit, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = open_files + SPARE_FILES + MAX_CONNECTIONS
    if limit < wanted:
        limit = wanted if most == resource.RLIM_INFINITY else min(wanted, most)
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, most))
    return max(1, min(MAX_CONNECTIONS, limit - open_files - SPARE_FILES)), limit


class StopLevel:
    """Stop state of the page: held from STOP until a person releases it."""

    def __init__(
        self, publish: Callable[[bool], None], report: Callable[[bool, str], None], held: bool
    ) -> None:
        """``publish``: sends the stop state (True: stopped) to the cell. ``report``: sends the stop
        state and the name of the requester to the page's node. ``held``: whether a stop was held
        before this process started; if so, the stop is held again."""
        self.held = held
        self._publish = publish
        self._report = report
        self._published_at = 0.0
        self._repeat: asyncio.TimerHandle | None = None
        if held:
            self._publish_now()

    def stop(self, who: str) -> None:
        """Hold the stop. A stop that is already held is published again, because the actors may
        have been reset."""
        newly_held, self.held = not self.held, True
        wait = self._published_at + REPEAT_PERIOD_S - time.monotonic()
        if wait <= 0:
            self._publish_now()
            self._report(True, who)
        elif self._repeat is None:
            # The page sends each stop on two connections, but the node must log it only once.
            again = partial(self._publish_again, who if newly_held else "")
            self._repeat = asyncio.get_running_loop().call_later(wait, again)

    def release(self) -> None:
        """Release the stop at a person's request."""
        if self._repeat is not None:
            self._repeat.cancel()
            self._repeat = None
        self.held = False
        self._publish_now()
        self._report(False, "")

    def _publish_again(self, who: str) -> None:
        self._repeat = None
        self._publish_now()
        self._report(True, who)

    def _publish_now(self) -> None:
        self._publish(self.held)
        self._published_at = time.monotonic()


class StopHandler(RequestHandler):
    """Handle one stop, or one check that a stop would be received."""

    def initialize(self, server: StopServer) -> None:
        """Store the server."""
        self._server = server

    def set_default_headers(self) -> None:
        """Set headers against caching, content sniffing and framing."""
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Server", "tapping cell")

    async def post(self) -> None:
        """Process a request."""
        origin = self.request.headers.get("Origin")
        guard, level = self._server.guard, self._server.level
        refusal = guard.refusal(
            self.request.host, origin, command=True, page_port=self._server.page_port
        )
        if refusal:
            await self._refuse(403, refusal)
            return
        self.set_header("Access-Control-Allow-Origin", origin or "")
        try:
            content = json.loads(self.request.body)
            asked, token = content["do"], content.get("token")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            await self._refuse(400, "the request is not a JSON object with 'do'")
            return
        if not guard.admits(token):
            await self._refuse(401, "the token is wrong or missing")
            return
        self._server.admit(self.request.connection)
        if asked == "stop":
            level.stop(self.request.remote_ip or "?")
            self.write({"held": True})
        elif asked == "check":
            await asyncio.sleep(SLOW_ANSWER_S)
            self.write({"held": level.held})
        else:
            await self._refuse(400, "'do' is neither stop nor check")

    async def _refuse(self, status: int, sentence: str) -> None:
        await asyncio.sleep(SLOW_ANSWER_S)
        self.set_status(status)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.write(sentence + "\n")

    def write_error(self, status_code: int, **_: Any) -> None:
        """Return a short error message without a traceback."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code} {responses[status_code]}\n")


class StopServer(HTTPServer):
    """Serve on sockets that are already bound. If too many connections are open, the oldest one is
    closed to accept a new one."""

    level: StopLevel
    guard: Guard
    page_port: int
    connections: int

    def initialize(self, *arguments: Any, **options: Any) -> None:
        """Initialise without connections."""
        super().initialize(*arguments, **options)
        self._streams: list[IOStream] = []
        self._admitted: list[IOStream] = []

    @classmethod
    def make(
        cls, level: StopLevel, guard: Guard, page_port: int, connections: int = MAX_CONNECTIONS
    ) -> StopServer:
        """Return a server for ``level``. The server accepts requests of pages that are served at
        ``page_port``, if the requests meet the requirements of ``guard``, on at most
        ``connections`` connections at once."""
        application = Application(log_function=lambda _: None)
        made = cls(
            application,
            max_header_size=4096,
            max_body_size=LONGEST_BODY,
            idle_connection_timeout=20.0,
            body_timeout=2.0,
        )
        made.level, made.guard, made.page_port = level, guard, page_port
        made.connections = connections
        application.add_handlers(".*", [("/", StopHandler, {"server": made})])
        return made

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Accept a new connection."""
        self._forget_closed()
        while len(self._streams) + len(self._admitted) >= self.connections:
            (self._streams or self._admitted).pop(0).close()
        self._streams.append(stream)
        super().handle_stream(stream, address)

    def admit(self, connection: Any) -> None:
        """Mark a connection that has sent an admitted request as the connection of a page. Such
        connections are closed after all other connections."""
        stream = connection.stream
        if stream in self._streams:
            self._streams.remove(stream)
            self._admitted.append(stream)

    def _forget_closed(self) -> None:
        self._streams = [each for each in self._streams if not each.closed()]
        self._admitted = [each for each in self._admitted if not each.closed()]
