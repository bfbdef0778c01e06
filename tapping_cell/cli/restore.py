"""Restore an archive that ``backup`` wrote into a deployed cell.

The archive is checked first: checksums, then every configuration file in it as by check-config. The
present files are archived before they are replaced. Files that the archive does not contain stay.

    python -m tapping_cell restore cell_2026-11-29.zip
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from tapping_cell.cli.check_config import check
from tapping_cell.cli.deploy import add_name, agreed
from tapping_cell.cli.deployment.archive import (
    BEFORE,
    ArchiveError,
    read_archive,
    restore_file,
    target,
    write_archive,
)
from tapping_cell.cli.deployment.places import Places
from tapping_cell.cli.errors import ExitStatus, print_error


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("file", type=Path, metavar="FILE", help="zip file written by backup")
    add_name(parser)
    parser.add_argument("--dry-run", action="store_true", help="print the differences only")
    parser.add_argument("--yes", action="store_true", help="replace the files without asking")


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if the files were restored, 1 if a file could not be written or the
    person declined, 2 for an unsuitable archive."""
    places = Places(arguments.name, arguments.root)
    try:
        if places.manifest() is None:
            raise ArchiveError(f"no cell '{places.name}' is deployed here: deploy it first")
        content, texts = read_archive(arguments.file.expanduser())
        errors = configuration_errors(texts)
        if errors:
            raise ArchiveError(f"{arguments.file} is not restored: {errors[0]}")
    except ArchiveError as error:
        print_error(str(error))
        return ExitStatus.REFUSED
    print(f"archive of '{content['name']}', made {content['made']}, up {content['options']}")
    changes = {name: target(name, places) for name in texts}
    changes = {name: path for name, path in changes.items() if _text(path) != texts[name]}
    for path in changes.values():
        print(f"{'replace' if path.exists() else 'write  '} {path}")
    if arguments.dry_run or not changes:
        print(f"{len(texts) - len(changes)} files are the same")
        return ExitStatus.DONE
    if not arguments.yes and not agreed():
        return ExitStatus.FAILED
    try:
        # Not in the home folder of the service, whose user could replace it by a link.
        write_archive(places.configuration / BEFORE, places)
        # The cell file comes last, because it names the others.
        for name in sorted(changes, key=lambda name: name == "configuration/cell.yaml"):
            restore_file(changes[name], texts[name], places)
    except (ArchiveError, OSError) as error:
        print_error(f"{error}; restore again after the remedy")
        return ExitStatus.FAILED
    print(f"restored; the earlier files are in {places.configuration / BEFORE}")
    print(f"put into effect: systemctl restart {places.name}")
    return ExitStatus.DONE


def configuration_errors(texts: dict[str, str]) -> list[str]:
    """Return the errors in the archived configuration, as found by check-config in a copy."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in texts.items():
            path = Path(folder) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        found = check(Path(folder) / "configuration/cell.yaml")
        return [line.replace(folder, "archive") for one in found for line in one.errors]


def _text(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None
