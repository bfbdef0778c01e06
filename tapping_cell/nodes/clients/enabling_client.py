"""Client that holds the enabling key of a simulated cell in set-up mode, as a person does on the
page. The verbs `commission` and `jog` use this client. There is no separate executable for it.
"""

from __future__ import annotations

import threading
from typing import Any

from std_msgs.msg import Bool

from tapping_cell.logic import enabling
from tapping_cell.nodes.cell_node import COMMAND
from tapping_cell.nodes.clients.client_node import ClientNode

HEARTBEAT_S = 0.05


class EnablingClient(ClientNode):
    """Hold the key while the context manager is active. On hardware a person must hold a device, so
    ``held`` is False there."""

    def __init__(self, *, held: bool, namespace: str = "") -> None:
        super().__init__("enabling_client", namespace)
        self._held = held
        self._publisher = self.node.create_publisher(Bool, enabling.TOPIC, COMMAND)
        self._over = threading.Event()
        self._heart = threading.Thread(target=self._send_heartbeats, daemon=True)

    def __enter__(self) -> EnablingClient:
        super().__enter__()
        self._heart.start()
        return self

    def __exit__(self, *error: Any) -> None:
        self._over.set()
        self._heart.join()
        super().__exit__(*error)

    def _send_heartbeats(self) -> None:
        while self._held and not self._over.wait(HEARTBEAT_S):
            self._publisher.publish(Bool(data=True))
