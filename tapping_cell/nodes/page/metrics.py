"""Numbers of the cell for Prometheus, at the address ``/metrics`` of the page."""

from __future__ import annotations

import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from tapping_cell_msgs.msg import GoalReport, PlanState

from tapping_cell.nodes.conversions import seconds
from tapping_cell.nodes.page.node_watch import LEVELS

ABSENT = (
    "the package prometheus_client is not installed: pip install prometheus_client, then restart "
    "the page"
)
LATE_S = 5.0
"""Age of a report from which it belongs to an earlier run of this node: the topic is latched."""
OUTCOMES = {
    PlanState.REACHED: "reached",
    PlanState.FAILED: "failed",
    PlanState.CANCELED: "canceled",
}
MOST_SERIES = 500
"""Maximum number of values of nodes. Any program may publish on /diagnostics."""


class Metrics:
    """Counters of goals, taps and errors, and the numbers in the diagnostics of this cell's nodes.

    Raises:
        ImportError: prometheus_client is not installed.
    """

    def __init__(self, node: Node) -> None:
        import prometheus_client as client

        self._text = client.generate_latest
        self.content_type: str = client.CONTENT_TYPE_LATEST
        self._registry = own = client.CollectorRegistry()
        self._node = node
        self._prefix = node.get_namespace().rstrip("/") + "/"

        def name(words: str) -> str:
            return f"tapping_cell_{words}"

        self._goals = client.Counter(name("goals"), "Goals ended", ["outcome"], registry=own)
        self._taps = client.Counter(name("taps"), "Taps fired for goals", registry=own)
        self._errors = client.Counter(
            name("goal_errors"), "Goals ended with an error code", ["code"], registry=own
        )
        self._distance = client.Histogram(
            name("residual_mm"),
            "Measured residual of goals, mm",
            buckets=(0.1, 0.2, 0.3, 0.5, 1, 2, 5),
            registry=own,
        )
        self._rotation = client.Histogram(
            name("residual_degrees"),
            "Measured residual of goals, degrees",
            buckets=(0.1, 0.2, 0.5, 1, 2, 5),
            registry=own,
        )
        self._level = client.Gauge(
            name("node_level"), "0: ok, 1: warning, 2: error, 3: stale", ["node"], registry=own
        )
        self._seen = client.Gauge(
            name("node_last_report_seconds"), "Time of the last report", ["node"], registry=own
        )
        self._value = client.Gauge(
            name("node_value"), "Numbers in /diagnostics", ["node", "key"], registry=own
        )
        self._series: set[tuple[str, str]] = set()
        node.create_subscription(DiagnosticArray, "/diagnostics", self.on_diagnostics, 10)

    def text(self) -> bytes:
        """Return all numbers in the text format of Prometheus. May be called from any thread."""
        found: bytes = self._text(self._registry)
        return found

    def on_report(self, report: GoalReport) -> None:
        """Count a goal."""
        now = 1e-9 * self._node.get_clock().now().nanoseconds
        if now - seconds(report.header.stamp) > LATE_S:
            return
        outcome = "refused" if report.refused else OUTCOMES.get(report.state, "other")
        self._goals.labels(outcome).inc()
        self._taps.inc(report.taps)
        if report.error_code:
            self._errors.labels(str(report.error_code)).inc()
        if math.isfinite(report.residual_distance) and not report.refused:
            self._distance.observe(1000 * report.residual_distance)
        if math.isfinite(report.residual_rotation) and not report.refused:
            self._rotation.observe(math.degrees(abs(report.residual_rotation)))

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """Store the level and the numbers of each node of this cell."""
        for status in message.status:
            if not status.name.startswith(self._prefix) or status.level not in LEVELS:
                continue
            node = status.name[len(self._prefix) :]
            if "/" in node:  # of another cell, whose namespace begins with this one
                continue
            if self._is_counted(node, ""):
                self._level.labels(node).set(status.level[0])
                self._seen.labels(node).set(time.time())
            for entry in status.values:
                number = _number(entry.value)
                if number is not None and self._is_counted(node, entry.key):
                    self._value.labels(node, entry.key).set(number)

    def _is_counted(self, node: str, key: str) -> bool:
        if len(self._series) < MOST_SERIES:
            self._series.add((node, key))
        return (node, key) in self._series


def make_metrics(node: Node) -> Metrics | None:
    """Return the numbers of the cell; None if the library is not installed."""
    try:
        return Metrics(node)
    except ImportError:
        return None


def _number(text: Any) -> float | None:
    try:
        number = float(text)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None
