"""Remove what ``deploy`` wrote: unit, device names, environment, and unchanged cell files.

Files that were changed since, such as calibrations, and the state (runs, stops, learnt gains) are
kept; --all removes them and the system user too.

    python -m tapping_cell undeploy
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
from pathlib import Path

from tapping_cell.cli.deploy import add_name, agreed, available, digest, run_all
from tapping_cell.cli.deployment.places import MANIFEST, Places
from tapping_cell.cli.errors import ExitStatus, print_error


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    add_name(parser)
    parser.add_argument(
        "--all",
        action="store_true",
        help="remove changed files, state, runs, logs and the system user as well",
    )
    parser.add_argument("--dry-run", action="store_true", help="print the plan only")
    parser.add_argument("--yes", action="store_true", help="carry out the plan without asking")


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if all was removed, 1 if a step failed or was declined, 2 if nothing
    is deployed."""
    places = Places(arguments.name, arguments.root)
    manifest = places.manifest()
    if manifest is None:
        print_error(
            f"no cell '{places.name}' is deployed: {places.configuration} has no {MANIFEST}"
        )
        return ExitStatus.REFUSED
    live = places.root == Path("/")
    removed = [places.configuration / MANIFEST]
    for path, written in manifest["files"].items():
        place = places.root / path.lstrip("/")
        if arguments.all or _is_unchanged(place, written):
            removed.append(place)
        elif place.exists():
            print(f"keep   {place}: changed since it was deployed")
    folders = [places.configuration, places.state, places.root / "var/log" / places.name]
    commands = available([["systemctl", "disable", "--now", places.unit]]) if live else []
    after = [["systemctl", "daemon-reload"], ["udevadm", "control", "--reload"]]
    if arguments.all:
        after.append(["userdel", places.name])
    after = available(after) if live else []
    for place in [*removed, *(folders if arguments.all else ())]:
        print(f"remove {place}")
    for command in [*commands, *after]:
        print(f"run    {' '.join(command)}")
    if arguments.dry_run:
        return ExitStatus.DONE
    if live and os.geteuid() != 0:
        print_error("only root may undeploy: use sudo")
        return ExitStatus.REFUSED
    if not arguments.yes and not agreed():
        return ExitStatus.FAILED
    status = run_all(commands)
    try:
        # The list goes last, so that undeploy can be repeated after an error.
        for place in reversed(removed):
            place.unlink(missing_ok=True)
        if arguments.all:
            for folder in folders:
                if folder.exists():
                    shutil.rmtree(folder)
    except OSError as error:
        print_error(f"{error.filename}: {error.strerror}")
        return ExitStatus.FAILED
    for folder in (places.configuration / "objects", places.configuration):
        with contextlib.suppress(OSError):
            folder.rmdir()
    return run_all(after) or status


def _is_unchanged(place: Path, written: str) -> bool:
    try:
        text = os.readlink(place) if place.is_symlink() else place.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return False
    return digest(text) == written
