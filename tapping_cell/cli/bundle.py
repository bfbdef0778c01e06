"""Write a zip file for a support request: versions, configuration, logs, the last runs without
their images, and the state of the computer.

Tokens, and passwords in addresses, are replaced by REDACTED. Look through the file before you send
it.

    python -m tapping_cell bundle support.zip
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

from tapping_cell.cli.check_config import check
from tapping_cell.cli.deploy import add_name
from tapping_cell.cli.deployment.archive import collected
from tapping_cell.cli.deployment.inside import read_inside
from tapping_cell.cli.deployment.places import Places
from tapping_cell.cli.deployment.service_state import output_of, service_state
from tapping_cell.cli.errors import ExitStatus, print_error
from tapping_cell.nodes import computer
from tapping_cell.nodes.recorder.retention import REFUSALS
from tapping_cell.report.versions import versions

LONGEST = 500_000
"""Maximum number of bytes of a file; of a longer one, the end is taken."""
RUNS = 5
SECRETS = re.compile(
    r"((?:token|password|passwd|secret|api_key)[\"']?\s*[=:]\s*[\"']?)[^\s\"',}]+|(://)[^/@\s]+@",
    re.IGNORECASE,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("file", type=Path, metavar="FILE", help="zip file to write")
    add_name(parser)
    parser.add_argument(
        "--runs", type=Path, help="folder of the runs (default: that of the deployed cell, or runs)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if the file was written, otherwise 1."""
    places = Places(arguments.name, arguments.root)
    path = arguments.file.expanduser()
    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bundle:
            for name, text in contents(places, arguments.runs):
                bundle.writestr(name, redacted(text))
    except OSError as error:
        print_error(f"{error.filename or path}: {error.strerror}")
        return ExitStatus.FAILED
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB; look through it before you send it")
    return ExitStatus.DONE


def redacted(text: str) -> str:
    """Return the text without tokens and passwords."""
    return SECRETS.sub(lambda found: f"{found[1] or found[2]}REDACTED" + "@" * bool(found[2]), text)


def contents(places: Places, runs: Path | None) -> Iterator[tuple[str, str]]:
    """Return name and text of each file of the bundle."""
    deployed = places.manifest() is not None
    runs = runs or (places.runs if deployed else Path("runs"))
    state = {
        "versions": versions(),
        "system": platform.platform(),
        "computer": computer.state(runs.absolute()),
        "service": service_state(places),
        "devices": sorted(
            f"{link} -> {os.readlink(link)}"
            for folder in ("serial/by-id", "v4l/by-id", places.name)
            for link in Path("/dev", folder).glob("*")
            if link.is_symlink()
        ),
    }
    yield "state.json", json.dumps(state, indent=2)
    if deployed:
        found = [vars(entry) | {"file": str(entry.file)} for entry in check(places.cell_file)]
        yield "check_config.json", json.dumps(found, indent=2)
        yield (
            "journal.txt",
            output_of(
                "journalctl",
                f"--unit={places.unit}",
                "--lines=3000",
                "--no-pager",
                "--output=short-iso",
            ),
        )
    for name, data in collected(places).items():
        yield name, data[-LONGEST:].decode("utf-8", errors="replace")
    files = {"service/cell.env": places.configuration / "cell.env"}
    files["service/unit"] = places.root / "etc/systemd/system" / places.unit
    files["runs/refused"] = runs / REFUSALS
    logs = places.root / "var/log" / places.name if deployed else runs / "up"
    files |= {f"logs/{log.relative_to(logs)}": log for log in sorted(logs.rglob("*.log"))}
    summaries = sorted(runs.glob("*/summary.json"), key=lambda file: file.lstat().st_mtime)
    for file in summaries[-RUNS:]:
        for each in (file, file.with_name("taps.csv")):
            files[f"runs/{file.parent.name}/{each.name}"] = each
    # A symbolic link below one of these folders could lead to any file of the computer.
    trusted = (places.configuration, places.state, runs, logs, places.root / "etc")
    for name, file in files.items():
        last = read_inside(
            file, next(base for base in trusted if file.is_relative_to(base)), LONGEST
        )
        if last is not None:
            yield name, last.decode("utf-8", errors="replace")
