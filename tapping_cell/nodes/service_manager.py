"""Messages to the service manager that started this process, systemd or the verb ``up``, and to
systemd's journal.

The protocol is that of sd_notify(3): a datagram to the socket in ``NOTIFY_SOCKET``. Without this
variable, nothing is sent. ``up`` sets it for its nodes, and systemd for ``up``.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct

SOCKET_VARIABLE = "NOTIFY_SOCKET"
ALIVE = "WATCHDOG=1"
JOURNAL = "/run/systemd/journal/socket"
STREAM_VARIABLE = "JOURNAL_STREAM"
"""Variable that systemd sets for a service whose output goes to the journal."""
_CREDENTIALS = struct.Struct("3i")  # struct ucred: pid, uid, gid


def notify(state: str) -> None:
    """Send a state, such as ``READY=1``. A failure is ignored, because the service manager then
    acts by itself."""
    address = os.environ.get(SOCKET_VARIABLE, "")
    if not address:
        return
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender,
    ):
        abstract = address.startswith("@")
        sender.sendto(state.encode(), "\0" + address[1:] if abstract else address)


def journal(node: str, code: int, sentence: str) -> None:
    """Write an error code to the journal of systemd, with the fields ``TAPPING_CELL_CODE`` and
    ``TAPPING_CELL_NODE``. Without systemd, and after a failure, nothing is written: the node's log
    has the sentence too."""
    if STREAM_VARIABLE not in os.environ:
        return
    fields = {
        "MESSAGE": f"{node}: {' '.join(sentence.split())} ({code})",
        "PRIORITY": "4",
        "SYSLOG_IDENTIFIER": "tapping_cell",
        "TAPPING_CELL_CODE": str(code),
        "TAPPING_CELL_NODE": node,
    }
    text = "".join(f"{key}={value}\n" for key, value in fields.items())
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender,
    ):
        sender.sendto(text.encode(errors="replace"), JOURNAL)


class Notifications:
    """Socket on which child processes report that their loop runs."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        # The kernel chooses an unused abstract address, and adds the sender's process id.
        self._socket.bind("")
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self.address = "@" + self._socket.getsockname()[1:].decode()

    def alive(self) -> set[int]:
        """Return the ids of the processes that have reported since the last call."""
        found: set[int] = set()
        space = socket.CMSG_SPACE(_CREDENTIALS.size)
        with contextlib.suppress(BlockingIOError):
            while True:
                text, extra, _, _ = self._socket.recvmsg(256, space)
                if ALIVE.encode() in text.split(b"\n"):
                    found |= {_CREDENTIALS.unpack(data)[0] for _, _, data in extra}
        return found

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
