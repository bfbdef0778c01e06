"""Start the node graph from a configuration, simulated or on hardware, and keep it running.

Shows the condition that each node waits for, and "ready" once the cell would accept a goal. A node
that ends unexpectedly, or does not respond for 20 s, is restarted, up to three times in two
minutes. If the node of the arm, tapper, planner, camera or simulated world ends more often, all
nodes are ended. Ctrl-C ends every node. Goals are sent from another terminal, or from the
operator's page.

    python -m tapping_cell up
    python -m tapping_cell up --page
    python -m tapping_cell up --params my_parameters.yaml
    python -m tapping_cell up --hardware --cell my_cell.yaml --camera /dev/video0
"""

from __future__ import annotations

import argparse
import math
import re
import time
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.markup import escape

from tapping_cell.cli import argument_types, start_up
from tapping_cell.cli.check_config import check_parameters
from tapping_cell.cli.errors import ExitStatus, print_error, print_refusal
from tapping_cell.cli.graph import (
    RECORDER,
    Graph,
    GraphError,
    domain_number,
    nodes_of,
    with_own_ports,
)
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.cli.start_checks import (
    check_simulation_files,
    refuse_unused,
    require_address,
    require_folder,
)
from tapping_cell.cli.supervision import Supervisor
from tapping_cell.configuration.cell import (
    Cell,
    has_simulated_ports,
    load_cell,
    refuse_own_drivers,
    refuse_simulated_ports,
)
from tapping_cell.configuration.conflicts import port_errors
from tapping_cell.configuration.schema import ConfigurationError, read_yaml
from tapping_cell.nodes.cell_identity import cell_key
from tapping_cell.nodes.clients.cell_client import CellClient
from tapping_cell.nodes.service_manager import ALIVE, SOCKET_VARIABLE, Notifications, notify
from tapping_cell.planning import UnknownPlannerError, require_planner

STOP_PORT_OFFSET = 1000
"""Difference between the port of STOP and the port of the page."""
CHECK_PERIOD_S = 0.2
REPORT_PERIOD_S = 1.0
"""Period of the reports to systemd's watchdog."""
CAMERA = "/dev/video0"
"""Default camera of a cell on hardware."""
READY_TIMEOUT_S = 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "--hardware",
        action="store_true",
        help="use the real camera, arm and tapper (default: simulated)",
    )
    argument_types.add_cell(parser)
    argument_types.add_object(parser)
    parser.add_argument("--planner", help="planning method (default: the cell's)")
    argument_types.add_namespace(parser, "namespace of the nodes (default: none)")
    parser.add_argument(
        "--camera",
        help="camera device, video file or image folder (only with --hardware; default: "
        "/dev/video0)",
    )
    argument_types.add_truth(parser)
    argument_types.add_seed(
        parser, None, "random seed of noise and scatter (only in simulation; default: 1)"
    )
    parser.add_argument(
        "--set-up",
        action="store_true",
        help="use set-up mode: the cell moves slowly, with little energy, and only while an "
        "enabling device is held",
    )
    parser.add_argument(
        "--wait",
        type=argument_types.within(1, 3600),
        default=READY_TIMEOUT_S,
        help="longest time for the nodes to get ready, in seconds (default: 60)",
    )
    parser.add_argument(
        "--params",
        type=Path,
        help="file with ROS parameters for every node; options of this command override it",
    )
    parser.add_argument(
        "--runs", type=Path, help="folder in which runs are recorded (default: runs)"
    )
    parser.add_argument(
        "--keep-free",
        type=argument_types.within(0, 90),
        metavar="PERCENT",
        help="delete the oldest runs while less of the disk is free; starred runs are kept"
        " (default: delete nothing)",
    )
    parser.add_argument("--no-record", action="store_true", help="do not record runs")
    argument_types.add_page(parser)
    parser.add_argument(
        "--logs",
        type=Path,
        help="folder for the nodes' log files (default: a folder for each cell in runs/up)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 after Ctrl-C, 1 if the cell was not ready in time or a node is lost, 2
    for wrong input."""
    console = Console(soft_wrap=True, highlight=False)
    end_on_signals()
    try:
        cell = load_cell(arguments.cell, object_path=arguments.object)
        require_planner(arguments.planner or cell.file.goal.planner)
        if arguments.params is not None:
            wrong = check_parameters(read_yaml(arguments.params), arguments.params)
            if wrong:
                raise ConfigurationError(wrong[0])
        check_simulation_files(arguments)
        if arguments.hardware:
            refuse_unused(arguments, "only in simulation", "truth", "truth_object", "seed")
            refuse_simulated_ports(cell)
            require_devices(cell, arguments)
        else:
            refuse_unused(arguments, "only with --hardware", "camera")
            refuse_own_drivers(cell)
        if arguments.no_record:
            refuse_unused(arguments, "only without --no-record", "runs", "keep_free")
        require_folder(arguments.runs, "--runs")
        require_folder(arguments.logs, "--logs")
        if arguments.page:
            require_address(arguments.page, "--page")
        key = cell_key(domain_number(), arguments.namespace)
    except (ConfigurationError, UnknownPlannerError, GraphError) as error:
        return print_refusal(error)
    nodes = nodes_of(cell, hardware=arguments.hardware)
    if not arguments.no_record:
        nodes = (*nodes, RECORDER)
    if arguments.page:
        nodes = (*nodes, "operator_page")
    logs = arguments.logs or Path("runs/up") / key
    parameters = node_parameters(arguments, cell)
    if not arguments.hardware:
        # The simulated arm homes automatically, because it cannot hurt anyone.
        parameters.get("scara_arm", {})["home_on_activate"] = True
    if not arguments.hardware and not has_simulated_ports(cell):
        # The cell file of real hardware names real ports. The simulated devices must not use them.
        parameters = with_own_ports(parameters)
    notifications = Notifications()
    graph = Graph(
        nodes,
        parameters,
        logs.resolve(),
        {SOCKET_VARIABLE: notifications.address},
        namespace=arguments.namespace,
        parameter_file=arguments.params.resolve() if arguments.params else None,
    )
    try:
        with graph:
            console.print(f"logs in {logs}; Ctrl-C ends every node", markup=False)
            supervisor = Supervisor(graph, notifications)
            notify("READY=1\nSTATUS=starting")
            _Running(graph, supervisor, nodes, arguments, logs, console).stay()
    except GraphError as error:
        print_error(str(error))
        return ExitStatus.FAILED
    except KeyboardInterrupt:
        console.print("every node has ended")
    return ExitStatus.DONE


class _Running:
    """Started graph, which is monitored until Ctrl-C."""

    def __init__(
        self,
        graph: Graph,
        supervisor: Supervisor,
        nodes: tuple[str, ...],
        arguments: argparse.Namespace,
        logs: Path,
        console: Console,
    ) -> None:
        self._graph = graph
        self._nodes = nodes
        self._arguments = arguments
        self._page_log = logs / "operator_page.log"
        # Earlier log entries name the page's address in an earlier run and are ignored.
        self._page_seen = self._page_log.stat().st_size if self._page_log.exists() else 0
        self._console = console
        self._supervisor = supervisor
        self._reported = -math.inf

    def stay(self) -> None:
        """Wait until the cell is ready, then restart nodes that end. Never returns.

        Raises:
            GraphError: the cell is not ready in time, a restarted node does not start in time, or a
                required node is lost.
        """
        self._get_ready(again=False)
        while True:
            if self._check():
                self._get_ready(again=True)
            else:
                time.sleep(CHECK_PERIOD_S)

    def _check(self) -> bool:
        """Restart nodes that have ended. Return whether any had ended."""
        now = time.monotonic()
        incidents = self._supervisor.check(now)
        if now - self._reported >= REPORT_PERIOD_S:
            self._reported = now
            notify(ALIVE)
        for incident in incidents:
            self._console.print(f"[red]{incident.node}[/]: {escape(incident.sentence)}")
        return bool(incidents)

    def _get_ready(self, again: bool) -> None:
        """Show each node's state until the cell accepts a goal. ``again``: the cell was ready
        before, so a fault must be cleared on it, and does not end it."""
        deadline = time.monotonic() + self._arguments.wait
        printed: dict[str, str] = {}
        asked = status = ""
        with (
            CellClient(self._arguments.namespace) as client,
            Live(console=self._console, refresh_per_second=5, transient=True) as live,
        ):
            while True:
                self._check()
                start = start_up.judge(self._nodes, client.state(), self._supervisor.left_alone)
                if self._console.is_terminal:
                    live.update(start_up.table(start.lines))
                for line in start.lines:
                    # A line in which only a number changed is not printed again.
                    news = re.sub(r"\d", "", str(line))
                    if printed.get(line.node) != news and not self._console.is_terminal:
                        self._console.print(str(line), markup=False)
                    printed[line.node] = news
                if start.ready:
                    break
                if (waits := start.person or start.reason) != status:
                    status = waits
                    notify(f"STATUS=not ready: {waits}")
                if start.person != asked and start.person:
                    self._console.print(f"[yellow]started, not ready[/]: {escape(start.person)}")
                    self._print_page()
                asked = start.person or asked
                if start.person or (again and start.complete):
                    deadline = time.monotonic() + self._arguments.wait
                elif time.monotonic() > deadline:
                    raise GraphError(
                        f"the cell was not ready after {self._arguments.wait:.0f} s: {start.reason}"
                    )
                time.sleep(CHECK_PERIOD_S)
        # With the time, because a later stop or fault does not change this line.
        clock = time.strftime("%H:%M:%S")
        notify(f"STATUS=ready at {clock}; the verb status shows the present state")
        self._console.print("[green]ready[/]: the cell accepts goals")
        self._print_page()

    def _print_page(self) -> None:
        """Print the address of the operator's page once the page's node has written it to the
        log."""
        if not self._page_log.exists():
            return
        if self._page_log.stat().st_size < self._page_seen:
            self._page_seen = 0  # logrotate has emptied the log
        text = self._page_log.read_bytes()[self._page_seen :].decode("utf-8", errors="replace")
        found = re.findall(r"operator page: (http\S+)", text)
        for url in found:
            self._console.print(f"operator's page: {url}", markup=False)
        if found:
            self._page_seen += len(text.encode())


def require_devices(cell: Cell, arguments: argparse.Namespace) -> None:
    """Check that the camera and both ports exist, before anything is started.

    Raises:
        ConfigurationError: two parts of the cell have the same port, or a device is missing. The
            message names all missing devices.
    """
    given = arguments.params.read_text(encoding="utf-8") if arguments.params else ""
    missing = []
    if "port:" not in given and (wrong := port_errors(cell)):
        raise ConfigurationError(wrong[0])
    arm = () if cell.file.arm is None else (("arm", cell.file.arm.port),)
    for name, port in (*arm, *(("tapper", board.port) for board in cell.boards)):
        # If the parameter file names a port, the node possibly does not use the port in the cell
        # file, so the port in the cell file is not checked.
        if (
            port
            and "port:" not in given
            and "{" not in port
            and not Path(port).expanduser().exists()
        ):
            missing.append(f"the {name}'s port {port} (key {name}.port)")
    camera = arguments.camera or CAMERA
    device = Path(f"/dev/video{camera}" if camera.isdigit() else camera)
    if "source:" not in given and "://" not in camera and not device.exists():
        missing.append(f"the camera {device} (option --camera)")
    if missing:
        raise ConfigurationError(
            f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing: check power"
            f" and cables, or correct the names; the cell file is {cell.path}"
        )


def node_parameters(arguments: argparse.Namespace, cell: Cell) -> dict[str, dict[str, object]]:
    """Return, for each node, the parameters that the command line sets. All others keep their
    defaults."""
    place: dict[str, object] = {"cell_file": cell.path} if arguments.cell else {}
    files = dict(place)
    if arguments.object:
        files["object_file"] = cell.object_path
    seed: dict[str, object] = {} if arguments.seed is None else {"seed": arguments.seed}
    parameters: dict[str, dict[str, object]] = {
        "sim_world": {**files, **seed},
        "overhead_camera": dict(place),
        "camera_pose": files,
        "tap_planner": dict(files),
        **({} if cell.file.arm is None else {"scara_arm": dict(files)}),
        "tapper_trigger": dict(place),
        RECORDER: {**files, **seed},
    }
    if arguments.truth:
        parameters["sim_world"]["truth_file"] = arguments.truth.resolve()
    if arguments.truth_object:
        parameters["sim_world"]["object_file"] = arguments.truth_object.resolve()
    if arguments.planner:
        parameters["tap_planner"]["planner"] = arguments.planner
    if getattr(arguments, "runs", None):
        parameters[RECORDER]["folder"] = arguments.runs.resolve()
    if getattr(arguments, "keep_free", None):
        parameters[RECORDER]["keep_free"] = arguments.keep_free / 100
    if getattr(arguments, "page", None):
        address, port = arguments.page
        stop_port = port + STOP_PORT_OFFSET if 0 < port <= 65535 - STOP_PORT_OFFSET else 0
        parameters["operator_page"] = {
            **files,
            "address": address,
            "port": port,
            "stop_port": stop_port,
            "runs": parameters[RECORDER].get("folder", Path("runs").resolve()),
        }
    if getattr(arguments, "set_up", False):
        for name in parameters:
            if name in ("scara_arm", "tapper_trigger"):
                parameters[name]["set_up"] = True
    if getattr(arguments, "camera", None):
        parameters["overhead_camera"]["source"] = arguments.camera
    return parameters
