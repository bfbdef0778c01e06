"""Checks of options and files that a verb makes before it starts the nodes."""

from __future__ import annotations

import argparse
import errno
import os
import socket
from pathlib import Path

from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.objects import load_object
from tapping_cell.configuration.schema import ConfigurationError, load
from tapping_cell.simulation.truth import TruthFile


def check_simulation_files(arguments: argparse.Namespace) -> None:
    """Load the files of ``--truth`` and ``--truth-object``.

    Raises:
        ConfigurationError: a file cannot be read or is wrong.
    """
    if arguments.truth is not None:
        load(TruthFile, arguments.truth)
    if arguments.truth_object is not None:
        load_object(arguments.truth_object)


def refuse_unused(arguments: argparse.Namespace, needs: str, *names: str) -> None:
    """Refuse options that would have no effect.

    ``names``: the options, as attributes of ``arguments``. ``needs``: the condition under which the
    options have an effect, such as "only with --table".

    Raises:
        ConfigurationError: one of the options was given.
    """
    for name in names:
        value = getattr(arguments, name)
        if value is not None and value is not False:
            option = "--" + name.replace("_", "-")
            raise ConfigurationError(f"{option} is used {needs}; leave {option} out")


def require_folder(folder: Path | None, option: str) -> None:
    """Check that a folder exists or can be created, without creating it.

    Raises:
        ConfigurationError: the path is a file, or the user may not write there.
    """
    if folder is None:
        return
    nearest = next(
        each for each in (folder.absolute(), *folder.absolute().parents) if each.exists()
    )
    if not nearest.is_dir():
        raise ConfigurationError(
            f"{option} is {folder}, but {nearest} is a file, not a folder; choose another folder"
        )
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ConfigurationError(
            f"{option} is {folder}, but you may not write to {nearest}; choose another folder"
        )


def require_address(place: tuple[str, int], option: str) -> None:
    """Check that a server may listen at an address and port. A port in use is not an error here,
    because the page waits until the port is free.

    Raises:
        ConfigurationError: the address is not one of this computer, or the port is not allowed.
    """
    host, port = place
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        for family, kind, protocol, _, address in found[:1]:
            with socket.socket(family, kind, protocol) as server:
                server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                server.bind(address)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return
        raise ConfigurationError(
            f"{option}: no server can listen at {host}, port {port} ({error.strerror}); use an"
            " address of this computer and a port from 1024 on"
        ) from None


def off_table(cell: Cell, x: float, y: float) -> str:
    """Return the reason why a goal (x and y in m) is refused; empty if the goal lies on the
    table."""
    table = cell.file.table
    if abs(x) <= 0.5 * table.length and abs(y) <= 0.5 * table.width:
        return ""
    return (
        f"the goal x {1000 * x:.0f} mm, y {1000 * y:.0f} mm lies outside the usable area of the"
        f" table, {1000 * table.length:.0f} mm x {1000 * table.width:.0f} mm around its origin;"
        " choose a goal within it"
    )
