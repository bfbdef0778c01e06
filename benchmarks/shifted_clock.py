"""Run a module with its ROS time shifted, as on a computer whose clock is wrong.

python -m benchmarks.shifted_clock SECONDS MODULE [argument ...]
"""

from __future__ import annotations

import runpy
import sys

from rclpy.clock import Clock
from rclpy.duration import Duration
from rclpy.time import Time


def shift(seconds: float) -> None:
    """Shift every clock of this process except the steady clocks."""
    true_now = Clock.now

    def now(self: Clock) -> Time:
        time = true_now(self)
        if self.clock_type.name == "STEADY_TIME":
            return time
        return time + Duration(seconds=seconds)

    Clock.now = now  # type: ignore[method-assign]


if __name__ == "__main__":
    shift(float(sys.argv[1]))
    module = sys.argv[2]
    sys.argv = sys.argv[2:]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
