"""Web server of the operator's page: a separate thread with tornado's event loop.

This module does not depend on ROS. The node is a :class:`Backend`, whose methods are called in the
server's thread and must not block. The node passes its content to :meth:`PageServer.show`,
:meth:`PageServer.show_runs` and :meth:`PageServer.show_picture` from any thread. Every page gets
only the latest state and image: a slow page receives fewer of them, and a page that does not read
at all is disconnected.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import secrets
import socket
import struct
import threading
import time
from base64 import b64encode
from collections import deque
from collections.abc import Callable
from hashlib import sha256
from http.client import responses
from pathlib import Path
from typing import Any, BinaryIO, Protocol
from urllib.parse import unquote

from tornado.httpserver import HTTPServer
from tornado.iostream import StreamClosedError
from tornado.netutil import bind_sockets
from tornado.web import Application, RequestHandler, StaticFileHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from tapping_cell.nodes.page.guard import Guard, host_name
from tapping_cell.nodes.page.metrics import ABSENT, Metrics
from tapping_cell.nodes.page.requests import (
    LARGEST_MESSAGE,
    BadRequest,
    Command,
    Frequent,
    Hello,
    Request,
    Seen,
    parse,
)
from tapping_cell.nodes.page.runs import Runs
from tapping_cell.report.palette import css_variables
from tapping_cell.report.rendering import TEMPLATES
from tapping_cell.report.run_folder import RunError

STATIC = Path(__file__).parent / "static"
MAX_PAGES = 16
HELLO_TIMEOUT_S = 5.0
"""Timeout for the first message of a connection."""
WRITE_TIMEOUT_S = 5.0
"""Timeout for a page to read its data."""
PING_PERIOD_S = 5.0
MAX_MESSAGES = 100
"""Maximum number of messages of one page per second. If a page sends more, it is disconnected."""
MAX_COMMANDS = 10
"""Maximum number of goals and commands of one page per second, except for those in UNLIMITED.
Further requests are refused."""
UNLIMITED = tuple(Command(name) for name in ("stop", "cancel", "enable", "disable"))
"""Commands that only MAX_MESSAGES limits: those that end a motion, and the heartbeats of the
enabling key."""
MAX_ANSWERS = 64
"""Maximum number of queued responses for one page."""
MAX_DOWNLOADS = 2
"""Maximum number of concurrent downloads. Packing a run needs a thread and disk space."""
PIECE_TIMEOUT_S = 60.0
"""Timeout of a download without progress."""

# WebSocket close codes; 4000 to 4999 are reserved for private use.
BAD_TOKEN = 4401
TOO_MANY_PAGES = 4409
TOO_MANY_MESSAGES = 4429

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self' {stop}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
REPORT_SCRIPTS = " ".join(
    f"'sha256-{b64encode(sha256((TEMPLATES / name).read_bytes()).digest()).decode('ascii')}'"
    for name in ("replay.js", "sorting.js")
)
REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    f"script-src {REPORT_SCRIPTS}; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'; sandbox allow-scripts"
)
"""Content security policy of a report. The report is shown unchanged, but can run no script except
the player and the sorting of tables of this version. Browsers treat the report and the operator's
page as pages of different web sites."""
HEADERS = {
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cache-Control": "no-cache",
    "Server": "tapping cell",
}
PICTURE_HEADER = struct.Struct("!Idd")
"""Header before the JPEG: number of the image, stamp of the image in s, and age of the image in s
when it is sent."""

Answer = Callable[[dict[str, object]], None]
"""Function that sends a page its response; may be called from any thread."""


class Backend(Protocol):
    """Interface of the node for the pages. Called in the server's thread; must not block."""

    def greet(self) -> dict[str, object]:
        """Return the values that are constant while the node is active."""

    def on_pages(self, count: int) -> None:
        """Process a change in the number of open pages."""

    def on_request(self, page: object, request: Request, who: str, answer: Answer) -> None:
        """Process a request of a page."""

    @property
    def metrics(self) -> Metrics | None:
        """Return the numbers for Prometheus; None if its library is not installed."""

    @property
    def runs(self) -> Runs:
        """Return the recorded runs."""


class PageServer:
    """Serve the page on sockets that are already bound."""

    def __init__(
        self, guard: Guard, backend: Backend, sockets: list[socket.socket], stop_port: int
    ) -> None:
        """``stop_port``: port on which :mod:`tapping_cell.nodes.page.stop_server` serves STOP."""
        self.guard = guard
        self.backend = backend
        self.pages: set[PageSocket] = set()
        self.downloads = 0
        self._stop_port = stop_port
        self._sockets = sockets
        self._state = ""
        self._runs = ""
        self._pictures = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ending = asyncio.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="operator page", daemon=True)

    def start(self) -> None:
        """Start the server in a separate thread."""
        self._thread.start()
        self._ready.wait(5.0)

    def close(self, patience: float = 3.0) -> None:
        """Close every page and end the thread."""
        self.call(self._ending.set)
        self._thread.join(patience)
        for each in self._sockets:
            each.close()

    @property
    def wants_picture(self) -> bool:
        """Whether a page waits for an image. May be called from any thread."""
        return any(page.wants_picture for page in tuple(self.pages))

    def show(self, state: dict[str, object]) -> None:
        """Send this state to every page. May be called from any thread."""
        self.call(self._show, json.dumps({"type": "state", **state}, allow_nan=False))

    def show_runs(self, runs: list[dict[str, object]]) -> None:
        """Send the list of runs to every page. May be called from any thread."""
        content = {"type": "runs", "folder": str(self.backend.runs.folder), "runs": runs}
        self.call(self._show_runs, json.dumps(content, allow_nan=False))

    def show_picture(self, jpeg: bytes, stamp: float, age: float) -> None:
        """Send an image to every page that waits for one. May be called from any thread."""
        self.call(self._show_picture, jpeg, stamp, age)

    def call(self, function: Callable[..., object], *arguments: object) -> None:
        """Call a function in the server's thread. May be called from any thread."""
        loop = self._loop
        if loop is not None:
            # After the event loop has ended, there is no page left.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(function, *arguments)

    # The methods below run in the server's thread.

    def _run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        handlers: list[Any] = [
            ("/live", PageSocket),
            ("/stop-port", StopPortHandler),
            ("/palette.css", PaletteHandler),
            ("/metrics", MetricsHandler),
            (r"/runs/([A-Za-z0-9_-]{22})/([^/]{1,400})/(report\.html|run\.zip)", RunHandler),
            (r"/runs/([A-Za-z0-9_-]{22})/compare\.html", ComparisonHandler),
            ("/(.*)", FileHandler, {"path": str(STATIC), "default_filename": "index.html"}),
        ]
        application = Application(
            handlers,
            log_function=lambda _: None,
            page_server=self,
            stop_port=self._stop_port,
            websocket_ping_interval=PING_PERIOD_S,
            websocket_max_message_size=LARGEST_MESSAGE,
        )
        http = HTTPServer(
            application,
            max_header_size=16384,
            max_body_size=LARGEST_MESSAGE,
            idle_connection_timeout=60.0,
            body_timeout=10.0,
        )
        http.add_sockets(self._sockets)
        self._ready.set()
        await self._ending.wait()
        http.stop()
        for page in tuple(self.pages):
            page.close(1001, "the node operator_page ends")
        await asyncio.wait([asyncio.ensure_future(http.close_all_connections())], timeout=1.0)
        self._loop = None

    def _show(self, state: str) -> None:
        self._state = state
        for page in self.pages:
            page.show(state)

    def _show_runs(self, runs: str) -> None:
        self._runs = runs
        for page in self.pages:
            page.send(runs)

    def _show_picture(self, jpeg: bytes, stamp: float, age: float) -> None:
        self._pictures += 1
        frame = PICTURE_HEADER.pack(self._pictures % 2**32, stamp, age) + jpeg
        for page in self.pages:
            page.show_picture(self._pictures, frame)

    def join(self, page: PageSocket) -> bool:
        """Admit a page if the limit is not reached."""
        if len(self.pages) >= MAX_PAGES:
            return False
        self.pages.add(page)
        page.answer({"type": "welcome", "key": page.key, **self.backend.greet()})
        if self._runs:
            page.send(self._runs)
        if len(self.pages) > 1 and self._state:
            page.show(self._state)
        self.backend.on_pages(len(self.pages))
        return True

    def leave(self, page: PageSocket) -> None:
        """Remove a closed page."""
        if page in self.pages:
            self.pages.remove(page)
            self.backend.on_pages(len(self.pages))

    def has_key(self, key: str) -> bool:
        """Return whether a key belongs to an open page. If so, its owner may read the runs."""
        return any(secrets.compare_digest(page.key, key) for page in self.pages)


class _Guarded(RequestHandler):
    """Checks that precede every handler."""

    command = False

    @property
    def server(self) -> PageServer:
        """Return the server."""
        found: PageServer = self.settings["page_server"]
        return found

    def set_default_headers(self) -> None:
        """Set the security headers of every response, including refusals."""
        for name, value in HEADERS.items():
            self.set_header(name, value)
        name = host_name(self.request.host) or ""
        # A content security policy cannot contain an IPv6 address.
        place = f"http://{'*' if ':' in name else name}:{self.settings['stop_port']}"
        self.set_header("Content-Security-Policy", PAGE_POLICY.format(stop=place))

    def prepare(self) -> None:
        """Refuse a wrong Host or Origin, or an invalid path, before any other processing."""
        if not unquote(self.request.path).isprintable():
            self.refuse(400, "the path contains invalid characters")
            return
        headers = self.request.headers
        origin = headers.get("Origin") or headers.get("Sec-Websocket-Origin")
        refusal = self.server.guard.refusal(self.request.host, origin, command=self.command)
        if refusal:
            self.refuse(403, refusal)

    def refuse(self, status: int, sentence: str) -> None:
        """End the request with an error message."""
        self.set_status(status)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(sentence + "\n")

    def write_error(self, status_code: int, **_: Any) -> None:
        """Return a short error message without a traceback."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code} {responses[status_code]}\n")


class FileHandler(_Guarded, StaticFileHandler):
    """Serve the files of the page: index.html, style.css, page.js and the icon."""


class StopPortHandler(_Guarded):
    """Serve the port number of STOP."""

    def get(self) -> None:
        """Return the port number."""
        self.write(str(self.settings["stop_port"]))


class PaletteHandler(_Guarded):
    """Serve the colours that the page shares with reports and plots."""

    def get(self) -> None:
        """Return the style sheet."""
        self.set_header("Content-Type", "text/css; charset=utf-8")
        self.finish(css_variables())


class MetricsHandler(_Guarded):
    """Serve the numbers of the cell to Prometheus. With a token, it is required as a bearer."""

    def get(self) -> None:
        """Send the numbers."""
        if not self.server.guard.admits(
            self.request.headers.get("Authorization", "").removeprefix("Bearer ")
        ):
            self.refuse(401, "send the page's token: Authorization: Bearer TOKEN")
        elif (metrics := self.server.backend.metrics) is None:
            self.refuse(501, ABSENT)
        else:
            self.set_header("Content-Type", metrics.content_type)
            self.finish(metrics.text())


class _RunPage(_Guarded):
    """Checks and headers of the pages of recorded runs, which are served to everyone who has a page
    of the cell open."""

    def may_read(self, key: str) -> bool:
        """Return whether ``key`` is that of an open page; if not, refuse the request."""
        if not self.server.has_key(key):
            self.refuse(403, "this link belongs to a closed page; use a link on an open page")
            return False
        return True

    def begin_report(self) -> None:
        """Set the headers of a report."""
        self.set_header("Content-Security-Policy", REPORT_POLICY)
        self.set_header("Content-Type", "text/html; charset=utf-8")


class RunHandler(_RunPage):
    """Serve reports and archives of recorded runs."""

    async def get(self, key: str, name: str, what: str) -> None:
        """Send the report as a page, or the run's archive in chunks."""
        if not self.may_read(key):
            return
        if what == "run.zip":
            await self._archive(name)
            return
        report = self.server.backend.runs.report(name)
        if report is None:
            self.refuse(404, f"there is no report of a run '{name}'")
            return
        self.begin_report()
        with report.open("rb") as file:
            await self._send_file(file)

    async def _archive(self, name: str) -> None:
        if self.server.downloads >= MAX_DOWNLOADS:
            self.refuse(503, f"{MAX_DOWNLOADS} downloads are in progress; try again later")
            return
        self.server.downloads += 1
        try:
            loop = asyncio.get_running_loop()
            path = await loop.run_in_executor(None, self.server.backend.runs.archive, name)
            if path is None:
                self.refuse(404, f"there is no run '{name}'")
                return
            self.set_header("Content-Type", "application/zip")
            self.set_header("Content-Disposition", f'attachment; filename="{_plain(name)}.zip"')
            with path.open("rb") as file:
                path.unlink()  # removed whether or not the download succeeds
                await self._send_file(file)
        except OSError as error:
            self.refuse(500, f"the run '{name}' cannot be packed: {error.strerror or error}")
        finally:
            self.server.downloads -= 1

    async def _send_file(self, file: BinaryIO) -> None:
        self.set_header("Content-Length", str(os.fstat(file.fileno()).st_size))
        with contextlib.suppress(StreamClosedError, asyncio.TimeoutError):
            while piece := file.read(1 << 18):
                self.write(piece)
                await asyncio.wait_for(self.flush(), PIECE_TIMEOUT_S)


class ComparisonHandler(_RunPage):
    """Serve the comparison of the runs that the query names, in the order of the query."""

    async def get(self, key: str) -> None:
        """Send the comparison as a page."""
        if not self.may_read(key):
            return
        loop, runs = asyncio.get_running_loop(), self.server.backend.runs
        try:
            page = await loop.run_in_executor(None, runs.comparison, self.get_arguments("run"))
        except RunError as error:
            self.refuse(404, str(error))
            return
        self.begin_report()
        self.write(page)


class PageSocket(_Guarded, WebSocketHandler):
    """One open page."""

    command = True

    def initialize(self) -> None:
        """Prepare an unconnected page."""
        self.joined = False
        self.key = secrets.token_urlsafe(16)
        self._answers: deque[str] = deque()
        self._state = ""
        self._picture = b""
        self._awaited = 0
        self._wake = asyncio.Event()
        self._messages = _Count()
        self._commands = _Count()
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def wants_picture(self) -> bool:
        """Whether the page has drawn the last image that it received."""
        return self.joined and not self._awaited

    def check_origin(self, origin: str) -> bool:
        """Accept every origin, because :meth:`prepare` has already checked it."""
        return True

    def open(self, *_: str, **__: str) -> None:
        """Wait for the page's first message."""
        self.set_nodelay(True)
        self._tasks = [
            asyncio.ensure_future(self._expect_hello()),
            asyncio.ensure_future(self._write()),
        ]

    async def _expect_hello(self) -> None:
        await asyncio.sleep(HELLO_TIMEOUT_S)
        if not self.joined:
            self.close(BAD_TOKEN, "no hello")

    def on_message(self, message: str | bytes) -> None:
        """Process one message. Even if the message is invalid, the page receives a readable
        response."""
        if self.ws_connection is None:  # closed by the server, so remaining messages are ignored
            return
        if self._messages.add() > MAX_MESSAGES:
            self.close(TOO_MANY_MESSAGES, "too many messages per second")
            return
        try:
            request = parse(message)
        except BadRequest as error:
            self.answer({"type": "answer", "ok": False, "text": str(error)})
            return
        if isinstance(request, Hello):
            self._hello(request)
        elif not self.joined:
            self.close(BAD_TOKEN, "the first message must be hello, with the token")
        elif isinstance(request, Seen):
            if request.number == self._awaited:
                self._awaited = 0
        elif self._is_too_much(request):
            text = f"more than {MAX_COMMANDS} commands per second; wait a moment"
            self.answer({"type": "answer", "ok": False, "text": text})
        else:
            self.server.backend.on_request(
                self,
                request,
                self.request.remote_ip or "?",
                lambda answer: self.server.call(self.answer, answer),
            )

    def _is_too_much(self, request: Request) -> bool:
        """Count a request, unless it is unlimited or a frequent one. Return whether its page
        exceeds its limit."""
        if request in UNLIMITED or isinstance(request, Frequent):
            return False
        return self._commands.add() > MAX_COMMANDS

    def _hello(self, request: Hello) -> None:
        if self.joined:
            return
        if not self.server.guard.admits(request.token):
            self.close(BAD_TOKEN, "the token is wrong or missing")
        elif not self.server.join(self):
            self.close(TOO_MANY_PAGES, f"{MAX_PAGES} pages are open already; close one")
        else:
            self.joined = True

    def on_close(self) -> None:
        """Remove the closed page."""
        self.joined = False
        for task in self._tasks:
            task.cancel()
        self.server.leave(self)

    # Messages to the page

    def answer(self, content: dict[str, object]) -> None:
        """Send a response. All responses arrive in order."""
        self.send(json.dumps(content, allow_nan=False))

    def send(self, text: str) -> None:
        """Send a text. All texts arrive in order."""
        if len(self._answers) >= MAX_ANSWERS:
            self.close(TOO_MANY_MESSAGES, "too many messages at the same time")
            return
        self._answers.append(text)
        self._wake.set()

    def show(self, state: str) -> None:
        """Send a state, replacing an unsent one."""
        self._state = state
        self._wake.set()

    def show_picture(self, number: int, frame: bytes) -> None:
        """Send an image, unless the page is still busy with the last image."""
        if self.wants_picture:
            self._awaited = number % 2**32
            self._picture = frame
            self._wake.set()

    async def _write(self) -> None:
        """Send the pending messages one by one, and disconnect a page that does not read."""
        try:
            while True:
                await self._wake.wait()
                self._wake.clear()
                while self._answers:
                    await self._send(self._answers.popleft())
                state, self._state = self._state, ""
                if state:
                    await self._send(state)
                picture, self._picture = self._picture, b""
                if picture:
                    await self._send(picture)
        except (WebSocketClosedError, StreamClosedError):
            return
        except (TimeoutError, asyncio.TimeoutError):
            # The closing handshake would block, so only the stream is closed.
            if self.ws_connection is not None and self.ws_connection.stream is not None:
                self.ws_connection.stream.close()

    async def _send(self, content: str | bytes) -> None:
        sent = self.write_message(content, binary=isinstance(content, bytes))
        await asyncio.wait_for(sent, WRITE_TIMEOUT_S)


class _Count:
    """Count events within the current second."""

    def __init__(self) -> None:
        self._second = 0
        self._count = 0

    def add(self) -> int:
        """Count one event. Return the count of this second."""
        second = int(time.monotonic())
        self._count = self._count + 1 if second == self._second else 1
        self._second = second
        return self._count


def _plain(name: str) -> str:
    """Return a file name that is valid in a header."""
    return re.sub(r"[^\w.+-]", "_", name, flags=re.ASCII)


def bind(address: str, port: int) -> list[socket.socket]:
    """Return listening sockets; for localhost an IPv4 socket and, if available, an IPv6 socket.

    Raises:
        OSError: the port is in use, or the address does not belong to this machine.
    """
    return bind_sockets(port, address or None, backlog=32)
