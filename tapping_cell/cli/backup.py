"""Write an archive of a deployed cell: cell file, object files, calibrations with their history,
learnt gains and named goals, with versions and checksums.

It contains neither runs nor stops, and no environment of this computer.

    python -m tapping_cell backup cell_2026-11-29.zip
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tapping_cell.cli.deploy import add_name
from tapping_cell.cli.deployment.archive import ArchiveError, write_archive
from tapping_cell.cli.deployment.places import Places
from tapping_cell.cli.errors import ExitStatus, print_error


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("file", type=Path, metavar="FILE", help="zip file to write")
    add_name(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if the archive was written, 1 if it could not be written, 2 if no cell
    is deployed or the file is a folder."""
    path = arguments.file.expanduser()
    if path.is_dir():
        print_error(f"{path} is a folder; give the name of a zip file in it")
        return ExitStatus.REFUSED
    try:
        count = write_archive(path, Places(arguments.name, arguments.root))
    except ArchiveError as error:
        print_error(str(error))
        return ExitStatus.REFUSED
    except OSError as error:
        print_error(f"{error.filename or path}: {error.strerror}")
        return ExitStatus.FAILED
    print(f"{path}: {count} files")
    return ExitStatus.DONE
