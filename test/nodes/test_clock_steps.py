"""A node's timers keep running when its clock is set back, and its time source cannot be changed
while it runs."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from harness import bench
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from tapping_cell_msgs.msg import TapperState

from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.drivers.tapper_trigger import TapperTrigger
from tapping_cell.nodes.recorder.run_recorder import RunRecorder
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.tapper_emulator import TapperEmulator

START = Time(seconds=1_800_000_000)


def test_timers_continue_when_the_clock_is_set_back_and_it_cannot_be_replaced(
    tmp_path: Path,
) -> None:
    device = TapperEmulator(now=time.monotonic())
    given = {"port": tmp_path / "tapper", "use_sim_time": True}
    with (
        PseudoTerminal(device, tmp_path / "tapper"),
        bench(lambda: [TapperTrigger()], {"tapper_trigger": given}) as b,
    ):
        node = b.probe
        assert node is not None
        clock = node.create_publisher(Clock, "/clock", 10)
        states: list[TapperState] = b.listen(TapperState, "tapper_state", LATCHED)
        setter = node.create_client(SetParameters, "tapper_trigger/set_parameters")
        health: list[DiagnosticArray] = b.listen(DiagnosticArray, "/diagnostics", 10)
        b.wait(lambda: clock.get_subscription_count(), "the node takes the time from /clock")

        def said(words: str) -> bool:
            return any(words in status.message for each in health for status in each.status)

        b.wait(lambda: said("waits for a time on /clock"), "the node says what it waits for")
        assert not any(state.state == TapperState.SAFE for state in states)

        def stamped(at: Time) -> bool:
            clock.publish(Clock(clock=at.to_msg()))
            return bool(states) and states[-1].header.stamp == at.to_msg()

        b.wait(lambda: stamped(START), "the node takes this time")
        back = START - Duration(seconds=3600)
        b.wait(lambda: stamped(back), "the node takes the earlier time")
        b.wait(lambda: states[-1].state == TapperState.SAFE, "the tapper is safe")
        # /clock is not published meanwhile, so a timer that used the node's clock would not fire.
        before = len(states)
        b.wait(lambda: len(states) >= before + 5, "timers go on")
        b.wait(lambda: said("/clock has stood still"), "the node names the clock")

        real = Parameter("use_sim_time", value=False).to_parameter_msg()
        answer = setter.call_async(SetParameters.Request(parameters=[real]))
        b.wait(answer.done, "set_parameters answers")
        (result,) = answer.result().results
        assert not result.successful and "restart the node" in result.reason
        assert stamped(back)


def test_a_recorder_without_a_clock_says_once_what_it_waits_for(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    given = {"folder": tmp_path, "use_sim_time": True}
    with bench(lambda: [RunRecorder()], {"run_recorder": given}) as b:
        health: list[DiagnosticArray] = b.listen(DiagnosticArray, "/diagnostics", 10)
        b.wait(lambda: len(health) >= 4, "the node has tried several times")
        assert "waits for a time on /clock" in health[-1].status[0].message
    assert capfd.readouterr().err.count("waits for a time on /clock") == 1
