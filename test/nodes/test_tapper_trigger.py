"""The tapper's node fires once, and only while the arm is in position for that very tap."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from harness import Bench, bench
from rclpy.duration import Duration
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState, ErrorCode, TapCommand, TapperState

from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.tapper_trigger import TapperTrigger
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.tapper_emulator import TapperEmulator


@dataclass
class Cell:
    """The node, its emulated device, and hands to play planner and arm."""

    bench: Bench
    device: TapperEmulator
    terminal: PseudoTerminal
    states: list[TapperState]

    def __post_init__(self) -> None:
        node = self.bench.probe
        assert node is not None
        self.node = node
        self.commands = node.create_publisher(TapCommand, "tap_command", COMMAND)
        self.arm = node.create_publisher(ArmState, "arm_state", LATCHED)
        self.stop = node.create_publisher(Bool, "emergency_stop", LATCHED)
        self.clear = node.create_client(Trigger, "tapper_trigger/clear_fault")

    def ready(self) -> None:
        self.bench.wait(
            lambda: (
                self.states
                and self.states[-1].state == TapperState.SAFE
                and self.commands.get_subscription_count() == 1
                and self.arm.get_subscription_count() == 1
            ),
            "the tapper is safe",
        )

    def command(self, tap_id: int, speed: float = 0.3, valid: float = 5.0) -> None:
        message = TapCommand(request=TapCommand.TAP, tap_id=tap_id, striker_speed=speed)
        message.header.frame_id = "table"
        message.expiry = (self.node.get_clock().now() + Duration(seconds=valid)).to_msg()
        self.commands.publish(message)

    def withdraw(self, tap_id: int) -> None:
        self.commands.publish(TapCommand(request=TapCommand.WITHDRAW, tap_id=tap_id))

    def say_arm(self, tap_id: int, state: int = ArmState.IN_POSITION, age: float = 0.0) -> None:
        message = ArmState(state=state, tap_id=tap_id, homed=True)
        message.header.stamp = (self.node.get_clock().now() - Duration(seconds=age)).to_msg()
        self.arm.publish(message)

    def outcome(self, tap_id: int) -> int:
        last = self.states[-1]
        return int(last.outcome) if last.tap_id == tap_id else TapperState.NONE

    def shots(self) -> list[int]:
        return [shot for shot, _, _ in self.device.fires]


@contextmanager
def tapper_cell(folder: Path) -> Iterator[Cell]:
    device = TapperEmulator(now=time.monotonic())
    path = folder / "tapper"
    parameters = {"tapper_trigger": {"port": path}}
    with (
        PseudoTerminal(device, path) as terminal,
        bench(lambda: [TapperTrigger()], parameters) as b,
    ):
        cell = Cell(b, device, terminal, b.listen(TapperState, "tapper_state", LATCHED))
        cell.ready()
        yield cell


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    with tapper_cell(tmp_path) as made:
        yield made


def keep_saying(cell: Cell, seconds: float, **arm: object) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        cell.say_arm(**arm)  # type: ignore[arg-type]
        time.sleep(0.05)


def test_it_fires_once_when_the_arm_is_in_position(cell: Cell) -> None:
    cell.command(100)
    time.sleep(0.2)
    assert cell.shots() == []
    keep_saying(cell, 1.0, tap_id=100)
    cell.bench.wait(lambda: cell.outcome(100) == TapperState.FIRED, "fired")
    assert cell.shots() == [100]
    # The same command again, and the arm still in position: answered, not fired.
    cell.command(100)
    keep_saying(cell, 0.5, tap_id=100)
    assert cell.shots() == [100]


@pytest.mark.parametrize(
    "arm",
    [
        {"tap_id": 99},
        {"tap_id": 100, "state": ArmState.MOVING},
        {"tap_id": 100, "state": ArmState.FAULT},
        {"tap_id": 100, "age": 2.0},
        {"tap_id": 100, "age": -2.0},
    ],
    ids=["another tap", "moving", "faulted", "stale", "from the future"],
)
def test_it_does_not_fire_on_doubt(cell: Cell, arm: dict[str, object]) -> None:
    cell.command(100, valid=1.0)
    keep_saying(cell, 1.2, **arm)
    cell.bench.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
    assert cell.shots() == []
    assert cell.states[-1].error_code == ErrorCode.TAPPER_COMMAND_EXPIRED


def test_a_withdrawn_tap_is_not_fired_later(cell: Cell) -> None:
    cell.command(100)
    cell.withdraw(100)
    cell.bench.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
    keep_saying(cell, 0.5, tap_id=100)
    assert cell.shots() == []


def test_a_tap_older_than_one_served_is_refused(cell: Cell) -> None:
    cell.command(100)
    keep_saying(cell, 0.8, tap_id=100)
    cell.bench.wait(lambda: cell.outcome(100) == TapperState.FIRED, "fired")
    cell.command(50)
    keep_saying(cell, 0.8, tap_id=50)
    assert cell.shots() == [100]


def test_an_expired_command_is_refused(cell: Cell) -> None:
    cell.command(100, valid=-1.0)
    cell.bench.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
    assert cell.states[-1].error_code == ErrorCode.TAPPER_COMMAND_EXPIRED


def test_a_speed_beyond_the_curve_is_refused_with_its_range(cell: Cell) -> None:
    cell.command(100, speed=9.0)
    cell.bench.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
    assert cell.states[-1].error_code == ErrorCode.TAPPER_SPEED_OUT_OF_RANGE
    assert "9000.0 mm/s" in cell.states[-1].error_msg
    assert "2500.0 mm/s" in cell.states[-1].error_msg


def test_an_emergency_stop_latches_until_a_person_clears_it(cell: Cell) -> None:
    cell.command(100)
    cell.stop.publish(Bool(data=True))
    cell.bench.wait(lambda: cell.states[-1].state == TapperState.STOPPED, "stopped")
    cell.stop.publish(Bool(data=False))
    keep_saying(cell, 0.5, tap_id=100)
    assert cell.shots() == []
    assert cell.states[-1].state == TapperState.STOPPED
    with cell.terminal.lock:
        cell.device.press_clear_button(time.monotonic())
    cell.clear.call_async(Trigger.Request())
    cell.bench.wait(lambda: cell.states[-1].state == TapperState.SAFE, "safe again")
    cell.command(101)
    keep_saying(cell, 0.8, tap_id=101)
    assert cell.shots() == [101]


def test_it_opens_the_port_again_when_the_cable_returns(cell: Cell) -> None:
    cell.terminal.hang_up()
    cell.bench.wait(lambda: cell.states[-1].state == TapperState.DISCONNECTED, "disconnected")
    cell.terminal.plug_in()
    cell.bench.wait(lambda: cell.states[-1].state == TapperState.SAFE, "safe again", 4.0)
