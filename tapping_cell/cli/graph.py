"""The node graph as child processes: started together, watched, and always ended together."""

from __future__ import annotations

import ctypes
import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO

from tapping_cell.configuration.cell import Cell
from tapping_cell.nodes import MODULES, security
from tapping_cell.nodes.cell_identity import STATE, cell_key, claim

SIMULATED = ("sim_world", "camera_pose", "tap_planner", "scara_arm", "tapper_trigger")
HARDWARE = ("overhead_camera", "camera_pose", "tap_planner", "scara_arm", "tapper_trigger")

FIRST_TRIGGER = "tapper_trigger"

RECORDER = "run_recorder"
"""Records every goal; the cell works without it, so that its end does not end the graph."""

PATIENCE_S = 5.0
"""Time that a node is given to end by itself before it is killed."""

MOST_RECORDER_STARTS = 3
"""A recorder that ends more often than this is left alone: its log says why."""

LAST_DOMAIN = 232
"""Beyond it the middleware's port numbers end."""

OWN_DOMAINS = range(1, 102)
"""Domains that clear the ephemeral ports of Linux; 0 is everybody's."""

_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of Linux' prctl(2)


def nodes_of(cell: Cell, *, hardware: bool) -> tuple[str, ...]:
    """The nodes of a cell: an arm's driver where there is one, a ``tapper_trigger`` a board."""
    nodes: tuple[str, ...] = HARDWARE if hardware else SIMULATED
    if cell.file.arm is None:
        nodes = tuple(name for name in nodes if name != "scara_arm")
    return (*nodes, *(trigger(board) for board in range(1, len(cell.boards))))


def trigger(board: int) -> str:
    """The name of the node that drives a board."""
    return f"{FIRST_TRIGGER}_{board}" if board else FIRST_TRIGGER


class GraphError(RuntimeError):
    """The graph cannot run, or no longer; the sentence says why."""


class NodeDied(GraphError):
    """A node ended by itself; the sentence says which, with what status and its last words."""


@dataclass(frozen=True, slots=True)
class Child:
    """One node's process and its log."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    stream: IO[bytes]
    said_before: int
    """Length of the log in bytes when this process began."""


@dataclass(frozen=True, slots=True)
class Ended:
    """A node's process that has ended by itself."""

    name: str
    status: int
    words: str
    """The last lines of its log."""

    @property
    def refused(self) -> bool:
        """Whether it refused its parameters or files: it would do so again."""
        return self.status > 0 and self.words.rpartition(" | ")[2].startswith("error: ")

    @property
    def sentence(self) -> str:
        """What happened."""
        how = f"with status {self.status}"
        if self.status < 0:
            how = f"by the signal {signal.Signals(-self.status).name}"
        words = self.words.rpartition(" | ")[2] if self.refused else self.words
        return f"the node {self.name} ended {how}: {words}"


class Graph:
    """The nodes of one cell as processes.

    Use as a context manager: however the block is left, every process has ended afterwards. Where
    this process itself is killed, the kernel ends the children.
    """

    def __init__(
        self,
        nodes: Sequence[str],
        parameters: Mapping[str, Mapping[str, object]],
        log_folder: Path,
        environment: Mapping[str, str] | None = None,
        namespace: str = "",
        parameter_file: Path | None = None,
    ) -> None:
        """``parameters`` of a node win over those of ``parameter_file``, which is for all."""
        self._nodes = tuple(nodes)
        self._parameters = parameters
        self._log_folder = log_folder
        # The nodes' matrices are small: threads of the linear algebra only get in each other's way.
        one_thread = {"OPENBLAS_NUM_THREADS": "1"}
        self._environment = {**one_thread, **os.environ, **(environment or {})}
        self._namespace = namespace
        self._parameter_file = parameter_file
        self._recorder_starts = 0
        self._children: list[Child] = []
        self._claim: socket.socket | None = None

    def __enter__(self) -> Graph:
        domain = domain_number(self._environment)
        self._claim = claim(f"graph/{cell_key(domain, self._namespace)}")
        if self._claim is None:
            raise GraphError(
                f"another cell runs on this machine in ROS domain {domain}, namespace "
                f"'/{self._namespace.strip('/')}': end it, or give this one a ROS_DOMAIN_ID or a "
                "--namespace of its own"
            )
        self._log_folder.mkdir(parents=True, exist_ok=True)
        try:
            for name in self._nodes:
                self._children.append(self._start(name))
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def _start(self, name: str) -> Child:
        of_board = name.removeprefix(f"{FIRST_TRIGGER}_")
        kind = FIRST_TRIGGER if of_board != name else name
        command = [sys.executable, "-m", MODULES[kind], "--ros-args"]
        if kind != name:
            command += ["-r", f"__node:={name}", "-p", f"board:={of_board}"]
        if security.is_enabled(self._environment):
            command += ["--enclave", security.enclave_of(kind)]
        if self._namespace:
            command += ["-r", f"__ns:=/{self._namespace.strip('/')}"]
            # Two cells have the same names of frames: each keeps its own.
            command += ["-r", "/tf:=tf", "-r", "/tf_static:=tf_static"]
        if self._parameter_file is not None:
            command += ["--params-file", str(self._parameter_file)]
        for key, value in self._parameters.get(name, {}).items():
            command += ["-p", f"{key}:={parameter_text(value)}"]
        log = self._log_folder / f"{name}.log"
        said_before = log.stat().st_size if log.exists() else 0
        stream = log.open("ab")
        process = subprocess.Popen(
            command,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            # A Ctrl-C at the terminal reaches only this process, which then ends the nodes.
            start_new_session=True,
            preexec_fn=_die_with_parent,
        )
        return Child(name, process, log, stream, said_before)

    def ended(self) -> list[Ended]:
        """The nodes that have ended by themselves and were not started again."""
        return [
            Ended(child.name, status, last_words(child.log, child.said_before))
            for child in self._children
            if (status := child.process.poll()) is not None
        ]

    def check(self) -> None:
        """Raise where a node has ended; the recorder is started again, a few times.

        Raises:
            NodeDied: with the node's last words.
        """
        for ended in self.ended():
            if ended.name != RECORDER:
                raise NodeDied(ended.sentence)
            if self._recorder_starts < MOST_RECORDER_STARTS:
                self._recorder_starts += 1
                self.restart(RECORDER)

    def restart(self, name: str) -> None:
        """Start a node again that has ended, or was killed.

        Raises:
            KeyError: the graph has no such node.
        """
        index = {child.name: index for index, child in enumerate(self._children)}[name]
        old = self._children[index]
        old.process.wait()
        old.stream.close()
        self._children[index] = self._start(name)

    @property
    def process_ids(self) -> dict[str, int]:
        """Process id of each node."""
        return {child.name: child.process.pid for child in self._children}

    def stop(self) -> None:
        """End every node: a polite signal, then, after PATIENCE_S, a kill."""
        for child in self._children:
            _signal_group(child, signal.SIGINT)
        deadline = time.monotonic() + PATIENCE_S
        for child in self._children:
            try:
                child.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                _signal_group(child, signal.SIGKILL)
                child.process.wait()
            child.stream.close()
        self._children.clear()
        if self._claim is not None:
            self._claim.close()
            self._claim = None


def last_words(log: Path, begin: int = 0, lines: int = 3) -> str:
    """The last lines of a node's log from a byte on, in one line."""
    text = log.read_bytes()[begin:].decode("utf-8", errors="replace")
    kept = [line.strip() for line in text.splitlines() if line.strip()]
    return " | ".join(kept[-lines:]) or "it said nothing"


def _signal_group(child: Child, number: signal.Signals) -> None:
    if child.process.poll() is None:
        try:
            os.killpg(child.process.pid, number)
        except ProcessLookupError:
            return


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)


def parameter_text(value: object) -> str:
    """A parameter's value as ROS's command line reads it, which is as YAML: texts stand in quotes,
    so that a folder named ``101`` or ``no`` stays a text."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (str, Path)):
        return json.dumps(str(value), ensure_ascii=False)
    return str(value)


def with_own_ports(
    parameters: dict[str, dict[str, object]], ports: Path = STATE / "{cell}"
) -> dict[str, dict[str, object]]:
    """Parameters of a simulated graph, with serial ports in a folder of its own. Nobody can be hurt
    in it, so that its arm homes by itself."""
    own = {name: dict(values) for name, values in parameters.items()}
    own["sim_world"] |= {"arm_port": ports / "arm", "tapper_port": ports / "tapper"}
    if "scara_arm" in own:
        own["scara_arm"] |= {"port": ports / "arm", "home_on_activate": True}
    for name in own:
        if name.startswith(FIRST_TRIGGER):
            own[name]["port"] = ports / name.replace(FIRST_TRIGGER, "tapper")
    return own


def domain_number(environment: Mapping[str, str] = os.environ) -> int:
    """The ROS domain that an environment chooses; 0 where it says nothing.

    Raises:
        GraphError: ROS_DOMAIN_ID is not a domain.
    """
    chosen = environment.get("ROS_DOMAIN_ID", "") or "0"
    if not chosen.isascii() or not chosen.isdigit() or int(chosen) > LAST_DOMAIN:
        raise GraphError(
            f"ROS_DOMAIN_ID is '{chosen}', but must be a whole number from 0 to {LAST_DOMAIN}"
        )
    return int(chosen)


@dataclass(frozen=True, slots=True)
class Domain:
    """A ROS domain held for one run, so that two runs side by side do not meet."""

    number: int
    held: socket.socket | None


def own_domain() -> Domain:
    """The domain of ROS_DOMAIN_ID where it is set, else one that no other run on this machine uses,
    whoever started it; held until this process ends.

    Raises:
        GraphError: every domain is in use, or ROS_DOMAIN_ID is not a domain.
    """
    if os.environ.get("ROS_DOMAIN_ID", ""):
        return Domain(domain_number(), None)
    for number in random.sample(OWN_DOMAINS, len(OWN_DOMAINS)):
        held = claim(f"domain/{number}")
        if held is not None:
            return Domain(number, held)
    raise GraphError(
        f"all {len(OWN_DOMAINS)} ROS domains are held by other runs on this machine; "
        "end one of them"
    )
