"""Life-cycle state and diagnostics of every node of the cell. Active only while a page is open.

A node is identified by the role that it reports on /diagnostics, because a node that was renamed
with ``__node:=`` may have any name.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.srv import GetState
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future

from tapping_cell.nodes.cell_node import ROLE

ARM = "scara_arm"
ACTORS = (ARM, "tapper_trigger")
"""Roles of the nodes that move hardware."""
VISION = "camera_pose"
CORE = (VISION, "tap_planner", ARM, "tapper_trigger")
"""Roles that every cell needs, in addition to a camera. ARM is not required with fixed tappers."""
CAMERAS = ("sim_world", "overhead_camera")
"""Roles of the cell's own nodes that publish images. Another camera driver may replace them."""
SILENCE_LIMIT_S = 3.5
"""Age of the last diagnostics above which a node counts as silent. Nodes send diagnostics every
second."""
TIMEOUT_S = 3.0
LEVELS = {
    DiagnosticStatus.OK: "ok",
    DiagnosticStatus.WARN: "warn",
    DiagnosticStatus.ERROR: "error",
    DiagnosticStatus.STALE: "error",
}
NOT_YET = "no diagnostics yet"
"""Message for a node that was just discovered."""
GET_STATE = "lifecycle_msgs/srv/GetState"


@dataclass(slots=True)
class _Peer:
    """Latest information on one node."""

    role: str = ""
    client: Client | None = None
    asked: Future | None = None
    asked_at: float = 0.0
    life: str = ""
    level: str = ""
    sentence: str = ""
    firmware: str = ""
    received_at: float = 0.0


class NodeWatch:
    """Monitor the nodes in the namespace of ``node``.

    Create, use and close an instance only in the executor's thread.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._prefix = node.get_namespace().rstrip("/") + "/"
        self._peers: dict[str, _Peer] = {}
        self.has_arm = True
        """Whether the cell has an arm. If so, the arm's node is required."""
        self._subscription = node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, 10
        )
        self._timer = node.create_timer(1.0, self.check)

    def close(self) -> None:
        """Stop monitoring."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_subscription(self._subscription)
        for peer in self._peers.values():
            if peer.client is not None:
                self._node.destroy_client(peer.client)

    def check(self) -> None:
        """Query the life-cycle state of every node."""
        found = set()
        for service, types in self._node.get_service_names_and_types():
            name = self._own_name(service.removesuffix("/get_state"))
            if service.endswith("/get_state") and GET_STATE in types and name:
                found.add(name)
        for name in found:
            self._ask(self._peers.setdefault(name, _Peer()), name)
        for name, peer in self._peers.items():
            if name not in found:
                peer.life = ""

    def _ask(self, peer: _Peer, name: str) -> None:
        now = time.monotonic()
        if peer.client is None:
            peer.client = self._node.create_client(GetState, f"{self._prefix}{name}/get_state")
        if peer.asked is not None:
            if now - peer.asked_at < TIMEOUT_S:
                return
            peer.client.remove_pending_request(peer.asked)
            peer.life = "does not answer"
        peer.asked, peer.asked_at = peer.client.call_async(GetState.Request()), now

        def answered(future: Future) -> None:
            if peer.asked is future:
                peer.asked, peer.life = None, future.result().current_state.label

        peer.asked.add_done_callback(answered)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = self._own_name(status.name)
            if name:
                peer = self._peers.setdefault(name, _Peer())
                peer.role = _value(status, ROLE)
                peer.firmware = _value(status, "firmware")
                peer.level = LEVELS.get(status.level, "error")
                peer.sentence, peer.received_at = status.message, time.monotonic()

    def _own_name(self, name: str) -> str:
        """Return a node's name without the namespace; empty for a node of another cell."""
        if not name.startswith(self._prefix):
            return ""
        rest = name[len(self._prefix) :]
        return "" if "/" in rest else rest

    @property
    def core(self) -> tuple[str, ...]:
        """Return the required nodes of this cell, except for the camera."""
        return tuple(name for name in CORE if self.has_arm or name != ARM)

    def name_of(self, role: str) -> str:
        """Return the name of the node with this role. If several nodes have this role, prefer a
        running node; if no node has this role, return the role itself."""
        found = [(not peer.life, name) for name, peer in self._peers.items() if peer.role == role]
        return min(found)[1] if found else role

    def runs(self, role: str) -> bool:
        """Return whether a node of this role is running."""
        peer = self._peers.get(self.name_of(role))
        return peer is not None and bool(peer.life)

    @property
    def has_camera(self) -> bool:
        """Whether a node of the cell publishes images, or camera_pose receives images of another
        driver."""
        peer = self._peers.get(self.name_of(VISION))
        measuring = peer is not None and peer.life == "active" and peer.level == "ok"
        return measuring or any(self.name_of(role) in self._peers for role in CAMERAS)

    def rows(self) -> list[dict[str, str]]:
        """Return one row per node: name, role, life-cycle state, level (ok, warn, error), message
        and, for a driver that is connected, the firmware of its device."""
        cameras = [role for role in CAMERAS if self.name_of(role) in self._peers]
        if not self.has_camera:
            cameras = [CAMERAS[-1]]
        names = [self.name_of(role) for role in (*cameras, *self.core)]
        names += sorted(set(self._peers) - set(names))
        return [self._row(name) for name in names]

    def _row(self, name: str) -> dict[str, str]:
        peer = self._peers.get(name, _Peer())
        row = {"name": name, "role": peer.role or name, "life": peer.life or "not running"}
        if not peer.life:
            return {**row, "level": "error", "sentence": f"start {name}"}
        if time.monotonic() - peer.received_at > SILENCE_LIMIT_S:
            silent = NOT_YET if not peer.received_at else "has stopped sending"
            return {**row, "level": "warn", "sentence": silent}
        if peer.firmware:
            row["firmware"] = peer.firmware
        return {**row, "level": peer.level, "sentence": peer.sentence}


def _value(status: DiagnosticStatus, key: str) -> str:
    """Return a value in a node's diagnostics; empty if there is none."""
    return next((str(entry.value) for entry in status.values if entry.key == key), "")
