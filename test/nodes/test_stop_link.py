"""The supervision of the process that serves the page's STOP, with real processes."""

from __future__ import annotations

import contextlib
import http.client
import json
import resource
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest

from tapping_cell.nodes.page import server, stop_link
from tapping_cell.nodes.page.guard import Guard
from tapping_cell.nodes.page.stop_link import StopLink

TIMEOUT_S = 60.0
PAGE_PORT = 8010


def wait(condition: Callable[[], object], what: str) -> None:
    end = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < end, f"waited {TIMEOUT_S:.0f} s in vain: {what}"
        time.sleep(0.01)


@contextmanager
def link(
    sockets: list[socket.socket] | None = None,
) -> Iterator[tuple[StopLink, list[tuple[bool, str]]]]:
    """Serve STOP; yield the link and the reported levels."""
    levels: list[tuple[bool, str]] = []
    made = StopLink(
        Guard.make("127.0.0.1", (), ""),
        server.bind("127.0.0.1", 0) if sockets is None else sockets,
        PAGE_PORT,
        "/",
        "/emergency_stop",
        lambda *level: levels.append(level),
    )
    try:
        yield made, levels
    finally:
        made.close()
    assert not made._thread.is_alive()


def stops(made: StopLink, levels: list[tuple[bool, str]]) -> None:
    """Check that the link holds and releases a stop."""
    wait(made.ready.is_set, "STOP is served")
    assert made.stop("somebody")
    wait(lambda: levels == [(True, "somebody")], "the stop is reported")
    assert made.release()
    wait(lambda: levels[1:] == [(False, "")], "the release is reported")


def test_a_process_that_could_not_be_started_is_started_again(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    real = subprocess.Popen
    failures: list[OSError] = [OSError(12, "Cannot allocate memory")]

    def start(*arguments: Any, **options: Any) -> Any:
        if failures:
            raise failures.pop()
        return real(*arguments, **options)

    monkeypatch.setattr(stop_link.subprocess, "Popen", start)
    with link() as (made, levels):
        stops(made, levels)
    output = capfd.readouterr().err
    assert "Cannot allocate memory" in output and "wired emergency stop" in output


def test_a_process_that_ends_before_it_is_configured_is_started_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real = subprocess.Popen
    dead: list[Any] = []

    def start(*arguments: Any, **options: Any) -> Any:
        process = real(["true"] if not dead else arguments[0], **options)
        if not dead:
            process.wait()
            dead.append(process)
        return process

    monkeypatch.setattr(stop_link.subprocess, "Popen", start)
    with link() as (made, levels):
        stops(made, levels)
    assert dead


def test_log_messages_of_ros_on_standard_output_are_not_read_as_reports(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RCUTILS_LOGGING_USE_STDOUT", "1")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")  # deprecated, so that ROS logs a warning
    with link() as (made, levels):
        stops(made, levels)
    assert "ROS_LOCALHOST_ONLY is deprecated" in capfd.readouterr().err


@pytest.mark.parametrize("files", [64, 256])
def test_stop_is_answered_within_a_low_limit_of_open_files(
    files: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def start(*arguments: Any, **options: Any) -> Any:
        limit = partial(resource.setrlimit, resource.RLIMIT_NOFILE, (files, files))
        return real(*arguments, preexec_fn=limit, **options)

    real = subprocess.Popen
    monkeypatch.setattr(stop_link.subprocess, "Popen", start)
    sockets = server.bind("127.0.0.1", 0)
    port = sockets[0].getsockname()[1]
    body = json.dumps({"do": "stop"})
    with link(sockets) as (made, levels), contextlib.ExitStack() as stack:
        wait(made.ready.is_set, "STOP is served")
        for _ in range(300):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        page = http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S)
        page.request("POST", "/", body, {"Origin": f"http://127.0.0.1:{PAGE_PORT}"})
        assert page.getresponse().status == 200
        wait(lambda: levels, "the stop is reported")
    assert f"the limit of {files} open files" in capfd.readouterr().err
