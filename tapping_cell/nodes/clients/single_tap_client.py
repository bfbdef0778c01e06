"""Client for single-tap experiments: makes prescribed taps and records the data of each tap.

The verb `single-tap` uses this client. There is no separate executable for it.
"""

from __future__ import annotations

import math
import queue
import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.action import ActionClient
from rclpy.serialization import deserialize_message
from tapping_cell_msgs.action import SingleTap
from tapping_cell_msgs.msg import (
    ArmState,
    ObjectStates,
    PlanState,
    TapCommand,
    TapperState,
    TapRecord,
)

from tapping_cell.calibration.trials import Track
from tapping_cell.logic.poses import covariance_from_message
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.nodes.conversions import from_message, seconds
from tapping_cell.nodes.recorder.recording import ReceivedMessage
from tapping_cell.report.bag import BagWriter
from tapping_cell.report.recorded import Quality
from tapping_cell.se2 import Pose

BEFORE_S = 1.0
AFTER_S = 0.7
"""A track of the object starts BEFORE_S before the striker is fired and ends AFTER_S after the
object has come to rest."""
KEPT_POSES = 4000
LONGEST_TAP_S = 120.0
LONGEST_AWAY_S = 3.0
"""Time (s) after which an action server that is no longer discovered is assumed to have ended.
Discovery may also lose a running server, but for a shorter time."""
LATCHED_QUALITY = Quality(1, latched=True)
RECORDED: tuple[tuple[type, str, Any, Quality], ...] = (
    (PoseWithCovarianceStamped, "object_pose", 50, Quality()),
    (ObjectStates, "object_states", 50, LATCHED_QUALITY),
    (TapCommand, "tap_command", COMMAND, Quality()),
    (ArmState, "arm_state", LATCHED, LATCHED_QUALITY),
    (TapperState, "tapper_state", LATCHED, LATCHED_QUALITY),
    (PlanState, "plan_state", LATCHED, LATCHED_QUALITY),
    (PoseStamped, "ground_truth", 50, Quality()),
)
"""Content of the bag: type, topic, QoS of the subscription, and QoS recorded in the bag."""


class NoAnswer(RuntimeError):
    """The planner did not respond. The message states the remedy."""


class SingleTapClient(GoalClient):
    """:class:`GoalClient` that also makes prescribed taps. Use as a context manager."""

    def __init__(self, name: str = "single_tap_client", namespace: str = "") -> None:
        super().__init__(name, namespace)
        self._single = ActionClient(self.node, SingleTap, "single_tap")
        self._results: queue.Queue[SingleTap.Result] = queue.Queue()
        self._poses: deque[PoseWithCovarianceStamped] = deque(maxlen=KEPT_POSES)
        self._tips: dict[int, Pose] = {}
        self._received: deque[ReceivedMessage] = deque()
        self.phase = ""
        for kind, topic, profile, _ in RECORDED:
            self.node.create_subscription(kind, topic, self._keeper(kind, topic), profile, raw=True)

    def missing(self) -> list[str]:
        """Return the conditions that still prevent the cell from making a tap, as text; empty when
        the cell is ready."""
        reasons = super().missing()
        if not reasons and not self._single.server_is_ready():
            reasons.append("the planner does not serve single_tap: its version is too old")
        return reasons

    @property
    def simulated(self) -> bool:
        """Return whether the taps are made in a simulated world."""
        return bool(self.node.count_publishers("ground_truth") > 0)

    def camera_rate(self, duration: float, check: Callable[[], None]) -> float:
        """Measure the number of poses per second for ``duration`` s; NaN if no pose arrives."""
        self._poses.clear()
        end = time.monotonic() + duration
        while time.monotonic() < end:
            check()
            time.sleep(0.05)
        return rate_of([seconds(pose.header.stamp) for pose in list(self._poses)])

    def tap(
        self,
        striker_speed: float,
        incidence: float,
        direction: float,
        slack: float,
        check: Callable[[], None],
    ) -> SingleTap.Result:
        """Make one tap and wait for its result. SI units, ``direction`` and ``slack`` in rad.

        While the tap is in progress, ``check`` is called every 0.1 s. The tap is cancelled if
        ``check`` raises an exception, or on a KeyboardInterrupt.

        Raises:
            NoAnswer: the planner did not end the tap in time, or its action server disappeared.
        """
        message = SingleTap.Goal(
            striker_speed=striker_speed, incidence=incidence, direction=direction, slack=slack
        )
        return self._make(message, check)

    def fire_at_nothing(self, check: Callable[[], None]) -> SingleTap.Result:
        """Fire once, away from every object, and wait for the result. As :meth:`tap`."""
        return self._make(SingleTap.Goal(at_nothing=True), check)

    def _make(self, message: SingleTap.Goal, check: Callable[[], None]) -> SingleTap.Result:
        self._send_later(self._send_tap, message)
        begun = there = time.monotonic()
        try:
            while (now := time.monotonic()) < min(begun + LONGEST_TAP_S, there + LONGEST_AWAY_S):
                try:
                    return self._results.get(timeout=0.1)
                except queue.Empty:
                    check()
                if self._single.server_is_ready():
                    there = now
        except BaseException:
            self.cancel()
            raise
        self.cancel()
        raise NoAnswer(
            f"the planner did not end the tap within {LONGEST_TAP_S:.0f} s, or disappeared; "
            "check the node tap_planner, then continue with --resume"
        )

    def track_of(self, record: TapRecord) -> Track | None:
        """Return the object's poses around a tap, one for each image; None if there are none."""
        fired, rest = seconds(record.fired_at), seconds(record.at_rest_at)
        until = rest + AFTER_S if rest > 0 else math.inf
        rows: list[tuple[float, ...]] = []
        for message in list(self._poses):
            stamp = seconds(message.header.stamp)
            if not fired - BEFORE_S <= stamp <= until or (rows and stamp <= rows[-1][0]):
                continue
            pose = from_message(message.pose.pose)
            spread = covariance_from_message(message.pose.covariance)
            rows.append(
                (
                    stamp,
                    *pose,
                    math.sqrt(max(spread[0, 0] + spread[1, 1], 0.0) / 2),
                    math.sqrt(max(spread[2, 2], 0.0)),
                )
            )
        if len(rows) < 2:
            return None
        table = np.array(rows)
        return Track(table[:, 0] - table[0, 0], *table[:, 1:].T)

    def tip_of(self, tap_id: int) -> Pose | None:
        """Return the measured pose of the striker tip for a tap; None if the arm did not publish
        it."""
        return self._tips.get(tap_id)

    def begin_bag(self, bag: BagWriter) -> None:
        """Register the topics in a bag."""
        for kind, topic, _, quality in RECORDED:
            name = kind.__module__.split(".")[0] + "/msg/" + kind.__name__
            bag.add_topic(self.node.resolve_topic_name(topic), name, quality)

    def write_bag(self, bag: BagWriter) -> None:
        """Write the messages received since the last call as one chunk.

        Raises:
            OSError: the disk is full or not available.
        """
        while self._received:
            message = self._received.popleft()
            bag.write(message.topic, message.stamp, message.data)
        bag.flush()

    def _keeper(self, kind: type, topic: str) -> Callable[[bytes], None]:
        name = self.node.resolve_topic_name(topic)

        def keep(data: bytes) -> None:
            self._received.append(
                ReceivedMessage(name, self.node.get_clock().now().nanoseconds, data)
            )
            if kind is PoseWithCovarianceStamped:
                self._poses.append(deserialize_message(data, kind))

        return keep

    def _on_arm_state(self, message: ArmState) -> None:
        super()._on_arm_state(message)
        if message.state == ArmState.IN_POSITION:
            self._tips[int(message.tap_id)] = from_message(message.tip_pose)

    def _send_tap(self, message: SingleTap.Goal) -> None:
        future = self._single.send_goal_async(message)
        future.add_done_callback(self._on_tap_response)

    def _on_tap_response(self, future: Any) -> None:
        self._handle = handle = future.result()
        handle.get_result_async().add_done_callback(
            lambda done: self._results.put(done.result().result)
        )


def rate_of(stamps: list[float]) -> float:
    """Return the frame rate in Hz from the frame times in s. The rate is computed from the 20 %
    quantile of the intervals, so that the long intervals due to lost frames have no effect."""
    steps = [after - before for before, after in pairwise(stamps) if after > before]
    return 1.0 / float(np.quantile(steps, 0.2)) if steps else math.nan
