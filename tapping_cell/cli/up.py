"""Start the node graph from a configuration, simulated or on hardware, and stay.

Ends every node on Ctrl-C, and when one of them dies. Goals come from another terminal, or from the
operator's page.

    python -m tapping_cell up
    python -m tapping_cell up --page
    python -m tapping_cell up --params my_parameters.yaml
    python -m tapping_cell up --hardware --cell my_cell.yaml --camera /dev/video0
"""

from __future__ import annotations

import argparse
import re
import time
from pathlib import Path

from rich.console import Console

from tapping_cell.cli.graph import (
    HARDWARE,
    RECORDER,
    SIMULATED,
    Graph,
    GraphError,
    domain_number,
    with_own_ports,
)
from tapping_cell.cli.session import end_on_signals
from tapping_cell.configuration.cell import (
    Cell,
    has_simulated_ports,
    load_cell,
    refuse_simulated_ports,
)
from tapping_cell.configuration.schema import ConfigurationError, read_yaml
from tapping_cell.nodes.cell_identity import cell_key
from tapping_cell.planning import UnknownPlannerError, require_planner

STOP_PORT_OFFSET = 1000
"""From the port of the page to that of its STOP."""
LOOK_PERIOD_S = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the verb."""
    parser.add_argument(
        "--hardware", action="store_true", help="real camera, arm and tapper (default: simulated)"
    )
    parser.add_argument("--cell", type=Path, help="cell file (default: the package's cell.yaml)")
    parser.add_argument("--object", type=Path, help="object file (default: the cell's)")
    parser.add_argument("--planner", help="planning method (default: the cell's)")
    parser.add_argument("--namespace", default="", help="namespace of the nodes")
    parser.add_argument(
        "--camera", help="with --hardware: device, video file or folder (default: /dev/video0)"
    )
    add_truth_arguments(parser)
    parser.add_argument("--seed", type=int, help="simulated: of noise and scatter (default: 1)")
    parser.add_argument(
        "--params",
        type=Path,
        help="file of ROS parameters for every node; what is given here as an option wins over it",
    )
    parser.add_argument(
        "--runs", type=Path, help="folder that the recorder puts run folders into (default: runs)"
    )
    parser.add_argument("--no-record", action="store_true", help="keep no run folders")
    parser.add_argument(
        "--page",
        nargs="?",
        type=page_place,
        const=("localhost", 8010),
        metavar="[ADDRESS:]PORT",
        help="serve the operator's page, without a value at localhost:8010; with 0.0.0.0:PORT to "
        "the whole network, where it wants a token",
    )
    parser.add_argument(
        "--logs",
        type=Path,
        help="folder of the nodes' logs (default: one for each cell under runs/up)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb; 0 ended by Ctrl-C, 1 a node died, 2 wrong input."""
    console = Console()
    end_on_signals()
    try:
        cell = load_cell(arguments.cell, object_path=arguments.object)
        require_planner(arguments.planner or cell.file.goal.planner)
        if arguments.params is not None:
            read_yaml(arguments.params)
    except (ConfigurationError, UnknownPlannerError) as error:
        console.print(f"[red]error:[/red] {error}", highlight=False)
        return 2
    nodes: tuple[str, ...] = HARDWARE if arguments.hardware else SIMULATED
    if not arguments.no_record:
        nodes = (*nodes, RECORDER)
    if arguments.page:
        nodes = (*nodes, "operator_page")
    try:
        if arguments.hardware:
            refuse_simulated_ports(cell)
        logs = arguments.logs or Path("runs/up") / cell_key(domain_number(), arguments.namespace)
    except (ConfigurationError, GraphError) as error:
        console.print(f"[red]error:[/red] {error}", highlight=False)
        return 2
    parameters = node_parameters(arguments, cell)
    if not arguments.hardware:
        # Nobody can be hurt in the simulated cell, so that its arm homes by itself.
        parameters["scara_arm"]["home_on_activate"] = True
    if not arguments.hardware and not has_simulated_ports(cell):
        # A file of a real cell names real ports: the simulated devices take none of them.
        parameters = with_own_ports(parameters)
    page_log = logs / "operator_page.log"
    page_log.unlink(missing_ok=True)  # what an earlier run said of its page holds no longer
    try:
        with Graph(
            nodes,
            parameters,
            logs.resolve(),
            namespace=arguments.namespace,
            parameter_file=arguments.params.resolve() if arguments.params else None,
        ) as graph:
            console.print(f"{', '.join(nodes)} are up; logs in {logs}; Ctrl-C ends them")
            told = not arguments.page
            while True:
                graph.check()
                told = told or tell_page(page_log, console)
                time.sleep(LOOK_PERIOD_S)
    except GraphError as error:
        console.print(f"[red]failed:[/red] {error}", highlight=False)
        return 1
    except KeyboardInterrupt:
        console.print("every node has ended")
        return 0


def page_place(text: str) -> tuple[str, int]:
    """Address and port of ``PORT`` or ``ADDRESS:PORT``, an address of IPv6 in brackets.

    Raises:
        argparse.ArgumentTypeError: it is neither.
    """
    found = re.fullmatch(r"(?:(\[[0-9a-fA-F:.]+\]|[^:\[\]]+):)?(\d{1,5})", text)
    if found is None or int(found[2]) > 65535:
        raise argparse.ArgumentTypeError(
            f"'{text}' is neither PORT nor ADDRESS:PORT; give one such as 8010 or 0.0.0.0:8010"
        )
    return (found[1] or "localhost").strip("[]"), int(found[2])


def tell_page(log: Path, console: Console) -> bool:
    """Say where the operator's page is, once its node has said so in its log."""
    text = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    found = re.findall(r"operator page: (http\S+)", text)
    for url in found:
        console.print(f"operator's page: {url}", highlight=False, soft_wrap=True)
    return bool(found)


def add_truth_arguments(parser: argparse.ArgumentParser) -> None:
    """The options that say what is true in the simulated world."""
    parser.add_argument("--truth", type=Path, help="simulated: truth file of the world")
    parser.add_argument(
        "--truth-object",
        type=Path,
        metavar="FILE",
        help="simulated: object file that the true parameters start from, where the planner "
        "believes another, such as a fitted one",
    )


def node_parameters(arguments: argparse.Namespace, cell: Cell) -> dict[str, dict[str, object]]:
    """The parameters of each node that the command line gives; the rest is left to the nodes."""
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
        "scara_arm": dict(place),
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
    if getattr(arguments, "camera", None):
        parameters["overhead_camera"]["source"] = arguments.camera
    return parameters
