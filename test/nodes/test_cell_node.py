"""Common base of the nodes: unexpected exceptions of a transition, and parameters set at once."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from std_msgs.msg import Bool

from tapping_cell.configuration.schema import text
from tapping_cell.nodes.cell_node import LATCHED, CellNode, run

pytestmark = pytest.mark.usefixtures("own_signals")


@dataclass(frozen=True, slots=True)
class Settings:
    """Parameters of the node under test."""

    autostart: bool = text("configure and activate automatically", default=True)
    frame_prefix: str = text("prefix of frames", default="")
    method: str = text("method", default="a")
    ask: bool = text("ask", default=True)


class Defective(CellNode[Settings]):
    """Node whose transition has a defect."""

    changeable = ("method", "ask")
    transition = "configure"
    changed: list[tuple[str, object]]

    def __init__(self) -> None:
        super().__init__("defective", Settings)
        self.changed = []

    def configure(self) -> None:
        if self.transition == "configure":
            raise RuntimeError("the home folder is not known")

    def activate(self) -> None:
        if self.transition == "activate":
            raise RuntimeError("the home folder is not known")

    def change(self, name: str, value: object) -> None:
        if value == "unknown":
            raise ValueError("no such method")
        self.changed.append((name, value))


class Answering(CellNode[Settings]):
    """Node that is ended by a signal, and whose last result is sent by a task of the executor."""

    sent: list[str]

    def __init__(self) -> None:
        super().__init__("answering", Settings)
        self.create_timer(0.2, self._end)

    def _end(self) -> None:
        if self.active:
            os.kill(os.getpid(), signal.SIGTERM)

    def cleanup(self) -> None:
        if self.executor is not None and self.active:
            self.executor.create_task(lambda: self.sent.append("result"))

    def has_unsent_results(self) -> bool:
        return not self.sent


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[Defective]:
    monkeypatch.setattr(Defective, "transition", "")
    rclpy.init(args=["--ros-args", "-p", "autostart:=false"])
    made = Defective()
    yield made
    made.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.parametrize("transition", ["configure", "activate"])
def test_an_unexpected_exception_of_a_transition_ends_the_node_with_its_reason(
    transition: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Defective, "transition", transition)
    assert run(Defective, []) == 1
    printed = capfd.readouterr().err
    assert "Traceback" in printed and "the home folder is not known" in printed
    assert "report it with the log" in printed


def test_nothing_is_applied_if_one_of_several_parameters_is_refused(node: Defective) -> None:
    ask, unknown = Parameter("ask", value=False), Parameter("method", value="unknown")
    result = node.set_parameters_atomically([ask, unknown])
    assert (result.successful, result.reason) == (False, "no such method")
    assert node.changed == [] and node.get_parameter("ask").value is True
    known = Parameter("method", value="b")
    assert node.set_parameters_atomically([ask, known]).successful
    assert node.changed == [("method", "b"), ("ask", False)]


def test_a_node_that_is_ended_by_a_signal_sends_its_last_results(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Answering, "sent", [], raising=False)
    assert run(Answering, []) == 0
    assert Answering.sent == ["result"]


def test_parameters_override_the_quality_of_service_of_states() -> None:
    stem = "qos_overrides./states.publisher"
    arguments = ["--ros-args", "-p", f"{stem}.depth:=7", "-p", f"{stem}.reliability:=best_effort"]
    rclpy.init(args=arguments)
    try:
        node = CellNode("defective", Settings)
        changed = node.create_publisher(Bool, "states", LATCHED).qos_profile
        assert (changed.depth, changed.reliability) == (7, ReliabilityPolicy.BEST_EFFORT)
        assert changed.durability == LATCHED.durability
        # Other topics keep the common profile.
        assert node.create_publisher(Bool, "others", LATCHED).qos_profile.depth == LATCHED.depth
        node.destroy_node()
    finally:
        rclpy.shutdown()
