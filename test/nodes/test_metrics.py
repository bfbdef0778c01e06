"""``/metrics`` of the page serves what Prometheus reads."""

from __future__ import annotations

import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from harness import Bench, bench
from tapping_cell_msgs.msg import GoalReport, PlanState

from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.page import metrics
from tapping_cell.nodes.page.operator_page import OperatorPage

PARAMETERS = {"operator_page": {"port": 0, "stop_port": 0, "token": "secret"}}


@pytest.fixture
def served() -> Iterator[tuple[Bench, str]]:
    made: list[OperatorPage] = []

    def make() -> list[OperatorPage]:
        made.append(OperatorPage())
        return list(made)

    with bench(make, PARAMETERS) as one:
        one.wait(lambda: made[0].urls, "the page is served")
        yield one, made[0].urls[0].partition("#")[0] + "metrics"


def read(url: str, token: str = "secret") -> str:
    asked = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"})
    with urllib.request.urlopen(asked, timeout=10) as answer:
        return str(answer.read().decode())


def test_goals_and_diagnostics_are_counted(served: tuple[Bench, str]) -> None:
    parser = pytest.importorskip("prometheus_client.parser")
    made, url = served
    with pytest.raises(urllib.error.HTTPError, match="401"):
        read(url, "wrong")
    assert made.probe is not None
    reports = made.probe.create_publisher(GoalReport, "goal_report", LATCHED)
    diagnostics = made.probe.create_publisher(DiagnosticArray, "/diagnostics", 10)
    made.wait(lambda: reports.get_subscription_count() == 1, "the page listens")
    report = GoalReport(state=PlanState.REACHED, taps=3, residual_distance=0.00025)
    report.header.stamp = made.probe.get_clock().now().to_msg()
    reports.publish(report)
    time.sleep(0.5)  # the topic keeps one message
    late = GoalReport(state=PlanState.FAILED, taps=9, error_code=103)
    reports.publish(late)  # its stamp is that of 1970
    values = [KeyValue(key="rate", value="29.5"), KeyValue(key="port", value="/dev/x")]
    own = DiagnosticStatus(name="/scara_arm", level=DiagnosticStatus.WARN, values=values)
    other = DiagnosticStatus(name="/left/scara_arm", level=DiagnosticStatus.OK, values=values)
    bad = DiagnosticStatus(name="/x", level=b"\x07")

    def found() -> dict[tuple[str, ...], float]:
        diagnostics.publish(DiagnosticArray(status=[own, other, bad]))
        time.sleep(0.1)
        return {
            (sample.name, *(sample.labels[key] for key in sorted(sample.labels))): sample.value
            for family in parser.text_string_to_metric_families(read(url))
            for sample in family.samples
        }

    made.wait(lambda: ("tapping_cell_node_value", "rate", "scara_arm") in found(), "it is counted")
    numbers = found()
    assert numbers["tapping_cell_goals_total", "reached"] == 1
    assert numbers["tapping_cell_taps_total",] == 3
    assert numbers["tapping_cell_residual_mm_sum",] == pytest.approx(0.25)
    assert numbers["tapping_cell_node_value", "rate", "scara_arm"] == 29.5
    assert numbers["tapping_cell_node_level", "scara_arm"] == 1
    assert not [key for key in numbers if {"103", "left/scara_arm", "x"} & {*key}]


def test_without_the_library_the_answer_names_it(
    served: tuple[Bench, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(urllib.error.HTTPError, match="501") as raised:
        read(served[1])
    assert metrics.ABSENT in raised.value.read().decode()
