"""Simulated computers: network namespaces connected by a link with delay and packet loss.

The module needs root rights and the programs ``unshare``, ``nsenter`` and ``ip``; :func:`why_not`
returns what is missing. Every packet passes through this module's relay, a switch between TAP
devices that forwards about a thousand packets per second.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import itertools
import multiprocessing
import os
import random
import select
import shutil
import struct
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
TUN = Path("/dev/net/tun")
_SET_INTERFACE = 0x400454CA
_TAP_WITHOUT_HEADER = 0x0002 | 0x1000
_LONGEST_FRAME = 65535


def why_not() -> str:
    """Return why network namespaces cannot be created here, or an empty string."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    missing = [tool for tool in ("ip", "unshare", "nsenter") if shutil.which(tool) is None]
    if missing:
        return f"{', '.join(missing)} is not installed"
    if not TUN.exists():
        return f"{TUN} does not exist"
    tried = subprocess.run(["unshare", "--net", "--mount", "true"], capture_output=True, text=True)
    return f"unshare: {tried.stderr.strip()}" if tried.returncode else ""


class Computer:
    """A network namespace with an address and separate shared memory."""

    def __init__(self, name: str, address: str) -> None:
        self.name = name
        self.address = address
        # Computers on a real network share no memory, so the mount hides the host's shared memory.
        script = "mount -t tmpfs shm /dev/shm && ip link set lo up && echo up && exec sleep inf"
        self._holder = subprocess.Popen(
            ["unshare", "--net", "--mount", "--uts", "sh", "-c", f"hostname {name} && {script}"],
            stdout=subprocess.PIPE,
        )
        assert self._holder.stdout is not None
        if self._holder.stdout.readline().strip() != b"up":
            raise OSError(f"the computer {name} could not be created")

    @property
    def process_id(self) -> str:
        """Process id of the process that keeps the namespaces open."""
        return str(self._holder.pid)

    def command(self, words: Sequence[str]) -> list[str]:
        """Return the command line that runs ``words`` on this computer."""
        return ["nsenter", "--target", self.process_id, "--net", "--mount", "--uts", *words]

    def start(
        self, words: Sequence[str], environment: Mapping[str, str], **options: Any
    ) -> subprocess.Popen[str]:
        """Start a program on this computer; its nodes discover other nodes over the network."""
        # Entering the namespaces changes the working directory. Therefore, PYTHONPATH contains the
        # folder from which the package `benchmarks` can be imported.
        path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        own = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "PYTHONPATH": path}
        return subprocess.Popen(
            self.command(words), env={**os.environ, **own, **environment}, text=True, **options
        )

    def plug_in(self, interface: str) -> None:
        """Move a network interface to this computer and assign the address."""
        _ip("link", "set", interface, "netns", self.process_id)
        for words in (
            ("link", "set", interface, "name", "eth0"),
            ("addr", "add", f"{self.address}/24", "dev", "eth0"),
            ("link", "set", "eth0", "up"),
            ("route", "add", "224.0.0.0/4", "dev", "eth0"),
        ):
            subprocess.run(self.command(("ip", *words)), check=True)

    def close(self) -> None:
        """Stop the computer and remove its interfaces."""
        self._holder.kill()
        self._holder.communicate()


@contextlib.contextmanager
def computers(names: Sequence[str], delay: float, loss: float) -> Iterator[list[Computer]]:
    """Create computers on one network. ``delay``: delay of each packet, in s; ``loss``: share of
    lost packets."""
    with contextlib.ExitStack() as stack:
        made = []
        for number, name in enumerate(names, start=1):
            computer = Computer(name, f"10.77.0.{number}")
            stack.callback(computer.close)
            made.append(computer)
        ends = [f"tc{os.getpid()}x{number}" for number in range(len(made))]
        stack.enter_context(_relay(made, ends, delay, loss))
        yield made


@contextlib.contextmanager
def _relay(made: list[Computer], ends: list[str], delay: float, loss: float) -> Iterator[None]:
    taps = []
    for computer, end in zip(made, ends, strict=True):
        tap = os.open(TUN, os.O_RDWR | os.O_NONBLOCK)
        taps.append(tap)
        fcntl.ioctl(tap, _SET_INTERFACE, struct.pack("16sH", end.encode(), _TAP_WITHOUT_HEADER))
        computer.plug_in(end)
    process = multiprocessing.get_context("fork").Process(
        target=_forward, args=(taps, delay, loss), daemon=True
    )
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()
        for tap in taps:
            os.close(tap)


def _forward(taps: Sequence[int], delay: float, loss: float) -> None:
    """Forward frames between the devices by hardware address, with the delay and the loss."""
    chance = random.Random(1)
    homes: dict[bytes, int] = {}
    waiting: list[tuple[float, int, int, bytes]] = []
    order = itertools.count()
    while True:
        patience = max(0.0, waiting[0][0] - time.monotonic()) if waiting else 1.0
        for source in select.select(taps, (), (), patience)[0]:
            frame = os.read(source, _LONGEST_FRAME)
            target, sender = frame[:6], frame[6:12]
            homes[sender] = source
            known = homes.get(target)
            for tap in taps if known is None else (known,):
                if tap != source and chance.random() >= loss:
                    due = time.monotonic() + delay
                    heapq.heappush(waiting, (due, next(order), tap, frame))
        while waiting and waiting[0][0] <= time.monotonic():
            *_, tap, frame = heapq.heappop(waiting)
            with contextlib.suppress(OSError):  # the queue is full, or the computer was stopped
                os.write(tap, frame)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)
