"""Make a cell start with this computer: a systemd unit, a system user, device names, and files in
/etc.

The plan is printed first, and carried out after a yes. Cell files are replaced only by others that
--cell gives; the earlier ones are kept in .history. The cell comes up stopped: the arm is homed
only on request, and a stored stop stays active. Run it as root in a shell that is set up, from a
source folder outside the home folders, such as /opt.

    python -m tapping_cell deploy --dry-run
    python -m tapping_cell deploy --page
    python -m tapping_cell deploy --hardware --cell my_cell.yaml --camera /dev/video0 --page
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import grp
import hashlib
import json
import os
import pwd
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tapping_cell import __version__
from tapping_cell.calibration.keep import HISTORY, keep_earlier, now
from tapping_cell.cli import argument_types
from tapping_cell.cli.deployment import service
from tapping_cell.cli.deployment.adapters import Adapter, adapter_of
from tapping_cell.cli.deployment.cell_copy import copied_cell
from tapping_cell.cli.deployment.places import (
    DEFAULT_NAME,
    LEFT,
    MANIFEST,
    VERSION,
    VERSIONS,
    Places,
    valid_name,
)
from tapping_cell.cli.errors import ExitStatus, print_error, print_refusal
from tapping_cell.cli.graph import GraphError, domain_number
from tapping_cell.cli.start_checks import refuse_unused
from tapping_cell.cli.up import CAMERA
from tapping_cell.configuration.cell import (
    Cell,
    load_cell,
    refuse_own_drivers,
    refuse_simulated_ports,
)
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.durable_file import part_of, replace_text, sync_folder

PRIVATE_FOLDERS = ("/home", "/root", "/tmp", "/var/tmp", "/run")
"""Folders that the service cannot see."""


@dataclass(frozen=True, slots=True)
class PlannedFile:
    """A file or symbolic link to be written."""

    path: Path
    """Path on the deployed computer."""
    text: str
    """Content, or the target of the link."""
    link: bool = False
    cell: bool = False
    """Whether it is a copy of a cell file or of a file that it names, and may be calibrated."""
    deployed: str | None = None
    """Digest of the content that ``deploy`` wrote; None if ``text`` is that content, and not a
    later calibration of it."""

    def act(self, places: Places, replaces: bool) -> str:
        """Return what is done: ``keep``, ``write``, or ``replace`` of a file that was changed or
        comes from another cell, with a copy of the earlier one. ``replaces``: the cell files were
        named, and replace those of another cell."""
        place = places.root / self.path.relative_to("/")
        if self.link or not place.exists():
            return "write"
        present = digest_of(place)
        if present == digest(self.text):
            return "keep" if self.cell else "write"
        deployed = (places.known() or {}).get("files", {}).get(str(self.path))
        if self.cell:
            # Of the same source as before, the present file may be a later calibration.
            return "replace" if replaces and deployed != digest(self.text) else "keep"
        return "write" if present == deployed else "replace"

    def write(self, places: Places, act: str) -> None:
        """Write the file."""
        place = places.root / self.path.relative_to("/")
        make_folder(place.parent)
        if act == "replace":
            keep_earlier(place, place if self.cell else places.configuration / place.name)
        if self.link:
            part = part_of(place)
            part.unlink(missing_ok=True)
            part.symlink_to(self.text)
            part.replace(place)
            sync_folder(place.parent)
        else:
            replace_text(place, self.text)
            place.chmod(0o644)


def make_folder(path: Path) -> None:
    """Make a folder that every user may read, whatever the umask is."""
    for folder in reversed([path, *path.parents]):
        if not folder.exists():
            folder.mkdir()
            folder.chmod(0o755)


def add_name(parser: argparse.ArgumentParser) -> None:
    """Declare --name and --root, which select a deployed cell."""
    parser.add_argument(
        "--name",
        type=_name,
        default=DEFAULT_NAME,
        help="name of the deployed cell, its user, unit and folders (default: tapping_cell)",
    )
    parser.add_argument(
        "--root",
        type=Path,
        default=Path("/"),
        metavar="FOLDER",
        help="root folder of the computer, such as that of a mounted image (default: /)",
    )


def _name(text: str) -> str:
    try:
        return valid_name(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    add_name(parser)
    argument_types.add_cell(parser)
    parser.add_argument(
        "--hardware",
        action="store_true",
        help="use the real camera, arm and tapper (default: simulated)",
    )
    parser.add_argument(
        "--camera", help="camera device (only with --hardware; default: /dev/video0)"
    )
    argument_types.add_page(parser)
    parser.add_argument(
        "--domain",
        type=int,
        metavar="N",
        help="ROS domain of the cell (default: ROS_DOMAIN_ID, or 0); two cells on one computer need"
        " different ones",
    )
    parser.add_argument(
        "--range",
        choices=("LOCALHOST", "SUBNET"),
        default="LOCALHOST",
        help="where nodes find each other: on this computer, or in its network (default: "
        "LOCALHOST)",
    )
    argument_types.add_namespace(parser, "namespace of the nodes (default: none)")
    parser.add_argument(
        "--dry-run", action="store_true", help="print every file of the plan, and change nothing"
    )
    parser.add_argument("--yes", action="store_true", help="carry out the plan without asking")


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if the plan was carried out or only printed, 1 if a step of it failed
    or was declined, 2 for wrong input."""
    places = Places(arguments.name, arguments.root)
    try:
        if not arguments.hardware:
            refuse_unused(arguments, "only with --hardware", "camera")
        cell = load_cell(arguments.cell)
        if arguments.hardware:
            refuse_simulated_ports(cell)
        else:
            refuse_own_drivers(cell)
        domain = domain_number(
            os.environ if arguments.domain is None else {"ROS_DOMAIN_ID": str(arguments.domain)}
        )
        files, remarks = planned(arguments, cell, places, domain)
        refuse_foreign(places, files)
    except (ConfigurationError, GraphError, OSError) as error:
        return print_refusal(error)
    live = arguments.root == Path("/")
    commands = started_by(places) if live else []
    acts = {file: file.act(places, arguments.cell is not None) for file in files}
    obsolete = obsolete_files(places, files)
    print_plan(acts, places, obsolete, commands, remarks, texts=arguments.dry_run)
    if arguments.dry_run:
        return ExitStatus.DONE
    if refused := unsuitable(live):
        print_error(refused)
        return ExitStatus.REFUSED
    if not arguments.yes and not agreed():
        return ExitStatus.FAILED
    try:
        return carry_out(acts, obsolete, places, commands)
    except OSError as error:
        print_error(f"{error.filename}: {error.strerror}; deploy again after the remedy")
        return ExitStatus.FAILED


def print_plan(
    acts: Mapping[PlannedFile, str],
    places: Places,
    obsolete: Sequence[str],
    commands: Sequence[Sequence[str]],
    remarks: Sequence[str],
    *,
    texts: bool,
) -> None:
    """Print what is done, the differences of each replaced file and, if ``texts``, every file."""
    remarks = list(remarks)
    for file, act in acts.items():
        print(f"{act:7} {file.path}" + f" -> {file.text}" * file.link)
        lines = file.text.splitlines()
        if act == "replace":
            why = "differs from this cell" if file.cell else "was changed since it was deployed"
            folder = (file.path.parent if file.cell else Path("/etc") / places.name) / HISTORY
            remarks.append(f"{file.path} {why}; the present one is kept in {folder}")
            place = places.root / file.path.relative_to("/")
            present = place.read_text(encoding="utf-8", errors="replace").splitlines()
            lines = list(difflib.unified_diff(present, lines, "present", "new", lineterm=""))
        if not file.link and (texts or act == "replace"):
            print("".join(f"    {line}\n" for line in lines), end="")
    for path in obsolete:
        print(f"remove  {path}")
    for command in commands:
        print(f"run     {' '.join(command)}")
    for remark in remarks:
        print(f"note    {remark}")


def version_files(places: Places) -> list[PlannedFile]:
    """Return the environment of this version, and the link that makes the service use it."""
    configuration = Path("/etc") / places.name
    source = Path(__file__).resolve().parents[2]
    # env.sh refuses a folder with a colon, so no two folders share a name.
    file = f"{VERSIONS}/{str(source).lstrip('/').replace('/', ':')}.env"
    return [
        PlannedFile(configuration / file, service.version_text(os.environ)),
        PlannedFile(configuration / VERSION, file, link=True),
    ]


def planned(
    arguments: argparse.Namespace, cell: Cell, places: Places, domain: int
) -> tuple[list[PlannedFile], list[str]]:
    """Return the files of a deployment, and remarks on it."""
    name = places.name
    remarks = [
        f"old runs in /var/lib/{name}/runs are deleted while less than 20 % of the disk is free"
    ]
    configuration = Path("/etc") / name
    options = [
        *("--cell", str(configuration / "cell.yaml"), "--wait", "3600"),
        *("--runs", f"/var/lib/{name}/runs", "--logs", f"/var/log/{name}"),
        *("--keep-free", "20"),
    ]
    adapters: dict[str, Adapter] = {}
    ports: dict[str, str] = {}
    if arguments.hardware:
        wanted = {} if cell.file.arm is None else {"arm": cell.file.arm.port}
        for number, board in enumerate(cell.boards):
            wanted[f"tapper_{number}" if number else "tapper"] = board.port
        wanted["camera"] = arguments.camera or CAMERA
        for part, port in wanted.items():
            found = adapter_of(Path(port)) if port.startswith("/dev/") else None
            if found is None:
                remarks.append(f"{part}: {port or 'no port'} keeps its name: no USB adapter there")
                continue
            if not found.serial:
                remarks.append(
                    f"{part}: {port} has no serial number, so its USB socket {found.place} names it"
                )
            adapters[part] = found
            ports[port] = f"/dev/{name}/{part}"
        for part, found in same_serial(adapters).items():
            remarks.append(
                f"{part}: another adapter has the same serial number {found.serial}, so its USB "
                f"socket {found.place} names it"
            )
            adapters[part] = replace(found, serial="")
        options += ["--hardware", "--camera", ports.get(wanted["camera"], wanted["camera"])]
    if arguments.page:
        address, port = arguments.page
        options += ["--page", f"[{address}]:{port}" if ":" in address else f"{address}:{port}"]
        if address not in ("localhost", "127.0.0.1", "::1"):
            remarks.append(f"the page is open to the network; its token is in /var/log/{name}")
    if arguments.namespace:
        options += ["--namespace", arguments.namespace]
    links = tuple(f"{name}/{part}" for part in adapters)
    unit = service.unit_text(
        places, hardware=arguments.hardware, network=arguments.range != "LOCALHOST", links=links
    )
    environment = service.environment_text(
        places, " ".join(options), domain, arguments.range, os.environ
    )
    systemd = Path("/etc/systemd/system")
    files = [
        *(
            PlannedFile(configuration / path, text, cell=True)
            for path, text in sorted(copied_cell(cell, ports).items())
        ),
        PlannedFile(configuration / "cell.env", environment),
        *version_files(places),
        PlannedFile(Path(f"/etc/sysusers.d/{name}.conf"), service.user_text(places)),
        PlannedFile(Path(f"/etc/logrotate.d/{name}"), service.LOG_ROTATION.format(name=name)),
        PlannedFile(systemd / places.unit, unit),
        PlannedFile(
            systemd / "multi-user.target.wants" / places.unit, f"../{places.unit}", link=True
        ),
    ]
    if adapters:
        rules = [
            adapter.rule(f"{name}/{part}", name, places.unit) for part, adapter in adapters.items()
        ]
        files.append(
            PlannedFile(Path(f"/etc/udev/rules.d/70-{name}.rules"), "\n".join(rules) + "\n")
        )
    return files, remarks


def same_serial(adapters: Mapping[str, Adapter]) -> dict[str, Adapter]:
    """Return the adapters in different sockets that have the same serial number."""
    return {
        part: one
        for part, one in adapters.items()
        if one.serial
        and any(
            (one.vendor, one.product, one.serial) == (other.vendor, other.product, other.serial)
            and one.place != other.place
            for other in adapters.values()
        )
    }


def refuse_foreign(places: Places, files: list[PlannedFile]) -> None:
    """Check that a first deployment takes over nothing that belongs to something else.

    Raises:
        ConfigurationError: a user, folder, unit or file of this name exists already.
    """
    if places.known() is not None:
        return
    found = [
        str(folder)
        for folder in (places.configuration, places.state)
        # An interrupted deployment may leave an empty folder.
        if folder.is_symlink() or (folder.is_dir() and any(folder.iterdir())) or folder.is_file()
    ]
    units = ("etc", "run", "usr/local/lib", "usr/lib", "lib")
    paths = [places.root / folder / "systemd/system" / places.unit for folder in units]
    paths += [places.root / file.path.relative_to("/") for file in files if not file.cell]
    found += dict.fromkeys(str(path) for path in paths if path.exists() or path.is_symlink())
    if user_exists(places):
        found.insert(0, f"the user or group {places.name}")
    if found:
        raise ConfigurationError(
            f"{found[0]} exists already, and deploy did not make it: choose another --name, or "
            "remove it if it is not needed"
        )


def user_exists(places: Places) -> bool:
    """Return whether the computer has a user or a group with the name of the cell."""
    if places.root == Path("/"):
        for find in (pwd.getpwnam, grp.getgrnam):
            with contextlib.suppress(KeyError):
                find(places.name)
                return True
    for file in ("passwd", "group"):
        try:
            text = (places.root / "etc" / file).read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue
        if any(line.startswith(f"{places.name}:") for line in text.splitlines()):
            return True
    return False


def obsolete_files(places: Places, files: list[PlannedFile]) -> list[str]:
    """Return the files of an earlier deployment that this one lacks, such as the names of adapters.
    Cell files stay."""
    earlier = (places.known() or {}).get("files", {})
    planned_now = {str(file.path) for file in files}
    return [
        path
        for path in earlier
        if path not in planned_now and not path.startswith(f"/etc/{places.name}/")
    ]


def started_by(places: Places) -> list[list[str]]:
    """Return the commands that put the files into effect."""
    commands = [
        ["systemd-sysusers", f"/etc/sysusers.d/{places.name}.conf"],
        ["udevadm", "control", "--reload"],
        ["udevadm", "trigger", "--subsystem-match=tty", "--subsystem-match=video4linux"],
        ["systemctl", "daemon-reload"],
        ["systemctl", "restart", places.unit],
    ]
    return available(commands)


def available(commands: Sequence[list[str]]) -> list[list[str]]:
    """Return the commands that this computer has and that work now, without systemd and udev in a
    container."""
    works = {
        "systemctl": Path("/run/systemd/system").is_dir(),
        "udevadm": Path("/run/udev/control").exists(),
    }
    return [one for one in commands if shutil.which(one[0]) and works.get(one[0], True)]


def unsuitable(live: bool) -> str:
    """Return the reason why the service could not run here; empty if it can."""
    if not live:
        return ""
    if os.geteuid() != 0:
        return (
            "only root may deploy: sudo bash -c '. ./env.sh && python -m tapping_cell deploy ...'"
        )
    for path in (Path(__file__), Path(sys.executable)):
        inside = [folder for folder in PRIVATE_FOLDERS if path.resolve().is_relative_to(folder)]
        if inside:
            return (
                f"{path.resolve()} is in {inside[0]}, which a service cannot read: put the source "
                "folder into /opt, and set PYTHON to a Python in /usr before you source env.sh"
            )
    return ""


def agreed() -> bool:
    """Ask whether to carry out the plan."""
    try:
        return input("carry this out? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def carry_out(
    acts: Mapping[PlannedFile, str],
    obsolete: Sequence[str],
    places: Places,
    commands: Sequence[Sequence[str]],
) -> int:
    """Write the files, with a list of what was written for ``undeploy``, and run the commands. The
    list also states how to return to the version that was in use before."""
    known = places.known()
    written = (known or {}).get("files", {})
    # A first deployment makes the user: refuse_foreign refuses one that exists.
    user = known is None or known.get("user") is True
    content = {"version": __version__, "made": now(), "user": user, "files": written}
    content |= {key: known[key] for key in ("previous", "replaced") if known and key in known}
    present = places.version
    if present and any(file.path.name == VERSION and file.text != present for file in acts):
        content["previous"] = present
        content["replaced"] = {
            str(f.path): written.get(str(f.path), "")
            for f, act in acts.items()
            if act == "replace" and f.cell
        }
    make_folder(places.configuration)
    write_list(places, MANIFEST, content)
    (places.configuration / LEFT).unlink(missing_ok=True)
    for file, act in acts.items():
        if act != "keep":
            file.write(places, act)
            written[str(file.path)] = digest(file.text) if file.deployed is None else file.deployed
            # After an interruption, undeploy knows what was written until then.
            write_list(places, MANIFEST, content)
    for path in obsolete:
        place = places.root / path.lstrip("/")
        if not place.is_symlink() and place.exists() and digest_of(place) != written[path]:
            keep_earlier(place, places.configuration / place.name)
        place.unlink(missing_ok=True)
        del written[path]
        write_list(places, MANIFEST, content)
    return run_all(commands)


def write_list(places: Places, name: str, content: Mapping[str, object]) -> None:
    """Write a list of files that every user may read."""
    replace_text(places.configuration / name, json.dumps(content, indent=2) + "\n")
    (places.configuration / name).chmod(0o644)


def run_all(commands: Sequence[Sequence[str]]) -> int:
    """Run commands, all of them even if one fails. Return the exit code of the verb."""
    status = ExitStatus.DONE
    for command in commands:
        result = subprocess.run(command, check=False, capture_output=True, text=True)
        if result.returncode:
            print_error(f"{' '.join(command)}: {(result.stderr or result.stdout).strip()}")
            status = ExitStatus.FAILED
    return status


def digest_of(place: Path) -> str:
    """Return the digest of a file, or of the target of a link; empty if it cannot be read."""
    try:
        text = os.readlink(place) if place.is_symlink() else place.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""
    return digest(text)


def digest(text: str) -> str:
    """Return the SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()
