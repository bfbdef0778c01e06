"""The separate server of STOP without ROS, with requests as from browsers and from attackers."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

import pytest
from tornado.httpclient import AsyncHTTPClient, HTTPRequest, HTTPResponse

from tapping_cell.nodes.page import server, stop_server
from tapping_cell.nodes.page.guard import Guard

PAGE_PORT = 8010
PERIOD_S = 0.2


@pytest.fixture(autouse=True)
def _slow_repeat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Repeat stops so slowly that no pause of a busy machine lasts a period."""
    monkeypatch.setattr(stop_server, "REPEAT_PERIOD_S", PERIOD_S)


@dataclass
class Site:
    """A running STOP server."""

    token: str = ""
    published: list[bool] = field(default_factory=list)
    reported: list[tuple[bool, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        sockets = server.bind("127.0.0.1", 0)
        self.port = sockets[0].getsockname()[1]
        self.level = stop_server.StopLevel(
            self.published.append, lambda *report: self.reported.append(report), False
        )
        guard = Guard.make("127.0.0.1", (), self.token)
        self.server = stop_server.StopServer.make(self.level, guard, PAGE_PORT)
        self.server.add_sockets(sockets)

    async def post(
        self, content: object, origin: str = f"http://127.0.0.1:{PAGE_PORT}", host: str = ""
    ) -> HTTPResponse:
        body = content if isinstance(content, (str, bytes)) else json.dumps(content)
        headers = {"Origin": origin, "Host": host or f"127.0.0.1:{self.port}"}
        asked = HTTPRequest(
            f"http://127.0.0.1:{self.port}/", method="POST", body=body, headers=headers
        )
        return await AsyncHTTPClient().fetch(asked, raise_error=False)


def play(scenario: Callable[[Site], Awaitable[None]], token: str = "") -> Site:
    made: list[Site] = []

    async def run() -> None:
        made.append(Site(token))
        await asyncio.wait_for(scenario(made[0]), 30.0)
        made[0].server.stop()
        await made[0].server.close_all_connections()

    asyncio.run(run())
    return made[0]


def test_a_stop_is_published_at_once_and_held_until_it_is_released() -> None:
    async def scenario(site: Site) -> None:
        answer = await site.post({"do": "stop"})
        assert (answer.code, json.loads(answer.body)) == (200, {"held": True})
        assert answer.headers["Access-Control-Allow-Origin"] == f"http://127.0.0.1:{PAGE_PORT}"
        assert site.published == [True] and site.reported == [(True, "127.0.0.1")]
        assert json.loads((await site.post({"do": "check"})).body) == {"held": True}
        site.level.release()
        assert json.loads((await site.post({"do": "check"})).body) == {"held": False}

    site = play(scenario)
    assert site.published == [True, False]


def test_a_stop_that_is_held_is_published_again_but_not_without_limit() -> None:
    async def scenario(site: Site) -> None:
        for _ in range(200):
            site.level.stop("somebody")
        assert site.published == [True]
        await asyncio.sleep(3 * PERIOD_S)
        assert site.published == [True, True]
        site.level.stop("somebody")
        assert site.published == [True, True, True]
        site.level.stop("somebody")
        site.level.release()
        await asyncio.sleep(3 * PERIOD_S)
        assert site.published == [True, True, True, False]

    play(scenario)


def test_a_stop_soon_after_a_release_is_reported_once() -> None:
    async def scenario(site: Site) -> None:
        site.level.stop("somebody")
        site.level.release()
        site.level.stop("another")
        site.level.stop("another")  # the same press on the page's other connection
        await asyncio.sleep(3 * PERIOD_S)
        assert site.published == [True, False, True]
        assert site.reported == [(True, "somebody"), (False, ""), (True, "another")]
        site.level.stop("another")
        site.level.stop("another")
        await asyncio.sleep(3 * PERIOD_S)
        # A repeated stop that is already held is reported without its requester.
        assert site.reported[3:] == [(True, "another"), (True, "")]

    play(scenario)


def test_a_stop_of_a_crashed_process_is_held_by_the_next() -> None:
    published: list[bool] = []
    stop_server.StopLevel(published.append, lambda *_: None, held=True)
    assert published == [True]


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        ("http://evil.example", ""),
        ("null", ""),
        ("http://[", ""),
        ("http://127.0.0.1:9999", ""),
        ("http://127.0.0.1", ""),
        ("http://localhost:8010", ""),
        ("http://evil.example:8010", "evil.example"),
    ],
)
def test_another_web_site_cannot_stop_the_cell(origin: str, host: str) -> None:
    async def scenario(site: Site) -> None:
        assert (await site.post({"do": "stop"}, origin, host)).code == 403

    assert play(scenario).published == []


@pytest.mark.parametrize("token", ["", "wrong", None, ["the-right-token"], 7])
def test_without_the_token_nothing_is_stopped(token: object) -> None:
    async def scenario(site: Site) -> None:
        assert (await site.post({"do": "stop", "token": token})).code == 401
        assert site.published == []
        assert (await site.post({"do": "stop", "token": "the-right-token"})).code == 200

    assert play(scenario, "the-right-token").published == [True]


@pytest.mark.parametrize(
    "body", ["", "{", "[]", "7", '"stop"', "null", '{"do": 1}', "[" * 1000, b"\xff\x00", "{}"]
)
def test_invalid_requests_are_refused_and_stop_nothing(body: str | bytes) -> None:
    async def scenario(site: Site) -> None:
        assert (await site.post(body)).code == 400

    assert play(scenario).published == []


def test_a_body_that_is_too_long_is_not_read() -> None:
    async def scenario(site: Site) -> None:
        answer = await site.post("x" * (stop_server.LONGEST_BODY + 1))
        assert answer.code in (400, 413, 599)

    assert play(scenario).published == []


def test_connections_that_stay_open_leave_room_for_a_stop() -> None:
    async def scenario(site: Site) -> None:
        held = []
        for _ in range(stop_server.MAX_CONNECTIONS + 20):
            line = socket.create_connection(("127.0.0.1", site.port))
            line.sendall(b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 9\r\n\r\n")
            held.append(line)
            await asyncio.sleep(0)
        assert (await site.post({"do": "stop"})).code == 200
        held[0].settimeout(30.0)
        assert held[0].recv(1) == b"", "the oldest connection is closed"
        held_open = len(site.server._streams) + len(site.server._admitted)
        assert held_open <= stop_server.MAX_CONNECTIONS
        for line in held:
            line.close()

    assert play(scenario).published == [True]


def test_a_flood_of_connections_does_not_close_the_connection_of_a_page() -> None:
    async def scenario(site: Site) -> None:
        body = json.dumps({"do": "check"}).encode()
        request = (
            f"POST / HTTP/1.1\r\nHost: 127.0.0.1:{site.port}\r\n"
            f"Origin: http://127.0.0.1:{PAGE_PORT}\r\nContent-Length: %d\r\n\r\n"
        ).encode()
        reader, writer = await asyncio.open_connection("127.0.0.1", site.port)

        async def ask(content: bytes) -> bytes:
            writer.write(request % len(content) + content)
            head = await reader.readuntil(b"\r\n\r\n")
            length = int(head.split(b"Content-Length: ")[1].split(b"\r\n")[0])
            return await reader.readexactly(length)

        assert json.loads(await ask(body)) == {"held": False}
        flood = []
        for _ in range(2 * stop_server.MAX_CONNECTIONS):
            line = socket.create_connection(("127.0.0.1", site.port))
            line.sendall(request % 15)
            flood.append(line)
            await asyncio.sleep(0)
        assert json.loads(await ask(b'{"do": "stop"}')) == {"held": True}
        assert site.published == [True]
        for line in flood:
            line.close()
        writer.close()

    play(scenario)
