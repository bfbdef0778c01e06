"""Remove what ``deploy`` wrote: unit, device names, environment, and unchanged cell files.

Files that were changed since, such as calibrations, and the state (runs, stops, learnt gains) are
kept; --all removes them too, and the system user if deploy made it. It may be given later.

    python -m tapping_cell undeploy
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
from pathlib import Path

from tapping_cell.cli.deploy import (
    add_name,
    agreed,
    available,
    digest_of,
    run_all,
    user_exists,
    write_list,
)
from tapping_cell.cli.deployment.places import LEFT, MANIFEST, VERSIONS, Places
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
    manifest = places.known() if arguments.all else places.manifest()
    if manifest is None:
        print_error(
            f"no cell '{places.name}' is deployed: {places.configuration} has no {MANIFEST}"
        )
        return ExitStatus.REFUSED
    live = places.root == Path("/")
    removed, left = [], {}
    for path, written in manifest["files"].items():
        place = places.root / path.lstrip("/")
        if arguments.all or digest_of(place) == written:
            removed.append(place)
        elif place.exists():
            left[path] = written
            print(f"keep   {place}: changed since it was deployed")
    folders = [places.state, places.root / "var/log" / places.name, places.configuration]
    lists = [places.configuration / name for name in (MANIFEST, LEFT)]
    enabled = live and f"/etc/systemd/system/{places.unit}" in manifest["files"]
    commands = available([["systemctl", "disable", "--now", places.unit]]) if enabled else []
    after = [["systemctl", "daemon-reload"], ["udevadm", "control", "--reload"]]
    if arguments.all and manifest.get("user") is True and user_exists(places):
        after.append(["userdel", places.name])
    after = available(after) if live else []
    for place in [*removed, *(folders if arguments.all else lists[:1])]:
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
        # The lists go last, so that undeploy can be repeated after an error.
        for place in reversed(removed):
            place.unlink(missing_ok=True)
        if arguments.all:
            for folder in folders[:2]:
                _remove(folder)
        elif left or user_exists(places) or _anything_in(folders, lists):
            write_list(places, LEFT, {"user": manifest.get("user") is True, "files": left})
            lists.pop()
        for place in lists:
            place.unlink(missing_ok=True)
        if arguments.all:
            _remove(places.configuration)
    except OSError as error:
        print_error(f"{error.filename}: {error.strerror}")
        return ExitStatus.FAILED
    for name in ("objects", VERSIONS, ""):
        with contextlib.suppress(OSError):
            (places.configuration / name).rmdir()
    return run_all(after) or status


def _anything_in(folders: list[Path], lists: list[Path]) -> bool:
    """Return whether files other than the lists are left, or a folder of state or logs."""
    own = (path for path in folders[-1].rglob("*") if path not in lists and not path.is_dir())
    return any(folder.exists() for folder in folders[:-1]) or any(own)


def _remove(folder: Path) -> None:
    """Remove a folder; of a symbolic link, only the link."""
    if folder.is_symlink():
        folder.unlink()
    elif folder.exists():
        shutil.rmtree(folder)
