"""Archive of what a deployed cell has learnt from people and measurements: a zip file with a list
of checksums."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import Any

from tapping_cell.calibration.keep import now
from tapping_cell.cli.deployment.inside import read_inside, write_inside
from tapping_cell.cli.deployment.places import LEFT, MANIFEST, VERSION, VERSIONS, Places
from tapping_cell.durable_file import part_of, sync_folder
from tapping_cell.report.versions import versions

CONTENT = "content.json"
FORMAT = 1
LARGEST = 64_000_000
"""Largest size in bytes of an unpacked archive."""
BEFORE = "before_restore.zip"
"""Archive of the present files that ``restore`` replaced."""
BEFORE_UPDATE = "before_update.zip"
"""Archive of the files as they were before the last change of the version."""
OF_THE_COMPUTER = (MANIFEST, LEFT, BEFORE, BEFORE_UPDATE, "cell.env", VERSION)
"""Files of the configuration that belong to the computer, and are written by ``deploy``."""
NAMED_GOALS = "named_goals.json"


class ArchiveError(ValueError):
    """The archive cannot be read or restored. The message states the reason."""


def collected(places: Places) -> dict[str, bytes]:
    """Return the contents of the text files of a deployed cell that belong into an archive, by name
    in it.

    Runs are too large. Stops, goals under way and the numbers of shots must never be set back.
    Symbolic links are left out: they could lead to any file of the computer.
    """
    found: dict[str, bytes] = {}
    for folder, root, base, pattern in (
        ("configuration", places.configuration, places.configuration, "*"),
        ("gains", places.gains, places.state, "*.json"),
        ("records", places.records, places.state, NAMED_GOALS),
    ):
        for file in sorted(root.rglob(pattern)):
            inside = file.relative_to(root).as_posix()
            data = None if _of_the_computer(inside) else read_inside(file, base)
            if data is not None and _is_text(data):
                found[f"{folder}/{inside}"] = data
    return found


def _of_the_computer(inside: str) -> bool:
    return inside in OF_THE_COMPUTER or inside.startswith(f"{VERSIONS}/")


def _is_text(data: bytes) -> bool:
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def write_archive(path: Path, places: Places) -> int:
    """Write an archive of a deployed cell, and return the number of its files.

    Raises:
        ArchiveError: there is nothing to archive.
        OSError: a file cannot be read or written.
    """
    contents = collected(places)
    if "configuration/cell.yaml" not in contents:
        raise ArchiveError(f"{places.cell_file} is missing: no cell '{places.name}' is deployed")
    content = {
        "format": FORMAT,
        "name": places.name,
        "made": now(),
        "versions": versions(),
        "options": up_options(places),
        "files": {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()},
    }
    part = part_of(path)
    part.unlink(missing_ok=True)
    # A new file: a link that another user has put there is not followed.
    with part.open("xb") as stream:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(CONTENT, json.dumps(content, indent=2))
            for name, data in contents.items():
                archive.writestr(name, data)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(path)
    sync_folder(path.parent)
    return len(contents)


def up_options(places: Places) -> str:
    """Return the options with which the service calls ``up``; empty if they are unknown."""
    return environment_of(places, "cell.env").get("CELL_OPTIONS", "")


def environment_of(places: Places, file: str) -> dict[str, str]:
    """Return the variables in an environment file of the service; empty if it cannot be read."""
    try:
        lines = (places.configuration / file).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return {}
    return dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))


def read_archive(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the list of contents and the text of each file, after a check of every checksum.

    Raises:
        ArchiveError: the archive is damaged, of a newer format, or contains another path than an
            archive of a cell may contain.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > LARGEST:
                raise ArchiveError(f"{path} is too large for an archive of a cell")
            if CONTENT not in archive.namelist():
                packed = any(name.endswith(f"/{CONTENT}") for name in archive.namelist())
                remedy = "it was packed again with its folder: " if packed else ""
                raise ArchiveError(
                    f"{path} is no archive of a cell: {remedy}give the file that backup wrote"
                )
            content = json.loads(archive.read(CONTENT))
            if not isinstance(content, dict) or not isinstance(content.get("files"), dict):
                raise ArchiveError(f"{path} has no list of its files")
            if content["format"] != FORMAT:
                raise ArchiveError(
                    f"{path} has the format {content['format']}, but this version reads {FORMAT}: "
                    f"use version {content['versions']['tapping_cell']}"
                )
            if not all(isinstance(content.get(key), str) for key in ("name", "made", "options")):
                raise ArchiveError(f"{path} does not state its cell, date and options")
            texts: dict[str, str] = {}
            for name, digest in content["files"].items():
                data = archive.read(name)
                if hashlib.sha256(data).hexdigest() != digest:
                    raise ArchiveError(f"{path}: {name} is damaged")
                if not _is_allowed(name):
                    raise ArchiveError(f"{path}: {name} does not belong into an archive of a cell")
                texts[name] = data.decode("utf-8")
    except (zipfile.BadZipFile, zlib.error) as error:
        raise ArchiveError(f"{path} is no zip file, or damaged: {error}") from error
    except ArchiveError:
        raise
    except (
        OSError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        RuntimeError,
        EOFError,
    ) as error:
        raise ArchiveError(f"{path} is no archive of a cell, or damaged: {error}") from error
    if "configuration/cell.yaml" not in texts:
        raise ArchiveError(f"{path} contains no cell file")
    return content, texts


def _is_allowed(name: str) -> bool:
    # Written in any other way, such as with "//", a name could lead out of its folder.
    plain = PurePosixPath(name)
    parts = plain.parts
    inside = len(parts) > 1 and ".." not in parts and "\\" not in name
    if (
        name != str(plain)
        or plain.is_absolute()
        or not inside
        or _of_the_computer("/".join(parts[1:]))
    ):
        return False
    return parts[0] in ("configuration", "gains") or (
        parts[0] == "records" and parts[-1] == NAMED_GOALS
    )


def target(name: str, places: Places) -> Path:
    """Return the path of an archived file on this computer."""
    folder, _, inside = name.partition("/")
    roots = {"configuration": places.configuration, "gains": places.gains}
    return roots.get(folder, places.records) / inside


def restore_file(path: Path, text: str, places: Places) -> None:
    """Replace a file. What is made in the home folder of the service belongs to its user, who could
    put links there.

    Raises:
        OSError: the file cannot be written, or a symbolic link is in the place of its folder.
    """
    if not path.is_relative_to(places.state):
        write_inside(path, places.configuration, text, None, 0o644)
        return
    owner = None
    if places.state.exists() and os.geteuid() == 0:
        found = places.state.stat()
        owner = found.st_uid, found.st_gid
    write_inside(path, places.state, text, owner, None)
