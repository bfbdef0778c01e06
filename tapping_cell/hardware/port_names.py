"""Names of serial ports: what is wrong with one, and whether two name the same device."""

from __future__ import annotations

import os
import re
from pathlib import Path

BY_ID = Path("/dev/serial/by-id")
"""Folder with a permanent link for each USB serial device that is plugged in."""


def device_of(port: str) -> str:
    """Return the device that a port names, after following links."""
    return os.path.realpath(Path(port).expanduser())


def is_foreign(port: str) -> bool:
    """Return whether a port has a name of Windows, such as COM3, contains a baud rate or wildcards,
    or lacks its folder."""
    return (
        _is_windows_name(port)
        or _is_pattern(port)
        or _baud_behind(port) is not None
        or not Path(port).expanduser().is_absolute()
    )


def _baud_behind(port: str) -> re.Match[str] | None:
    """Return the match of a device's name and a baud rate behind it, such as /dev/ttyUSB0:115200;
    None if the port is another name. Links in /dev/serial/by-path contain colons."""
    return re.fullmatch(r"(/dev/tty\w+)[:,@ ]+([0-9]{4,})", port)


def _is_pattern(port: str) -> bool:
    return any(character in port for character in "*?[")


def _is_windows_name(port: str) -> bool:
    return re.fullmatch(r"(\\\\\.\\)?COM\d+:?", port, re.IGNORECASE) is not None


def port_problem(port: str, links: Path = BY_ID) -> str:
    """Return why a port cannot be opened and what to do, as an end of a sentence; empty if it
    exists."""
    present = sorted(str(link) for link in links.iterdir()) if links.is_dir() else []
    choice = f"connected are {', '.join(present)}" if present else f"{links} lists no device"
    if _is_windows_name(port):
        return (
            f"is a name of Windows; give the device's name on Linux, such as {links}/... ({choice})"
        )
    if _is_pattern(port):
        return f"contains wildcards; give the name of one device ({choice})"
    if found := _baud_behind(port):
        return f"contains a baud rate; write 'port: {found[1]}' and 'baud: {found[2]}'"
    if Path(port).expanduser().exists():
        return ""
    if not Path(port).expanduser().is_absolute():
        return f"is not a full path; write /dev/{port} if it is a device ({choice})"
    if Path(port).parent == links:
        return (
            f"is not connected: plug the device in and switch it on; if its adapter was "
            f"replaced, give the name of the new one ({choice})"
        )
    return (
        "does not exist (yet): a simulated port is created by sim_world; a real device must be "
        f"plugged in ({choice})"
    )
