"""The tapper's node fires once, and only while the arm is in position for that very tap."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovariance
from harness import Bench, bench
from rclpy.duration import Duration
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import (
    ArmState,
    ErrorCode,
    ObjectState,
    PlanState,
    TapCommand,
    TapperState,
)
from tapping_cell_msgs.srv import HoldStill

from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.conversions import to_message
from tapping_cell.nodes.drivers.tapper_trigger import TapperTrigger
from tapping_cell.se2 import Pose
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.spring_drive import SpringMechanism
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine


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
        self.plan = node.create_publisher(PlanState, "plan_state", LATCHED)
        self.camera = node.create_publisher(ObjectState, "object_state", LATCHED)
        self.stop = node.create_publisher(Bool, "emergency_stop", LATCHED)
        self.clear = node.create_client(Trigger, "tapper_trigger/clear_fault")
        self.arm_holds = True
        node.create_service(HoldStill, "hold_still", self._hold_still)

    def _hold_still(
        self, request: HoldStill.Request, response: HoldStill.Response
    ) -> HoldStill.Response:
        response.granted = self.arm_holds
        response.duration = request.duration
        response.error_code = 0 if self.arm_holds else ErrorCode.TAPPER_ARM_NOT_IN_POSITION
        return response

    def ready(self) -> None:
        self.bench.wait(
            lambda: (
                self.states
                and self.states[-1].state == TapperState.SAFE
                and self.commands.get_subscription_count() == 1
                and self.arm.get_subscription_count() == 1
                and self.clear.service_is_ready()
            ),
            "the tapper is safe",
        )

    def command(self, tap_id: int, speed: float = 0.3, valid: float = 30.0) -> None:
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

    def say_until(self, condition: Callable[[], bool], what: str, **arm: object) -> None:
        """Let the arm speak until the condition holds."""
        self.bench.wait(lambda: (self.say_arm(**arm), time.sleep(0.03), condition())[2], what)  # type: ignore[arg-type]

    def fire(self, tap_id: int) -> None:
        """Command a tap, let the arm stand there, wait for the release."""
        self.command(tap_id)
        self.say_until(
            lambda: self.outcome(tap_id) == TapperState.FIRED, f"tap {tap_id} fired", tap_id=tap_id
        )

    def outcome(self, tap_id: int) -> int:
        last = self.states[-1]
        return int(last.outcome) if last.tap_id == tap_id else TapperState.NONE

    def shots(self) -> list[int]:
        return [shot for shot, _, _ in self.device.fires]


@contextmanager
def tapper_cell(
    folder: Path,
    machine: TapperMachine | None = None,
    made: list[TapperTrigger] | None = None,
) -> Iterator[Cell]:
    device = TapperEmulator(machine, now=time.monotonic())
    path = folder / "tapper"
    parameters = {"tapper_trigger": {"port": path}}
    nodes = made if made is not None else []

    def make() -> list[TapperTrigger]:
        nodes.append(TapperTrigger())
        return nodes

    with (
        PseudoTerminal(device, path) as terminal,
        bench(make, parameters) as b,
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
    cell.say_until(lambda: cell.outcome(100) == TapperState.FIRED, "fired", tap_id=100)
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
    cell.fire(100)
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
    cell.fire(101)
    assert cell.shots() == [101]


def test_it_opens_the_port_again_when_the_cable_returns(cell: Cell) -> None:
    cell.terminal.hang_up()
    cell.bench.wait(lambda: cell.states[-1].state == TapperState.DISCONNECTED, "disconnected")
    cell.terminal.plug_in()
    cell.bench.wait(lambda: cell.states[-1].state == TapperState.SAFE, "safe again")


def test_a_cable_pulled_at_the_release_leaves_an_unknown_outcome_and_a_working_node(
    cell: Cell,
) -> None:
    def release(shot: int, energy: float, now: float) -> None:
        cell.terminal.hang_up()

    cell.device.on_fire = release
    cell.command(100)
    cell.say_until(lambda: cell.outcome(100) == TapperState.UNKNOWN, "not known", tap_id=100)
    assert cell.states[-1].error_code == ErrorCode.TAPPER_OUTCOME_UNKNOWN
    cell.device.on_fire = None
    cell.terminal.plug_in()
    cell.bench.wait(lambda: cell.states[-1].state == TapperState.SAFE, "safe again")
    assert cell.outcome(100) == TapperState.UNKNOWN
    cell.fire(101)
    assert cell.shots() == [100, 101]


def test_nothing_is_fired_while_the_arm_does_not_promise_to_stand_still(cell: Cell) -> None:
    """S1: in position is not enough."""
    cell.arm_holds = False
    cell.command(100)
    cell.say_until(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired", tap_id=100)
    assert cell.states[-1].error_code == ErrorCode.TAPPER_ARM_NOT_IN_POSITION
    assert cell.shots() == []
    cell.arm_holds = True
    cell.fire(101)


@pytest.mark.parametrize(
    ("pose", "visible", "code"),
    [
        (Pose(0.0, 0.0, math.radians(40)), True, ErrorCode.OBJECT_MOVED),
        (Pose(0.004, 0.0, 0.0), True, ErrorCode.OBJECT_MOVED),
        (Pose(0.0, 0.0, 0.0), False, ErrorCode.OBJECT_NOT_SEEN),
    ],
    ids=["turned", "moved", "hidden"],
)
def test_an_object_that_is_not_where_the_tap_was_planned_is_not_struck(
    cell: Cell, pose: Pose, visible: bool, code: int
) -> None:
    """S11."""
    cell.command(100, valid=1.0)

    def say() -> bool:
        seen = ObjectState(visible=visible, pose=PoseWithCovariance(pose=to_message(pose)))
        seen.header.stamp = cell.node.get_clock().now().to_msg()
        cell.camera.publish(seen)
        cell.say_arm(100)
        time.sleep(0.03)
        return cell.outcome(100) == TapperState.NOT_FIRED

    cell.bench.wait(say, "not fired")
    assert cell.shots() == []
    words = {ErrorCode.OBJECT_MOVED: "from where the tap was planned"}
    assert words.get(code, "has not been seen") in cell.states[-1].error_msg


def test_the_state_of_a_tap_under_way_is_never_overwritten_by_a_read(tmp_path: Path) -> None:
    """S7: CHARGING was told as SAFE, and a second tap was taken."""
    with tapper_cell(tmp_path, SLOW) as cell:
        for number in range(4):
            tap_id = 100 + number
            cell.command(tap_id)
            cell.say_until(
                lambda: cell.states[-1].state == TapperState.CHARGING, "charging", tap_id=tap_id
            )
            start = len(cell.states)
            keep_saying(cell, 0.4, tap_id=tap_id)
            cell.command(200 + number)
            keep_saying(cell, 0.3, tap_id=tap_id)
            told = {(s.state, s.tap_id) for s in cell.states[start:]}
            assert told == {(TapperState.CHARGING, tap_id)}
            cell.withdraw(tap_id)
            cell.bench.wait(
                lambda tap_id=tap_id: cell.outcome(tap_id) == TapperState.NOT_FIRED, "let down"
            )
        assert cell.shots() == []


def test_an_id_that_cannot_be_refuses_no_tap_after_it(cell: Cell) -> None:
    """S9."""
    cell.command(2**64 - 1)
    cell.command(2**63)
    time.sleep(0.2)
    cell.fire(100)
    assert cell.shots() == [100]


LET_DOWN = ("DISCHARGING", "SAFE")
SLOW = TapperMachine(SpringMechanism(step_rate=100.0))
"""A spring that takes so long to charge that whoever falls silent does so in mid-draw."""


@pytest.mark.parametrize(
    "lost", ["planner", "arm", "camera", "pictures", "usable pictures"], ids=lambda name: name
)
def test_whoever_falls_silent_has_the_striker_let_down(tmp_path: Path, lost: str) -> None:
    """How soon, with processes that are killed and hung, is measured by benchmarks/disarm.py."""
    with tapper_cell(tmp_path, SLOW) as cell:

        def all_speak(but: str = "") -> None:
            now = cell.node.get_clock().now()
            if but != "planner":
                cell.plan.publish(PlanState(state=PlanState.FIRING))
            if but != "camera":
                seen = ObjectState(visible=True)
                # The node of a camera whose last picture is old, or shows nothing, still speaks.
                seen.header.stamp = (last if but == "pictures" else now).to_msg()
                if but == "usable pictures":
                    seen.error_code = ErrorCode.IMAGE_INVALID
                cell.camera.publish(seen)
            if but != "arm":
                cell.say_arm(100)

        cell.command(100)
        cell.bench.wait(
            lambda: (all_speak(), time.sleep(0.04), cell.device.state == "CHARGING")[2],
            "the draw begins",
        )
        last = cell.node.get_clock().now()
        cell.bench.wait(
            lambda: (all_speak(lost), time.sleep(0.01), cell.outcome(100) != TapperState.NONE)[2],
            "let down",
        )
        assert cell.outcome(100) == TapperState.NOT_FIRED and cell.device.state in LET_DOWN
        assert ("camera" if "pictures" in lost else lost) in cell.states[-1].error_msg
        assert cell.shots() == []


def test_nothing_is_drawn_while_the_planner_is_silent_and_goes_on_when_it_is_heard(
    cell: Cell,
) -> None:
    cell.command(100)
    cell.bench.wait(lambda: cell.states[-1].tap_id == 100, "taken")
    cell.plan.publish(PlanState(state=PlanState.PLACING))
    time.sleep(0.6)
    keep_saying(cell, 0.6, tap_id=100)
    assert cell.device.state == "UNHOMED" and cell.outcome(100) == TapperState.NONE
    cell.bench.wait(
        lambda: (
            cell.plan.publish(PlanState(state=PlanState.FIRING)),
            keep_saying(cell, 0.05, tap_id=100),
            cell.outcome(100) == TapperState.FIRED,
        )[2],
        "fired",
    )
    assert cell.shots() == [100]


def test_another_program_may_command_taps_while_the_planner_is_idle(cell: Cell) -> None:
    """The idle planner speaks only twice a second: that is no silence of a tap not its own."""
    for tap_id in (100, 101, 102):
        cell.command(tap_id)
        cell.bench.wait(
            lambda tap_id=tap_id: (
                cell.plan.publish(PlanState(state=PlanState.IDLE)),
                keep_saying(cell, 0.6, tap_id=tap_id),
                cell.outcome(tap_id) == TapperState.FIRED,
            )[2],
            "fired",
        )
    assert cell.shots() == [100, 101, 102]


def test_a_planner_that_was_restarted_does_not_fire_the_tap_of_the_one_before(cell: Cell) -> None:
    cell.command(100)
    cell.bench.wait(lambda: cell.states[-1].tap_id == 100, "taken")
    cell.plan.publish(PlanState(state=PlanState.PLACING))
    time.sleep(0.2)
    cell.plan.publish(PlanState(state=PlanState.WAITING_FOR_CELL))
    cell.bench.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "given up")
    assert "planner" in cell.states[-1].error_msg
    keep_saying(cell, 0.5, tap_id=100)
    assert cell.shots() == []


def test_a_foreign_command_changes_nothing_of_the_tap_under_way(cell: Cell) -> None:
    cell.command(100)
    cell.bench.wait(lambda: cell.states[-1].tap_id == 100, "taken")
    cell.command(999)
    cell.withdraw(999)
    time.sleep(0.3)
    assert cell.states[-1].tap_id == 100 and cell.outcome(100) == TapperState.NONE
    cell.say_until(lambda: cell.outcome(100) == TapperState.FIRED, "fired", tap_id=100)
    assert cell.shots() == [100]
    # And the next tap of the planner is taken although 999 was heard.
    cell.fire(101)
    assert cell.shots() == [100, 101]


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"request": 7}, ErrorCode.COMMAND_INVALID),
        ({"frame": "map"}, ErrorCode.COMMAND_INVALID),
        ({"speed": float("nan")}, ErrorCode.COMMAND_INVALID),
        ({"valid": 1e5}, ErrorCode.COMMAND_INVALID),
        ({"ahead": 60.0}, ErrorCode.STAMP_INVALID),
    ],
    ids=["request", "frame", "NaN", "expires in a day", "from the future"],
)
def test_a_command_that_makes_no_sense_is_refused_in_words_and_blocks_nobody(
    cell: Cell, change: dict[str, float], code: int
) -> None:
    message = TapCommand(request=int(change.get("request", TapCommand.TAP)), tap_id=100)
    message.header.frame_id = str(change.get("frame", "table"))
    message.striker_speed = float(change.get("speed", 0.3))
    now = cell.node.get_clock().now()
    message.header.stamp = (now + Duration(seconds=change.get("ahead", 0.0))).to_msg()
    message.expiry = (now + Duration(seconds=change.get("valid", 5.0))).to_msg()
    cell.commands.publish(message)
    cell.bench.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "refused")
    assert cell.states[-1].error_code == code
    assert len(cell.states[-1].error_msg) > 20
    cell.fire(101)
    assert cell.shots() == [101]


def test_deactivating_in_mid_draw_lets_the_striker_down(tmp_path: Path) -> None:
    nodes: list[TapperTrigger] = []
    with tapper_cell(tmp_path, SLOW, nodes) as cell:
        cell.command(100)
        cell.bench.wait(
            lambda: (cell.say_arm(100), time.sleep(0.04), cell.device.state == "CHARGING")[2],
            "the draw begins",
        )
        nodes[0].trigger_deactivate()
        cell.bench.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
        # Not for want of anybody's word, nor because the draw took too long.
        assert cell.states[-1].error_code == ErrorCode.NONE
        assert cell.device.state in LET_DOWN and cell.shots() == []


class Bootloader(TapperEmulator):
    """A board whose bootloader listens for a while, whenever the port is opened."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._up_at = 0.0
        super().__init__(now=time.monotonic())

    def power_cycle(self, now: float) -> None:
        super().power_cycle(now)
        self._up_at = now + self._seconds

    def receive(self, data: bytes, now: float) -> None:
        if now >= self._up_at:
            super().receive(data, now)


def test_a_board_that_starts_anew_for_seconds_when_its_port_is_opened_is_reached(
    tmp_path: Path,
) -> None:
    path = tmp_path / "tapper"
    with (
        PseudoTerminal(Bootloader(1.8), path, reset_on_open=True),
        bench(lambda: [TapperTrigger()], {"tapper_trigger": {"port": path}}) as b,
    ):
        states = b.listen(TapperState, "tapper_state", LATCHED)
        b.wait(lambda: states and states[-1].state == TapperState.SAFE, "the tapper is safe")


def test_a_stop_published_before_the_node_was_there_holds(tmp_path: Path) -> None:
    device = TapperEmulator(now=time.monotonic())
    path = tmp_path / "tapper"
    parameters = {"tapper_trigger": {"port": path, "autostart": False}}
    nodes: list[TapperTrigger] = []

    def make() -> list[TapperTrigger]:
        nodes.append(TapperTrigger())
        return nodes

    with PseudoTerminal(device, path), bench(make, parameters) as b:
        cell = Cell(b, device, None, b.listen(TapperState, "tapper_state", LATCHED))  # type: ignore[arg-type]
        cell.stop.publish(Bool(data=True))
        b.wait(lambda: nodes[0].stopped, "the stop is heard")
        nodes[0].trigger_configure()
        nodes[0].trigger_activate()
        b.wait(lambda: device.state == "STOPPED", "the board is stopped as well")
        cell.command(100)
        keep_saying(cell, 0.5, tap_id=100)
        assert cell.shots() == [] and cell.states[-1].state == TapperState.STOPPED


def test_diagnostics_tell_of_port_firmware_and_shots(cell: Cell) -> None:
    heard = cell.bench.listen(DiagnosticArray, "/diagnostics")
    cell.fire(100)

    def values() -> dict[str, str]:
        ours = [s for m in heard for s in m.status if s.name == "/tapper_trigger"]
        return {entry.key: entry.value for entry in ours[-1].values} if ours else {}

    cell.bench.wait(lambda: values().get("shots fired") == "1", "the shot is counted")
    told = values()
    assert told["port"] == str(cell.terminal.path)
    assert told["firmware"].startswith("2.")
    assert {"retries", "timeouts", "bad frames", "reconnects", "stops", "last error"} <= set(told)
