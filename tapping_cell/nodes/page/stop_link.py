"""Supervision of the process that serves STOP: starts, monitors and restarts it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict

from tapping_cell.nodes.page.guard import Guard

RESTART_PAUSE_S = 0.5
END_TIMEOUT_S = 2.0


class StopLink:
    """Keep one process running that serves STOP on sockets that are already bound.

    If the process ends while it holds a stop, the process that replaces it holds the stop again.
    """

    def __init__(
        self,
        guard: Guard,
        sockets: list[socket.socket],
        page_port: int,
        namespace: str,
        topic: str,
        on_level: Callable[[bool, str], None],
    ) -> None:
        """``topic``: resolved name of the stop topic. ``on_level``: called in a thread of this link
        with True and the name of the requester for each stop, and with False for each release."""
        self.held = False
        self.ready = threading.Event()
        self._sockets = sockets
        self._configuration = {
            "guard": asdict(guard),
            "sockets": [each.fileno() for each in sockets],
            "page_port": page_port,
            "namespace": namespace,
            "topic": topic,
        }
        self._on_level = on_level
        self._closing = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._run, name="stop link", daemon=True)
        self._thread.start()

    def stop(self, who: str) -> bool:
        """Hold the stop, without blocking. Return False if the process does not accept the
        request."""
        return self._send({"do": "stop", "who": who})

    def release(self) -> bool:
        """Release the stop at a person's request. Return False if the process does not accept the
        request."""
        return self._send({"do": "release"})

    def close(self) -> None:
        """End the process."""
        self._closing.set()
        with self._lock:
            process = self._process
            if process is not None and process.stdin is not None:
                process.stdin.close()
        self._thread.join(END_TIMEOUT_S)
        if process is not None and process.poll() is None:
            process.kill()
        self._thread.join(END_TIMEOUT_S)
        for each in self._sockets:
            each.close()

    def _send(self, request: dict[str, object]) -> bool:
        with self._lock:
            process = self._process
            if process is None or process.stdin is None or not self.ready.is_set():
                return False
            try:
                os.write(process.stdin.fileno(), json.dumps(request).encode() + b"\n")
            except (OSError, ValueError):  # the process has died, or has not read for too long
                return False
        return True

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._run_once()
            except OSError as error:
                # The process could not be started, or ended before it read its configuration.
                print(
                    f"the process that serves the page's STOP has failed ({error}) and is started "
                    f"again after {RESTART_PAUSE_S} s; until then use the wired emergency stop",
                    file=sys.stderr,
                )
            self.ready.clear()
            self._closing.wait(RESTART_PAUSE_S)

    def _run_once(self) -> None:
        process = subprocess.Popen(
            [sys.executable, "-m", "tapping_cell.nodes.page.stop_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=[each.fileno() for each in self._sockets],
        )
        assert process.stdin is not None and process.stdout is not None
        configuration = {**self._configuration, "held": self.held}
        with process:
            os.write(process.stdin.fileno(), json.dumps(configuration).encode() + b"\n")
            os.set_blocking(process.stdin.fileno(), False)
            with self._lock:
                if self._closing.is_set():  # close() has not seen this process
                    return
                self._process = process
            try:
                for line in process.stdout:
                    self._receive(json.loads(line))
            finally:
                with self._lock:
                    self._process = None

    def _receive(self, content: dict[str, object]) -> None:
        changed = content["held"] != self.held
        self.held = bool(content["held"])
        self.ready.set()
        if changed or content["who"]:
            self._on_level(self.held, str(content["who"]))
