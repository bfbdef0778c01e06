"""A robot's driver with a digital output, a guard input and a read-back."""

from __future__ import annotations

import threading
import time

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Bool, Float64, Float64MultiArray
from std_srvs.srv import SetBool

RATE = 20.0


class RosOutput(Node):
    """Node that offers `/robot/set_output` as a service or a topic (`interface`) and spins in its
    own thread."""

    def __init__(self, interface: str = "service", reads_back: bool = True) -> None:
        super().__init__("robot_io", use_global_arguments=False)
        self.guard_closed = True
        self.silent = False
        self.level = False
        self.edges: list[tuple[float, bool]] = []
        name = "/robot/set_output"
        if interface == "service":
            self.create_service(SetBool, name, self._serve)
        elif interface == "topic":
            self.create_subscription(Bool, name, lambda m: self.set_level(m.data), 10)
        elif interface == "commands":
            self.create_subscription(
                Float64MultiArray, name, lambda m: self.set_level(m.data[0] > 0.5), 10
            )
        else:
            self.create_subscription(Float64, name, self._pulse, 10)
        self._guard = self.create_publisher(Bool, "/robot/guard_closed", 10)
        self._read_back = (
            self.create_publisher(Bool, "/robot/output_is_on", 10) if reads_back else None
        )
        self.create_timer(1 / RATE, self._publish)
        self._executor_here = SingleThreadedExecutor()
        self._executor_here.add_node(self)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._spin_here, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Destroy the node, as if the robot were switched off."""
        self._ended.set()
        self._executor_here.wake()
        self._thread.join(5.0)
        self._executor_here.shutdown()
        self.destroy_node()

    def set_level(self, level: bool) -> None:
        """Switch the output."""
        if level != self.level:
            self.level = level
            self.edges.append((time.monotonic(), level))
            self._publish()

    def pulses(self) -> list[float]:
        """Return the lengths of the pulses so far, in s."""
        ons = [at for at, level in self.edges if level]
        offs = [at for at, level in self.edges if not level]
        return [off - on for on, off in zip(ons, offs, strict=False)]

    def _serve(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.set_level(request.data)
        response.success = True
        return response

    def _pulse(self, message: Float64) -> None:
        if message.data > 0:
            self.set_level(True)
            time.sleep(message.data)
        self.set_level(False)

    def _spin_here(self) -> None:
        while not self._ended.is_set():
            self._executor_here.spin_once(timeout_sec=0.2)

    def _publish(self) -> None:
        if self.silent:
            return
        self._guard.publish(Bool(data=self.guard_closed))
        if self._read_back is not None:
            self._read_back.publish(Bool(data=self.level))
