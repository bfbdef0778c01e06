"""The web server without ROS, with requests as from browsers and from attackers."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import functools
import hashlib
import json
import os
import random
import re
import socket
import time
import urllib.error
import urllib.parse
import urllib.request
import zipfile
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from report_parts import made_run, tap_row
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import WebSocketClientConnection, WebSocketClosedError, websocket_connect

from tapping_cell.nodes.page import server
from tapping_cell.nodes.page.guard import Guard
from tapping_cell.nodes.page.requests import Command, Request
from tapping_cell.nodes.page.runs import Runs
from tapping_cell.nodes.recorder.run_names import STARRED
from tapping_cell.report.run_folder import write_illustrated_run
from tapping_cell.report.run_reader import IllustratedRun

TIMEOUT_S = 60.0
"""Time after which a test that waits for an event has failed, s."""
STOP_PORT = 8011


class Backend:
    """A backend that records the requests."""

    def __init__(self, folder: Path) -> None:
        self.requests: list[Request] = []
        self.counts: list[int] = []
        self.runs = Runs(folder)

    def greet(self) -> dict[str, object]:
        return {"cell": "test"}

    def on_pages(self, count: int) -> None:
        self.counts.append(count)

    def on_request(self, page: object, request: Request, who: str, answer: server.Answer) -> None:
        self.requests.append(request)
        answer({"type": "answer", "to": "test", "ok": True, "text": who})


class Site:
    """A running server."""

    def __init__(self, token: str, runs: Path) -> None:
        self.backend = Backend(runs)
        sockets = server.bind("127.0.0.1", 0)
        self.port = sockets[0].getsockname()[1]
        self.host = f"127.0.0.1:{self.port}"
        rules = Guard.make("127.0.0.1", (), token)
        self.server = server.PageServer(rules, self.backend, sockets, STOP_PORT)
        self.server.start()

    def get(self, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
        request = urllib.request.Request(f"http://{self.host}/{path}", headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
                return answer.status, dict(answer.headers), answer.read()
        except urllib.error.HTTPError as error:
            return error.code, dict(error.headers), error.read()

    @contextlib.asynccontextmanager
    async def page(
        self, hello: dict[str, object] | None = None, **headers: str
    ) -> AsyncIterator[WebSocketClientConnection]:
        """Open a WebSocket; with ``hello`` None, no first message is sent."""
        given = {"Origin": f"http://{self.host}", **headers}
        asked = HTTPRequest(f"ws://{self.host}/live", headers=given)
        connection = await websocket_connect(asked, max_message_size=1 << 24)
        if hello is not None:
            await connection.write_message(json.dumps({"do": "hello", **hello}))
        try:
            yield connection
        finally:
            connection.close()


async def read(connection: WebSocketClientConnection) -> Any:
    """Return the next message; None if the server has closed the connection."""
    message = await asyncio.wait_for(asyncio.ensure_future(connection.read_message()), TIMEOUT_S)
    return json.loads(message) if isinstance(message, str) else message


def in_loop(test: Callable[..., Any]) -> Callable[..., None]:
    """Run a test that is a coroutine in an event loop of its own."""

    @functools.wraps(test)
    def run(**fixtures: Any) -> None:
        asyncio.run(test(**fixtures))

    return run


async def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        await asyncio.sleep(0.01)


@pytest.fixture(params=[""], ids=["open"])
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Site]:
    made = Site(request.param, tmp_path / "runs")
    yield made
    made.server.close()


@pytest.fixture
def one_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count all messages of the test as those of one second, on a slow machine, too."""
    monkeypatch.setattr(server, "time", SimpleNamespace(monotonic=lambda: 7.5))


with_token = pytest.mark.parametrize("site", ["the-right-token"], indirect=True, ids=["token"])


# ---- static files


def test_the_page_is_served_with_headers_that_allow_nothing_foreign(site: Site) -> None:
    for path, kind in (("", "text/html"), ("page.js", "javascript"), ("style.css", "text/css")):
        status, headers, body = site.get(path)
        assert status == 200 and kind in headers["Content-Type"] and len(body) > 1000
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert "Tornado" not in headers["Server"]
        # the page loads nothing from other servers
        assert b"//cdn" not in body and b"https://" not in body
    assert b"onclick" not in site.get("")[2] and b"style=" not in site.get("")[2]


def test_every_colour_of_the_page_comes_from_the_palette(site: Site) -> None:
    status, headers, palette = site.get("palette.css")
    assert status == 200 and "text/css" in headers["Content-Type"]
    style = site.get("style.css")[2].decode()
    used = set(re.findall(r"var\(--([a-z-]+)\)", style))
    declared = set(re.findall(r"--([a-z-]+):", palette.decode() + style.replace(": ", ":")))
    assert used <= declared
    shades = {"#fff", "#000", "#000a", "#000b", "#000c"}  # white, black and translucent black
    assert set(re.findall(r"#[0-9a-f]{3,8}\b", style)) <= shades


@pytest.mark.parametrize(
    "path",
    [
        "../server.py",
        "..%2fserver.py",
        "%2e%2e/server.py",
        "nothing",
        "//etc/passwd",
        "%00",
        "style.css%00",
        "a%0d%0ab",
    ],
)
def test_no_other_file_is_served(site: Site, path: str) -> None:
    status, _, body = site.get(path)
    assert status in (400, 403, 404) and b"import" not in body and b"root:" not in body


def test_a_foreign_host_name_gets_no_file(site: Site) -> None:
    status, _, body = site.get("", Host="evil.example")
    assert status == 403 and b"not served under the name 'evil.example'" in body


# ---- access control


@pytest.mark.parametrize(
    ("headers", "words"),
    [
        ({"Origin": "http://evil.example"}, "http://evil.example may not connect"),
        ({"Origin": "null"}, "null may not connect"),
        ({"Origin": ""}, "without an Origin"),
        ({"Host": "evil.example", "Origin": "http://evil.example"}, "not served under the name"),
        ({"Origin": "http://["}, "http://[ may not connect"),
    ],
    ids=["other site", "sandbox", "no origin", "rebound name", "malformed"],
)
@in_loop
async def test_another_web_site_cannot_open_a_socket(site, headers, words):
    with pytest.raises(HTTPClientError) as refused:
        async with site.page({}, **headers):
            pass
    assert refused.value.code == 403
    assert words in refused.value.response.body.decode()
    assert site.backend.counts == [] and site.backend.requests == []


@with_token
@pytest.mark.parametrize("hello", [{}, {"token": "wrong"}, {"token": ""}, {"token": ["the"]}])
@in_loop
async def test_without_the_token_nothing_is_shown_and_nothing_is_done(site, hello):
    async with site.page(hello) as page:
        with contextlib.suppress(WebSocketClosedError):  # the server may have closed it already
            await page.write_message('{"do": "stop"}')
        assert await read(page) is None
        assert page.close_code == server.BAD_TOKEN
    assert site.backend.requests == [] and site.backend.counts == []


@with_token
@in_loop
async def test_the_first_message_must_be_hello_within_the_timeout(site, monkeypatch):
    monkeypatch.setattr(server, "HELLO_TIMEOUT_S", 1.0)
    async with site.page() as page:
        await page.write_message('{"do": "stop"}')
        assert await read(page) is None and page.close_code == server.BAD_TOKEN
    async with site.page({"token": "the-right-token"}) as page, site.page() as silent:
        assert (await read(page))["cell"] == "test"
        # The silent page connected later, so the timeout of both has passed when it is closed.
        assert await read(silent) is None and silent.close_code == server.BAD_TOKEN
        await page.write_message('{"do": "stop"}')
        assert (await read(page))["ok"]
    assert site.backend.requests == [Command("stop")]


# ---- messages


@in_loop
async def test_invalid_messages_are_answered_with_an_error_and_affect_no_other_page(site):
    noise = random.Random(1)
    nonsense: list[str | bytes] = ["", "{", "[]", "null", '{"do": 7}', '{"do": "goal", "x": NaN}']
    nonsense += ["[" * 3000, '{"do": {"do": {}}}', bytes(noise.randbytes(64)), "\x00\ud7ff"]
    nonsense += ["".join(chr(noise.randrange(32, 900)) for _ in range(50)) for _ in range(20)]
    async with site.page({}) as page:
        assert (await read(page))["type"] == "welcome"
        for message in nonsense:
            await page.write_message(message, binary=isinstance(message, bytes))
            answer = await read(page)
            assert answer["ok"] is False and len(answer["text"]) > 15
        await page.write_message('{"do": "stop"}')
        assert (await read(page))["ok"]
    assert site.backend.requests == [Command("stop")]


@pytest.mark.usefixtures("one_second")
@in_loop
async def test_too_long_or_too_many_messages_end_the_connection(site: Site) -> None:
    async with site.page({}) as page:
        await read(page)
        await page.write_message(json.dumps({"do": "stop", "x": "a" * 5000}))
        assert await read(page) is None and page.close_code == 1009
    async with site.page({}) as page:
        await read(page)
        with contextlib.suppress(Exception):
            for _ in range(400):
                await page.write_message('{"do": "cancel"}')
        while await read(page) is not None:
            pass
        assert page.close_code == server.TOO_MANY_MESSAGES
    assert Command("stop") not in site.backend.requests


# ---- several pages


@in_loop
async def test_every_page_sees_the_same_state_and_the_number_of_pages_is_limited(site, monkeypatch):
    monkeypatch.setattr(server, "MAX_PAGES", 2)
    async with site.page({}) as first, site.page({}) as second:
        await read(first)
        await read(second)
        site.server.show({"mode": "ready"})
        assert await read(first) == await read(second) == {"type": "state", "mode": "ready"}
        async with site.page({}) as third:
            assert await read(third) is None
            assert third.close_code == server.TOO_MANY_PAGES
    await until(lambda: site.backend.counts[-1] == 0)
    assert max(site.backend.counts) == 2


@in_loop
async def test_a_page_gets_the_latest_image_after_it_has_drawn_the_previous_one(site):
    async with site.page({}) as slow, site.page({}) as quick:
        await read(slow)
        await read(quick)
        for number in range(1, 6):
            site.server.show_picture(b"jpeg %d" % number, 10.0 + number, 0.05)
            frame = await read(quick)
            head = server.PICTURE_HEADER.unpack(frame[:20])
            assert head == (number, 10.0 + number, 0.05) and frame[20:] == b"jpeg %d" % number
            await quick.write_message(json.dumps({"do": "seen", "number": number}))
            await until(lambda: site.server.wants_picture)
        assert (await read(slow))[20:] == b"jpeg 1"
        await slow.write_message('{"do": "seen", "number": 1}')
        await until(lambda: all(page.wants_picture for page in site.server.pages))
        site.server.show_picture(b"jpeg 6", 16.0, 0.05)
        assert (await read(slow))[20:] == b"jpeg 6"


@in_loop
async def test_a_page_that_does_not_read_is_disconnected_and_the_others_continue(site, monkeypatch):
    monkeypatch.setattr(server, "WRITE_TIMEOUT_S", 0.3)

    def deaf() -> socket.socket:
        """Open a page that connects, requests nothing and reads nothing."""
        line = socket.socket()
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.connect(("127.0.0.1", site.port))
        line.sendall(
            f"GET /live HTTP/1.1\r\nHost: {site.host}\r\nOrigin: http://{site.host}\r\n"
            "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
        )
        hello = b'{"do":"hello"}'
        line.sendall(bytes([0x81, 0x80 | len(hello), 0, 0, 0, 0]) + hello)
        return line

    line = deaf()
    async with site.page({}) as page:
        await read(page)
        await until(lambda: len(site.server.pages) == 2)
        state = {"text": "x" * 1_000_000}
        while len(site.server.pages) == 2:
            site.server.show(state)
            assert len((await read(page))["text"]) == 1_000_000
            await asyncio.sleep(0.05)
    line.close()


# ---- recorded runs


def make_run(folder: Path, name: str, **content: object) -> Path:
    run = folder / name
    (run / "logs").mkdir(parents=True)
    summary = {
        "outcome": "reached",
        "goal": {"x_mm": 10.0, "y_mm": -5.0, "theta_deg": 30.0},
        "taps": 3,
        "measured_residual": {"distance_mm": 0.4, "rotation_deg": 0.2},
        "began": 1000.0,
        "error_msg": "",
        **content,
    }
    (run / "summary.json").write_text(json.dumps(summary))
    (run / "logs" / "node.log").write_text("said")
    (run / "report.html").write_text("<script>alert(1)</script>")
    return run


@in_loop
async def test_a_run_is_downloaded_and_its_report_read_with_the_key_of_an_open_page(site, tmp_path):
    run = make_run(site.backend.runs.folder, "2026-run")
    (run / "secret").symlink_to("/etc/hostname")
    loop_get = site.get

    async def get(path: str) -> tuple[int, dict[str, str], bytes]:
        return await asyncio.to_thread(loop_get, path)

    assert (await get(f"runs/{'a' * 22}/2026-run/run.zip"))[0] == 403
    async with site.page({}) as page:
        key = (await read(page))["key"]
        status, headers, body = await get(f"runs/{key}/2026-run/run.zip")
        assert status == 200
        assert headers["Content-Disposition"] == 'attachment; filename="2026-run.zip"'
        packed = tmp_path / "got.zip"
        packed.write_bytes(body)
        with zipfile.ZipFile(packed) as got:
            names = [
                f"2026-run/{each}" for each in ("logs/node.log", "report.html", "summary.json")
            ]
            assert sorted(got.namelist()) == names
        status, headers, body = await get(f"runs/{key}/2026-run/report.html")
        assert status == 200 and body == b"<script>alert(1)</script>"
        policy = headers["Content-Security-Policy"]
        assert policy.endswith("sandbox allow-scripts") and "script-src 'sha256-" in policy
        assert "allow-same-origin" not in policy
        make_run(site.backend.runs.folder, 'a "run", \u00fc')
        odd = urllib.parse.quote('a "run", \u00fc')
        status, headers, _ = await get(f"runs/{key}/{odd}/run.zip")
        assert status == 200
        assert headers["Content-Disposition"] == 'attachment; filename="a__run____.zip"'
        for name in ("..", ".", "other", "2026-run%2f..", "%2e%2e", "a" * 200):
            assert (await get(f"runs/{key}/{name}/run.zip"))[0] in (400, 403, 404)
    await until(lambda: not site.server.pages)
    assert (await get(f"runs/{key}/2026-run/run.zip"))[0] == 403


@in_loop
async def test_chosen_runs_are_compared_with_the_key_of_an_open_page(site: Site, tmp_path) -> None:
    folder = site.backend.runs.folder
    for name in ("one run", "other"):
        (folder / name).mkdir(parents=True)
        write_illustrated_run(folder / name, IllustratedRun(made_run([tap_row()], name=name), ()))
    linked = make_run(folder, "linked")
    (linked / "taps.csv").symlink_to(folder / "other" / "taps.csv")

    async def get(key: str, *names: str) -> tuple[int, dict[str, str], bytes]:
        query = urllib.parse.urlencode([("run", name) for name in names])
        return await asyncio.to_thread(site.get, f"runs/{key}/compare.html?{query}")

    assert (await get("a" * 22, "one run", "other"))[0] == 403
    async with site.page({}) as page:
        key = (await read(page))["key"]
        status, headers, body = await get(key, "one run", "other")
        assert status == 200 and b"2 runs, 2 reached" in body
        assert b'href="one%20run/report.html"' in body and b'href="other/report.html"' in body
        script = re.search(rb"<script>(.*?)</script>", body, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(script[1]).digest()).decode()
        assert f"'sha256-{digest}'" in headers["Content-Security-Policy"]
        for wrong in ([], ["other"], ["other", "other"], ["other", ".."], ["other", "linked"]):
            assert (await get(key, *wrong))[0] == 404


@in_loop
async def test_a_key_that_is_not_ascii_is_refused(site: Site) -> None:
    async with site.page({}) as page:
        await read(page)
        reader, writer = await asyncio.open_connection("127.0.0.1", site.port)
        path = "/runs/" + "\u00e9" * 22 + "/2026-run/run.zip"
        writer.write(f"GET {path} HTTP/1.1\r\nHost: {site.host}\r\n\r\n".encode("latin-1"))
        assert b" 404 " in await asyncio.wait_for(reader.readline(), TIMEOUT_S)
        writer.close()


def test_only_the_recorders_own_folders_are_runs(tmp_path: Path) -> None:
    runs = Runs(tmp_path / "runs")
    assert runs.rows() == []
    make_run(tmp_path / "runs", "good")
    elsewhere = make_run(tmp_path, "elsewhere")
    (tmp_path / "runs" / "link").symlink_to(elsewhere)
    (tmp_path / "runs" / "no-run").mkdir()
    borrowed = tmp_path / "runs" / "borrowed"
    borrowed.mkdir()
    (borrowed / "summary.json").symlink_to(elsewhere / "summary.json")
    assert runs.find("good") == tmp_path / "runs" / "good"
    names = (
        "link",
        "no-run",
        "borrowed",
        "..",
        ".",
        "",
        "../elsewhere",
        "/etc",
        "a\x00",
        "x" * 999,
    )
    assert [name for name in names if runs.find(name) or runs.report(name)] == []
    assert runs.archive("link") is None


def test_a_run_that_is_kept_has_the_file_that_the_recorder_respects(tmp_path: Path) -> None:
    runs = Runs(tmp_path / "runs")
    run = make_run(tmp_path / "runs", "good")
    make_run(tmp_path, "elsewhere")
    for keep in (True, True, False, False):
        assert runs.keep("good", keep)
        assert (run / STARRED).exists() is keep and runs.rows()[0]["kept"] is keep
    assert not runs.keep("../elsewhere", True) and not (tmp_path / "elsewhere" / STARRED).exists()


def test_runs_are_listed_newest_first_and_a_corrupt_summary_is_reported(tmp_path: Path) -> None:
    runs = Runs(tmp_path)
    for age, name in enumerate(("c", "b", "a")):
        run = make_run(tmp_path, name)
        os.utime(run / "summary.json", (1000 - age, 1000 - age))
    (tmp_path / "a" / "summary.json").write_text("[" * 100_000)
    os.utime(tmp_path / "a" / "summary.json", (2000, 2000))
    rows = runs.rows()
    assert [(row["name"], row["outcome"]) for row in rows] == [
        ("a", "unreadable"),
        ("c", "reached"),
        ("b", "reached"),
    ]
    assert rows[1]["goal"] == [10.0, -5.0, 30.0] and rows[1]["residual"] == [0.4, 0.2]
    assert rows[1]["taps"] == 3 and rows[1]["report"] is True
    json.dumps(rows, allow_nan=False)


@pytest.mark.parametrize("value", [10**400, float("nan"), "x" * 10_000, None, [], {}, -1, True])
@pytest.mark.parametrize("key", ["outcome", "goal", "taps", "measured_residual", "began"])
def test_the_list_is_valid_json_for_any_summary(tmp_path: Path, key: str, value: object) -> None:
    make_run(tmp_path, "run", **{key: value})
    assert len(json.dumps(Runs(tmp_path).rows(), allow_nan=False)) < 2000


@pytest.mark.parametrize("summary", [[], 7, "text", {"objects": []}, {"objects": [[]]}])
def test_a_summary_of_another_structure_is_listed_as_unreadable(
    tmp_path: Path, summary: object
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "summary.json").write_text(json.dumps(summary))
    (row,) = Runs(tmp_path).rows()
    assert (row["name"], row["outcome"]) == ("run", "unreadable")


@pytest.mark.parametrize("year", [1970, 2200])
def test_a_run_with_files_of_any_date_is_packed(tmp_path: Path, year: int) -> None:
    run = make_run(tmp_path, "run")
    date = (year - 1970) * 365.25 * 86400
    os.utime(run / "summary.json", (date, date))
    archive = Runs(tmp_path).archive("run")
    assert archive is not None
    try:
        with zipfile.ZipFile(archive) as packed:
            assert len(packed.namelist()) == 3
    finally:
        archive.unlink()


# ---- the separate port of STOP


def test_the_page_knows_where_stop_is_served(site: Site) -> None:
    assert site.get("stop-port")[2] == str(STOP_PORT).encode()
    policy = site.get("")[1]["Content-Security-Policy"]
    assert f"connect-src 'self' http://127.0.0.1:{STOP_PORT};" in policy


@pytest.mark.usefixtures("one_second")
@in_loop
async def test_a_page_that_sends_too_many_requests_is_refused_except_for_stop(site: Site) -> None:
    async with site.page({}) as page:
        await read(page)
        for _ in range(3 * server.MAX_COMMANDS):
            await page.write_message('{"do": "home"}')
        answers = [await read(page) for _ in range(3 * server.MAX_COMMANDS)]
        refused = [answer for answer in answers if not answer["ok"]]
        assert len(refused) == 2 * server.MAX_COMMANDS
        assert all("commands per second" in each["text"] for each in refused)
        await page.write_message('{"do": "stop"}')
        assert (await read(page))["ok"]
    assert len(site.backend.requests) == server.MAX_COMMANDS + 1


@in_loop
async def test_the_enabling_key_and_cancel_do_not_count_as_commands(site, monkeypatch):
    monkeypatch.setattr(server, "MAX_COMMANDS", 0)
    sent = ["enable"] * 12 + ["disable", "cancel", "stop"] * 4
    async with site.page({}) as page:
        await read(page)
        for name in (*sent, "home"):
            await page.write_message(json.dumps({"do": name}))
        answers = [await read(page) for _ in (*sent, "home")]
        (refused,) = (answer for answer in answers if not answer["ok"])
        assert "commands per second" in refused["text"]
    assert site.backend.requests == [Command(name) for name in sent]


def test_a_port_in_use_is_an_immediate_error(site: Site) -> None:
    with pytest.raises(OSError, match="in use"):
        server.bind("127.0.0.1", site.port)
