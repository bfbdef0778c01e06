"""Identity of a cell on this machine: its ROS domain and its namespace.

Some resources of a cell are outside ROS: the ports of simulated devices, the stored goal and learnt
gains. These resources are in the home folder of the user, and their names contain the domain and
the namespace.
"""

from __future__ import annotations

import errno
import socket
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.node import Node

STATE = Path("~/.ros/tapping_cell")


def cell_key(domain: int, namespace: str) -> str:
    """Return a file name for the cell: ``domain0`` for the default namespace of domain 0,
    ``domain7.left`` for ``/left`` in domain 7. ROS names contain no dots, so no two cells share a
    key."""
    return ".".join((f"domain{domain}", *filter(None, namespace.split("/"))))


def key_of(node: Node) -> str:
    """Return the key of the cell that a node belongs to."""
    return cell_key(node.context.get_domain_id(), node.get_namespace())


def state_folder(key: str) -> Path:
    """Return the folder in which a cell of this user stores files that outlive its nodes."""
    return STATE.expanduser() / key


def claim(name: str) -> socket.socket | None:
    """Reserve a name on this machine, for all users, until the returned socket is closed or this
    process ends. Return None if another process holds the name.

    The name is a Linux abstract socket address. The name leaves no file behind. It is valid within
    one network namespace of Linux. One network namespace is sufficient: the nodes of two cells
    could disturb each other through the loopback interface, and this interface belongs to a single
    network namespace too.
    """
    held = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        held.bind(f"\0tapping_cell/{name}")
    except OSError as error:
        held.close()
        if error.errno == errno.EADDRINUSE:
            return None
        raise
    return held
