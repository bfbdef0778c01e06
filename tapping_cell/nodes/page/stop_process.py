"""Process that runs the HTTP server of the STOP button and publishes the page's ``emergency_stop``.

:class:`tapping_cell.nodes.page.stop_link.StopLink` starts this process and writes to its standard
input: first the configuration, then requests, one JSON value per line. The process writes each
change of the stop state to standard output. The process ends when its standard input is closed, so
it never outlives the page's node.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Bool

from tapping_cell.nodes import security
from tapping_cell.nodes.cell_node import LATCHED, choose_transport
from tapping_cell.nodes.page.guard import Guard
from tapping_cell.nodes.page.stop_server import (
    MAX_CONNECTIONS,
    StopLevel,
    StopServer,
    connections_within_limit,
)

NODE = "operator_page_stop"


def main() -> int:
    """Serve until standard input ends."""
    # Ignore Ctrl-C, which the terminal sends to this process and to the page's node. The node ends
    # this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger("tornado").setLevel(logging.CRITICAL)  # malformed requests are not logged
    # ROS may log to standard output, but the page's node must read only this process's reports.
    reports = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    configuration = json.loads(sys.stdin.readline())
    choose_transport(pictures=False)
    enclave = ["--ros-args", "--enclave", security.enclave_of(NODE)]
    chosen = enclave if security.is_enabled() else []
    rclpy.init(args=chosen, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(
        NODE,
        namespace=configuration["namespace"],
        enable_rosout=False,
        start_parameter_services=False,
    )
    publisher = node.create_publisher(Bool, configuration["topic"], LATCHED)
    try:
        warn = node.get_logger().warning
        asyncio.run(
            _serve(configuration, lambda held: publisher.publish(Bool(data=held)), reports, warn)
        )
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


async def _serve(
    configuration: dict[str, Any], publish: Any, output: int, warn: Callable[[str], object]
) -> None:
    loop = asyncio.get_running_loop()

    def report(held: bool, who: str) -> None:
        # A parent process that does not read may miss this change, but must not block the stop.
        try:
            os.write(output, json.dumps({"held": held, "who": who}).encode() + b"\n")
        except BlockingIOError:
            return

    os.set_blocking(output, False)
    level = StopLevel(publish, report, configuration["held"])
    connections, limit = connections_within_limit(len(os.listdir("/proc/self/fd")))
    if connections < MAX_CONNECTIONS:
        warn(
            f"the limit of {limit} open files allows only {connections} connections to STOP at once"
            f" instead of {MAX_CONNECTIONS}; raise it (ulimit -n 1024, LimitNOFILE= of systemd)"
        )
    guard, port = Guard(**configuration["guard"]), configuration["page_port"]
    server = StopServer.make(level, guard, port, connections)
    server.add_sockets([socket.socket(fileno=number) for number in configuration["sockets"]])
    report(level.held, "")  # ready
    requests = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(requests), sys.stdin)
    while line := await requests.readline():
        request = json.loads(line)
        if request["do"] == "stop":
            level.stop(request["who"])
        else:
            level.release()


if __name__ == "__main__":
    sys.exit(main())
