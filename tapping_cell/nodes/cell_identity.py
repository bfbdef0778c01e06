"""What tells one cell on this machine from another: its ROS domain and its namespace.

Whatever a cell keeps or opens outside ROS (the simulated devices' ports, the goal under way, learnt
gains) is named by both, below the home folder of its user.
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
    """A file name for the cell: ``domain0`` for the plain one, ``domain7.left`` for ``/left`` in
    domain 7. ROS names hold no dots, so that no two cells share a key."""
    return ".".join((f"domain{domain}", *filter(None, namespace.split("/"))))


def key_of(node: Node) -> str:
    """The key of the cell that a node belongs to."""
    return cell_key(node.context.get_domain_id(), node.get_namespace())


def state_folder(key: str) -> Path:
    """Where a cell of this user keeps what outlives its nodes."""
    return STATE.expanduser() / key


def claim(name: str) -> socket.socket | None:
    """Hold a name on this machine, for all users, until the returned socket is closed or this
    process ends; None where another process holds it.

    The name is a Linux abstract socket address: it leaves no file behind, and it reaches exactly as
    far as the loopback interface does over which the nodes of two cells would meet.
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
