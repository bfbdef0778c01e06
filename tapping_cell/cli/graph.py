"""Node graph as child processes, which are started together, monitored, and always ended
together."""

from __future__ import annotations

import contextlib
import ctypes
import errno
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
from typing import IO

from tapping_cell.configuration.cell import Cell
from tapping_cell.nodes import MODULES, security
from tapping_cell.nodes.cell_identity import STATE, cell_key, claim, state_folder

SIMULATED = ("sim_world", "camera_pose", "tap_planner", "scara_arm", "tapper_trigger")
HARDWARE = ("overhead_camera", "camera_pose", "tap_planner", "scara_arm", "tapper_trigger")

DRIVERS = ("scara_arm", "tapper_trigger")
"""Nodes that keep the priority with which the graph was started; the others have at most the
usual one."""
RECORDER = "run_recorder"
"""Recorder of every goal. If the recorder ends, the graph continues, because the cell works without
it."""

IMAGES = ("sim_world", "overhead_camera", "camera_pose", RECORDER, "operator_page")
"""Nodes that exchange images through shared memory."""
IMAGES_DELAY_S = 5.0
"""Time in s between the end of one of these nodes and its restart. It exceeds ``leaseDuration`` of
the Fast DDS profiles. Until then, the other nodes send to the port of the killed process in shared
memory, and so delete and create this port for every image. If its successor opened the port
meanwhile, they could delete it again: the successor would never receive an image."""

TIMEOUT_S = 5.0
"""Time for a node to exit before it is killed."""

MAX_RECORDER_STARTS = 3
"""Maximum number of restarts of a recorder that keeps ending. Its log states the cause."""

LAST_DOMAIN = 232
"""Highest ROS domain for which the middleware has valid port numbers."""

MAX_PARTICIPANTS = 20
"""Number of participant ports that are checked in a domain. This number exceeds the number of
participants of a cell (8)."""
OWN_DOMAINS = range(1, 102)
"""Domains whose ports do not overlap the ephemeral ports of Linux. Domain 0 is excluded, because it
is the default domain of all ROS programs."""

_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of Linux' prctl(2)


def nodes_of(cell: Cell, *, hardware: bool) -> tuple[str, ...]:
    """Return the names of a cell's nodes. The arm's driver is left out for a cell without an
    arm."""
    nodes: tuple[str, ...] = HARDWARE if hardware else SIMULATED
    if cell.file.arm is None:
        nodes = tuple(name for name in nodes if name != "scara_arm")
    return nodes


class GraphError(RuntimeError):
    """The graph cannot start or continue. The message states the reason."""


class NodeDied(GraphError):
    """A node ended unexpectedly. The message contains the node's name, exit code and last
    output."""


@dataclass(frozen=True, slots=True)
class Child:
    """Process of one node and its log."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    stream: IO[bytes]
    logged_before: int
    """Length of the log in bytes when this process started."""


@dataclass(frozen=True, slots=True)
class Ended:
    """Process of a node that ended unexpectedly."""

    name: str
    status: int
    output: str
    """Last lines of its log."""

    @property
    def refused(self) -> bool:
        """Whether the node ended because it rejected its parameters or files. A restart would not
        help."""
        return self.status > 0 and self.output.rpartition(" | ")[2].startswith("error: ")

    @property
    def sentence(self) -> str:
        """Description of the end."""
        if self.status == -signal.SIGKILL:
            # A killed node cannot log a reason, so its last lines would be misleading.
            return (
                f"the node {self.name} was killed by the signal SIGKILL, sent by another program,"
                " or by the kernel because memory ran out"
            )
        how = f"with status {self.status}"
        if self.status < 0:
            how = f"by the signal {signal.Signals(-self.status).name}"
        output = self.output.rpartition(" | ")[2] if self.refused else self.output
        return f"the node {self.name} ended {how}: {output}"


class Graph:
    """The nodes of one cell as processes.

    Use as a context manager: at the end of the block, every process has ended. If this process
    itself is killed, the kernel ends the child processes.
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
        """``parameters``: parameters of each node. They override the parameters in
        ``parameter_file``. Every node receives ``parameter_file``."""
        self._nodes = tuple(nodes)
        self._parameters = parameters
        self._log_folder = log_folder
        # The nodes' matrices are small, so additional threads of the linear algebra library would
        # only slow the nodes down.
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
                f"'/{self._namespace.strip('/')}': end that cell, or start this cell with another "
                "ROS_DOMAIN_ID or --namespace"
            )
        self._log_folder.mkdir(parents=True, exist_ok=True)
        try:
            for name in self._nodes:
                self._children.append(self._start(name))
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _start(self, name: str) -> Child:
        command = [sys.executable, "-m", MODULES[name], "--ros-args"]
        if security.is_enabled(self._environment):
            command += ["--enclave", security.enclave_of(name)]
        if self._namespace:
            command += ["-r", f"__ns:=/{self._namespace.strip('/')}"]
            # Two cells use the same frame names, so each cell has its own tf topics.
            command += ["-r", "/tf:=tf", "-r", "/tf_static:=tf_static"]
        if self._parameter_file is not None:
            command += ["--params-file", str(self._parameter_file)]
        for key, value in self._parameters.get(name, {}).items():
            command += ["-p", f"{key}:={parameter_text(value)}"]
        log = self._log_folder / f"{name}.log"
        logged_before = log.stat().st_size if log.exists() else 0
        stream = log.open("ab")
        process = subprocess.Popen(
            command,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            # In a session of its own, a node does not receive a Ctrl-C at the terminal. Only this
            # process receives it, and then ends the nodes.
            start_new_session=True,
            preexec_fn=_die_with_parent if name in DRIVERS else _be_usual,
        )
        return Child(name, process, log, stream, logged_before)

    def ended(self) -> list[Ended]:
        """Return the nodes that ended unexpectedly and were not restarted."""
        return [
            Ended(child.name, status, last_output(child.log, child.logged_before))
            for child in self._children
            if (status := child.process.poll()) is not None
        ]

    def check(self) -> None:
        """Raise an error if a node has ended. A recorder that has ended is restarted a few times.

        Raises:
            NodeDied: with the node's last output.
        """
        for ended in self.ended():
            if ended.name != RECORDER:
                raise NodeDied(ended.sentence)
            if self._recorder_starts < MAX_RECORDER_STARTS:
                self._recorder_starts += 1
                self.restart(RECORDER)

    def restart(self, name: str) -> None:
        """Restart a node that has ended or was killed.

        Raises:
            KeyError: the graph has no such node.
        """
        index = {child.name: index for index, child in enumerate(self._children)}[name]
        old = self._children[index]
        old.process.wait()
        old.stream.close()
        self._children[index] = self._start(name)

    def kill(self, name: str) -> None:
        """Kill the process of a node that does not respond."""
        for child in self._children:
            if child.name == name:
                _signal_group(child, signal.SIGKILL)

    @property
    def process_ids(self) -> dict[str, int]:
        """Process id of each node."""
        return {child.name: child.process.pid for child in self._children}

    def stop(self) -> None:
        """End every node by an interrupt signal and, after TIMEOUT_S, by a kill signal."""
        for child in self._children:
            _signal_group(child, signal.SIGINT)
        deadline = time.monotonic() + TIMEOUT_S
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


def last_output(log: Path, begin: int = 0, lines: int = 3) -> str:
    """Return the last lines of a node's log, starting at byte ``begin``, joined to one line."""
    data = log.read_bytes()
    # A shorter log was emptied by logrotate since.
    text = data[begin if begin <= len(data) else 0 :].decode("utf-8", errors="replace")
    kept = [line.strip() for line in text.splitlines() if line.strip()]
    return " | ".join(kept[-lines:]) or "it printed nothing"


def _signal_group(child: Child, number: signal.Signals) -> None:
    if child.process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.process.pid, number)


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)


def _be_usual() -> None:
    _die_with_parent()
    os.setpriority(os.PRIO_PROCESS, 0, max(0, os.getpriority(os.PRIO_PROCESS, 0)))


def parameter_text(value: object) -> str:
    """Format a parameter value for ROS's command line. ROS parses the value as YAML. Strings are
    quoted, so that a folder named ``101`` or ``no`` remains a string."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (str, Path)):
        return json.dumps(str(value), ensure_ascii=False)
    return str(value)


def with_own_ports(
    parameters: dict[str, dict[str, object]], ports: Path = STATE / "{cell}"
) -> dict[str, dict[str, object]]:
    """Return the parameters of a simulated graph with serial ports in its own folder. The simulated
    arm homes automatically, because it cannot hurt anyone."""
    own = {name: dict(values) for name, values in parameters.items()}
    own["sim_world"] |= {"arm_port": ports / "arm", "tapper_port": ports / "tapper"}
    if "scara_arm" in own:
        own["scara_arm"] |= {"port": ports / "arm", "home_on_activate": True}
    if "tapper_trigger" in own:
        own["tapper_trigger"]["port"] = ports / "tapper"
    return own


def domain_number(environment: Mapping[str, str] = os.environ) -> int:
    """Return the ROS domain that an environment selects; 0 if it does not select a domain.

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
    """ROS domain reserved for one run, so that concurrent runs are isolated."""

    number: int
    held: socket.socket | None

    def use(self) -> None:
        """Select the domain in this process and its children.

        A reserved domain is known to be free only on this machine, so discovery is limited to this
        machine regardless of the shell's setting.
        """
        os.environ["ROS_DOMAIN_ID"] = str(self.number)
        if self.held is None:
            os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        else:
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


def has_participants(domain: int) -> bool:
    """Return whether DDS participants on this machine use a ROS domain, for example nodes that were
    started by ``ros2 run`` and hold no reservation.

    DDSI-RTPS 2.2, section 9.6.1.1: participant k of domain d receives discovery messages on the UDP
    port 7400 + 250 d + 10 + 2 k.
    """
    for participant in range(MAX_PARTICIPANTS):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tried:
            try:
                tried.bind(("", 7400 + 250 * domain + 10 + 2 * participant))
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    return True
    return False


def own_domain() -> Domain:
    """Return the domain of ROS_DOMAIN_ID if this variable is set. Otherwise return a domain that no
    other run and no node of any user on this machine uses, and in which no cell of this user has
    stored anything. It is reserved until this process ends.

    Raises:
        GraphError: every domain is in use, or ROS_DOMAIN_ID is not a domain.
    """
    if os.environ.get("ROS_DOMAIN_ID", ""):
        return Domain(domain_number(), None)
    for number in random.sample(OWN_DOMAINS, len(OWN_DOMAINS)):
        # A stop that was stored there would stop this run too.
        if has_participants(number) or any(state_folder(cell_key(number, "")).glob("*")):
            continue
        held = claim(f"domain/{number}")
        if held is not None:
            return Domain(number, held)
    raise GraphError(
        f"all {len(OWN_DOMAINS)} ROS domains are in use by other runs on this machine, or a cell "
        f"has stored files in {STATE}; end a run, or choose the domain with ROS_DOMAIN_ID"
    )
