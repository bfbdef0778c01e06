"""Make a deployed cell run this version, which is in a folder of its own, or take that back.

First, this version checks the cell's files as by check-config, whether it supports the firmware of
the tapper's board, and reaches a goal in simulation while the cell goes on. Then a link is switched
and the service restarted. If it does not start, the link is switched back. Run it as root in a
shell that is set up in the folder of the new version.

    python -m tapping_cell update
    python -m tapping_cell update --cell my_cell.yaml
    python -m tapping_cell update --back
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tapping_cell.cli import argument_types
from tapping_cell.cli.check_config import check
from tapping_cell.cli.deploy import (
    PlannedFile,
    add_name,
    agreed,
    available,
    carry_out,
    print_plan,
    unsuitable,
    version_files,
)
from tapping_cell.cli.deployment.archive import (
    BEFORE_UPDATE,
    ArchiveError,
    environment_of,
    read_archive,
    write_archive,
)
from tapping_cell.cli.deployment.cell_copy import copied_cell
from tapping_cell.cli.deployment.places import VERSION, Places
from tapping_cell.cli.deployment.service_state import service_state
from tapping_cell.cli.errors import ExitStatus, print_error
from tapping_cell.configuration.cell import Cell, load_cell, refuse_own_drivers
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.hardware.tapper import PROTOCOL_VERSION

START_S = 60.0
"""Longest wait for the service to accept goals, in s. A cell that waits for a person is not ready
then either."""
STATUS_S = 30.0
GOAL_S = 600.0
PERIOD_S = 0.1


class Unsuitable(RuntimeError):
    """The version cannot be changed. The message states the reason."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    add_name(parser)
    parser.add_argument(
        "--back",
        action="store_true",
        help="return to the version that ran before, and to the cell files that the last update "
        "replaced",
    )
    parser.add_argument(
        "--cell",
        type=argument_types.configuration_file,
        help="cell file that replaces the deployed one, if this version needs other keys (default: "
        "the deployed one)",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="make the checks and print the plan only"
    )
    parser.add_argument("--yes", action="store_true", help="carry out the plan without asking")


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if the service runs the other version, 1 if a step failed or was
    declined, 2 if that version is unsuitable."""
    places = Places(arguments.name, arguments.root)
    live = places.root == Path("/")
    try:
        if refused := unsuitable(live):
            raise Unsuitable(refused)
        files = earlier_version(places) if arguments.back else this_version(places, arguments.cell)
    except (Unsuitable, ArchiveError, ConfigurationError, OSError) as error:
        print_error(str(error))
        return ExitStatus.REFUSED
    acts = {file: file.act(places, True) for file in files}
    commands = available([["systemctl", "restart", places.unit]]) if live else []
    print_plan(acts, places, [], commands, [], texts=False)
    if arguments.dry_run:
        return ExitStatus.DONE
    if not arguments.yes and not agreed():
        return ExitStatus.FAILED
    try:
        if live and not arguments.back:
            require_idle(status_of(places))
        write_archive(places.configuration / BEFORE_UPDATE, places)
        started = time.monotonic()
        status = carry_out(acts, [], places, commands)
        if commands and (status or not came_up(places, started)):
            print_error(f"{places.unit} does not run; see journalctl -u {places.name}")
            status = ExitStatus.FAILED
            if not arguments.back:
                print("returning to the version before")
                back = {file: file.act(places, True) for file in earlier_version(places)}
                carry_out(back, [], places, commands)
    except (Unsuitable, ArchiveError, OSError) as error:
        print_error(str(error))
        return ExitStatus.FAILED
    return status


def this_version(places: Places, new_cell: Path | None) -> list[PlannedFile]:
    """Check whether this version can run the deployed cell. Return what is to be written.

    Raises:
        Unsuitable: a check failed.
        ConfigurationError: the cell file cannot be used.
        OSError: a file cannot be read.
    """
    files = version_files(places)
    if places.manifest() is None:
        raise Unsuitable(f"no cell '{places.name}' is deployed here: deploy it first")
    if not places.version:
        raise Unsuitable(
            f"{places.configuration / VERSION} is missing: deploy the cell again from the folder "
            "of the version that it runs"
        )
    if places.version == files[-1].text:
        raise Unsuitable(
            f"the cell runs the version in {Path(__file__).resolve().parents[2]} already: put the "
            "new version into another folder, and call update there"
        )
    path = new_cell or places.cell_file
    errors = [line for found in check(path) for line in found.errors]
    if errors:
        raise Unsuitable(
            "this version cannot use the cell's files:\n"
            + "\n".join(errors)
            + f"\ncorrect a copy of {places.configuration}, and give its cell file by --cell"
        )
    cell = load_cell(path)
    if places.root == Path("/"):
        state = status_of(places)
        require_idle(state)
        require_firmware(state)
    simulate(cell)
    if new_cell is not None:
        texts = copied_cell(cell, {})
        folder = Path("/etc") / places.name
        files = [PlannedFile(folder / name, texts[name], cell=True) for name in texts] + files
    return files


def earlier_version(places: Places) -> list[PlannedFile]:
    """Return what is to be written to return to the version that ran before.

    Raises:
        Unsuitable: there is no such version, or its folder is missing.
        ArchiveError: the archive of the replaced cell files cannot be read.
    """
    manifest = places.manifest() or {}
    previous = manifest.get("previous", "")
    if previous in ("", places.version):
        raise Unsuitable(f"no version ran before, as far as {places.configuration} shows")
    path = environment_of(places, previous).get("PATH", "").partition(":")[0]
    if not (Path(path) / "python3").exists():
        raise Unsuitable(f"{path} is missing: the version that ran before was removed")
    files = [PlannedFile(Path("/etc") / places.name / VERSION, previous, link=True)]
    if replaced := manifest.get("replaced"):
        _, texts = read_archive(places.configuration / BEFORE_UPDATE)
        folder = Path("/etc") / places.name
        for path, deployed in replaced.items():
            text = texts[f"configuration/{Path(path).relative_to(folder)}"]
            files.insert(0, PlannedFile(Path(path), text, cell=True, deployed=deployed))
    return files


def status_of(places: Places) -> dict[str, Any] | None:
    """Return what the verb ``status`` tells of the deployed cell; None if the service does not run
    or does not answer."""
    if (service_state(places) or {}).get("ActiveState") != "active":
        return None
    environment = environment_of(places, "cell.env")
    options = shlex.split(environment.pop("CELL_OPTIONS", ""))
    chosen = argparse.ArgumentParser(add_help=False)
    chosen.add_argument("--namespace", default="")
    namespace = chosen.parse_known_args(options)[0].namespace
    # Another user than that of the service cannot use its shared memory.
    command = ["runuser", "-u", places.name, "--", sys.executable, "-m", "tapping_cell", "status"]
    with contextlib.suppress(OSError, ValueError, subprocess.TimeoutExpired):
        result = subprocess.run(
            [*command, "--json", "--namespace", namespace],
            env={**os.environ, **environment},
            cwd="/",
            capture_output=True,
            text=True,
            timeout=STATUS_S,
        )
        state = json.loads(result.stdout)
        return state if isinstance(state, dict) else None
    return None


def require_idle(state: dict[str, Any] | None) -> None:
    """Check that the cell is not at work. Raises Unsuitable."""
    if state is not None and state.get("mode") == "moving":
        raise Unsuitable("a goal is under way: wait for its end, or cancel it")


def require_firmware(state: dict[str, Any] | None) -> None:
    """Check that this version supports the firmware of the tapper's boards. Raises Unsuitable."""
    rows = [] if state is None else state.get("nodes", [])
    firmware = [row.get("firmware", "") for row in rows if row.get("role") == "tapper_trigger"]
    versions = re.findall(r"\b\d+\.\d+[.\d]*", "".join(firmware))
    if not versions:
        print("the tapper is not connected: the firmware of its board is checked at the start")
    for version in versions:
        if version.partition(".")[0] != PROTOCOL_VERSION:
            raise Unsuitable(
                f"the tapper's board has firmware {version}, but this version needs "
                f"{PROTOCOL_VERSION}.x: stop the service, flash it (make -C firmware/tapper flash "
                "PORT=...), then call update again"
            )


def simulate(cell: Cell) -> None:
    """Reach a goal with this cell in simulation, beside the running cell. A cell with drivers of
    its own cannot be simulated; the package's cell takes its place.

    Raises:
        Unsuitable: the goal was not reached.
    """
    options = ["--cell", str(cell.path)]
    try:
        refuse_own_drivers(cell)
    except ConfigurationError:
        options = []
    print("positioning an object in simulation")
    environment = {key: value for key, value in os.environ.items() if key != "ROS_DOMAIN_ID"}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tapping_cell", "demo", "--out", f"{folder}/run", *options]
        try:
            # The running cell comes first.
            result = subprocess.run(
                ["nice", *command],
                env=environment,
                cwd=folder,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=GOAL_S,
            )
        except subprocess.TimeoutExpired as error:
            raise Unsuitable(f"the simulated goal took longer than {GOAL_S:.0f} s") from error
    if result.returncode:
        raise Unsuitable("the goal in simulation was not reached:\n" + result.stdout[-2000:])


def came_up(places: Places, started: float) -> bool:
    """Wait until the service accepts goals or waits for a person. Return whether it still runs."""
    text = ""
    while time.monotonic() - started < START_S:
        state = service_state(places) or {}
        if state.get("ActiveState") != "active" or state.get("NRestarts") != "0":
            return False
        text = state.get("StatusText", "")
        if text.startswith("ready"):
            break
        time.sleep(PERIOD_S)
    print(f"{places.unit} after {time.monotonic() - started:.1f} s: {text}")
    return True
