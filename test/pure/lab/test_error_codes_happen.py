"""Error codes provoked in the simulated cell, in virtual time.

Each scenario ends with a code in a published state or in a goal's result, and checks that the
message names the cause. ``test_every_error_code_is_used_in_a_test`` finds codes without a test.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from wrong_baud import WrongBaud

from lab.trial import Trial
from lab.virtual_cell.serial_line import SerialLine
from tapping_cell.cli.errors import print_refusal
from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.hardware.tapper import TapperDriver
from tapping_cell.hardware.tapper_boards import TapperBoards, cell_channel
from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.error_codes import of_tapper
from tapping_cell.logic.poses import to_message
from tapping_cell.messages import (
    ErrorCode,
    PoseStamped,
    PositionObject,
    TapCommand,
    TapperState,
)
from tapping_cell.planning import UnknownPlannerError, make_planner
from tapping_cell.se2 import Pose
from tapping_cell.simulation.fault_layer import Direction, FaultKind, FaultLayer, LineFault
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine
from tapping_cell.simulation.virtual_line import VirtualClock, VirtualTransport

START, GOAL = Pose(0.0, 0.0, 0.0), Pose(0.04, -0.02, 0.3)
TESTS = Path(__file__).resolve().parents[2]
LONG_S = 90.0


class SwappedPorts(Trial):
    """A cell in which each driver opens the port of the other board."""

    def _lines(self) -> tuple[SerialLine, ...]:
        return self.physical.tapper_line, self.physical.arm_line


class HighTravel(Trial):
    """A cell whose arm cannot raise its quill to the travel height."""

    def _make_cell(self, seed: int) -> Cell:
        cell = super()._make_cell(seed)
        return replace(cell, file=replace(cell.file, arm=replace(cell.arm, travel_height=0.2)))


class ReportedCell:
    """A cell without injected faults that collects the error codes reported by its nodes, with
    their messages."""

    def __init__(self, kind: type[Trial] = Trial) -> None:
        self.trial = kind(seed=21, faults=False)
        self.codes: dict[int, str] = {}
        self.states: dict[str, Any] = {}
        for topic in ("arm_state", "tapper_state", "plan_state"):
            self.trial.network.subscribe("test", topic, partial(self._receive, topic))

    def _receive(self, topic: str, _: str, message: Any) -> None:
        self.states[topic] = message
        self._take(message)

    def _take(self, message: Any) -> None:
        if message.error_code:
            self.codes.setdefault(message.error_code, message.error_msg)

    def ready(self) -> None:
        """Start the cell, and discard the reports from before it was ready."""
        self.trial.bring_up()
        self.trial.physical.world.place(START)
        self.run(2.0)
        self.codes.clear()

    def run(self, duration: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let virtual time pass until the condition is met; return whether it was met in time."""
        self.trial.scheduler.run(self.trial.scheduler.now + duration, until)
        return until()

    def read(self, code: int, *words: str) -> None:
        """Wait until a state or a result has this code, and check that its message contains the
        words."""
        assert self.run(LONG_S, lambda: code in self.codes), f"{code} missing from {self.codes}"
        for word in words:
            assert word in self.codes[code], self.codes[code]

    def goal(self, goal: Pose = GOAL, **fields: Any) -> None:
        """Send a goal to the action."""
        request = PositionObject.Goal(goal_pose=PoseStamped(pose=to_message(goal)), **fields)
        request.goal_pose.header.frame_id = "table"
        planner = self.trial.processes["tap_planner"]
        planner.request("position_object", request, object(), self._take)

    def tap(self, number: int, expires_in: float = 10.0) -> TapCommand:
        """Return a tap command of another program, with the striker behind the object; ``number``
        distinguishes its id."""
        now = self.trial.clocks["tap_planner"].now().ros
        command = TapCommand(request=TapCommand.TAP, tap_id=now // 10**9 + number)
        command.header.frame_id = "table"
        command.header.stamp = to_stamp(now)
        command.expiry = to_stamp(now + round(1e9 * expires_in))
        command.striker_speed = 0.4
        strike = Pose(-0.07, 0.0, 0.0)
        command.strike_pose = to_message(strike, self.trial.cell.arm.strike_height)
        command.object_pose = command.predicted_pose = to_message(START)
        return command

    def send(self, command: TapCommand, only: str = "") -> None:
        """Publish a command to all nodes, or to one only."""
        self.trial.network.publish("program", "tap_command", command, only=only)

    def break_line(self, name: str, kind: FaultKind, length: int = 1, lasting: float = 0.0) -> None:
        """Disturb the next bytes that a board sends."""
        layer = getattr(self.trial.physical, f"{name}_line").layer
        way = Direction.TO_HOST
        layer.add(LineFault(kind, way, layer.count(way), length, lasting))


@pytest.fixture
def cell() -> ReportedCell:
    return ReportedCell()


@pytest.fixture
def ready_cell(cell: ReportedCell) -> ReportedCell:
    cell.ready()
    return cell


# The boards and their lines.


def test_swapped_ports_are_reported_by_both_drivers() -> None:
    cell = ReportedCell(SwappedPorts)
    cell.trial.start()
    cell.read(ErrorCode.ARM_FIRMWARE_UNKNOWN, "answers like", "check the port")
    cell.read(ErrorCode.TAPPER_FIRMWARE_UNKNOWN, "answers like the tapper", "check the port")


def test_an_arm_at_another_baud_rate_is_unreadable(cell: ReportedCell) -> None:
    layer = cell.trial.physical.arm_line.layer
    layer.emulator = WrongBaud(layer.emulator, 115200, 250000)
    cell.trial.start()
    cell.run(4.0)
    # After the interruption, the emulated board sends its greeting, which is unreadable at the
    # wrong baud rate. Most real boards restart and send it when the port is opened.
    cell.trial.interrupt_arm_power()
    cell.read(ErrorCode.ARM_REPLY_GARBLED, "not text", "check arm.baud")


@pytest.mark.parametrize(
    ("name", "code"),
    [("arm", ErrorCode.ARM_REPLY_GARBLED), ("tapper", ErrorCode.TAPPER_REPLY_GARBLED)],
)
def test_interference_on_the_line_makes_replies_unreadable(
    ready_cell: ReportedCell, name: str, code: int
) -> None:
    layer, way = getattr(ready_cell.trial.physical, f"{name}_line").layer, Direction.TO_HOST
    for number in range(2000):
        byte = layer.count(way) + 3 * number
        layer.add(LineFault(FaultKind.FLIP, way, byte, bit=number % 7))
    ready_cell.read(code, f"check {name}.baud", "cable")


def test_a_changed_setting_of_the_controller_is_a_conflict(cell: ReportedCell) -> None:
    now = cell.trial.scheduler.now
    cell.trial.physical.arm_board.receive(b"$X\n$1=25\n", now)
    cell.trial.start()
    cell.read(ErrorCode.CONFIGURATION_CONFLICT, "$1", "25", "255")


def test_a_travel_height_that_the_quill_cannot_reach_is_a_joint_limit() -> None:
    cell = ReportedCell(HighTravel)
    cell.trial.start()
    cell.run(5.0)
    cell.trial.call_service("scara_arm", "~/home")
    cell.read(ErrorCode.ARM_JOINT_LIMIT, "travel height 200.0 mm", "limit of 0.0 mm")


def test_an_unplugged_tapper_is_not_connected(ready_cell: ReportedCell) -> None:
    ready_cell.break_line("tapper", FaultKind.HANG_UP, lasting=3.0)
    ready_cell.read(ErrorCode.TAPPER_NOT_CONNECTED, "tapper")
    assert ready_cell.run(20.0, lambda: ready_cell.states["tapper_state"].error_code == 0)


def test_a_brief_power_loss_of_the_tapper_is_reported_as_a_reset(ready_cell: ReportedCell) -> None:
    ready_cell.trial.interrupt_tapper_power()
    ready_cell.read(ErrorCode.TAPPER_RESET, "restarted")


def test_a_tapper_whose_replies_are_lost_times_out(ready_cell: ReportedCell) -> None:
    ready_cell.break_line("tapper", FaultKind.DROP, length=2000)
    ready_cell.read(ErrorCode.TAPPER_TIMEOUT, "does not answer", "check power and cable")


def test_a_motor_without_power_is_a_fault_of_the_tapper(ready_cell: ReportedCell) -> None:
    ready_cell.goal()
    assert ready_cell.run(
        LONG_S, lambda: ready_cell.states["tapper_state"].state == TapperState.CHARGING
    )
    ready_cell.trial.turn_tapper_motor_off(60.0)
    ready_cell.read(ErrorCode.TAPPER_FAULT, "check", "motor")


# Commands.


def test_a_command_received_after_its_expiry_is_refused(ready_cell: ReportedCell) -> None:
    ready_cell.send(ready_cell.tap(1, expires_in=-0.5))
    ready_cell.read(ErrorCode.ARM_COMMAND_EXPIRED, "its expiry passed", "check the clocks")


def test_a_repeated_command_of_an_executed_tap_is_refused(ready_cell: ReportedCell) -> None:
    command = ready_cell.tap(1, expires_in=60.0)
    ready_cell.send(command)
    assert ready_cell.run(
        30.0, lambda: ready_cell.states["tapper_state"].outcome == TapperState.FIRED
    )
    ready_cell.send(
        TapCommand(header=command.header, request=TapCommand.WITHDRAW, tap_id=command.tap_id)
    )
    ready_cell.run(10.0)
    ready_cell.send(command)
    ready_cell.read(ErrorCode.COMMAND_REPEATED, str(command.tap_id), "never executed twice")


def test_a_board_refuses_a_shot_number_that_another_program_has_used() -> None:
    clock = VirtualClock()
    layer = FaultLayer(TapperEmulator(TapperMachine()))
    first, second = (TapperDriver(VirtualTransport(layer, clock, "tapper")) for _ in range(2))
    first.connect()
    first.charge(7, 0.01)
    first.discharge()
    first.close()
    second.connect()
    with pytest.raises(HardwareFault, match="has used that shot number") as caught:
        second.charge(7, 0.01)
    assert of_tapper(caught.value) == ErrorCode.TAPPER_SPENT


# Goals.


def test_a_goal_with_more_taps_than_the_cell_allows_is_refused(ready_cell: ReportedCell) -> None:
    ready_cell.goal(max_taps=1000)
    limit = ready_cell.trial.cell.file.goal.max_taps
    ready_cell.read(ErrorCode.GOAL_BAD_TAP_LIMIT, "max_taps is 1000", f"at most {limit}")


def test_a_goal_that_needs_more_taps_than_allowed_ends(ready_cell: ReportedCell) -> None:
    ready_cell.goal(Pose(0.12, 0.05, 2.5), max_taps=1)
    ready_cell.read(ErrorCode.TAP_LIMIT_REACHED, "after 1 taps (limit 1)")


def test_more_frames_than_the_camera_delivers_are_too_few(cell: ReportedCell) -> None:
    cell.trial.settings = replace(cell.trial.settings, frames_needed=1000)
    cell.ready()
    cell.goal()
    cell.read(ErrorCode.TOO_FEW_FRAMES, "1000 are needed", "frames_needed")


@pytest.mark.parametrize("state", [TapperState.CHARGING, TapperState.CHARGED])
def test_a_tapper_charged_by_another_program_is_busy_for_a_goal(state: int) -> None:
    """The tapper's state only matters in a cell without an arm, because otherwise the arm is busy
    as well."""
    monitor = CellMonitor(silence_limit=0.5)
    monitor.expect(has_arm=False, name="disk")
    monitor.on_tapper(TapperState(state=state, tappers=["east"]), Now(1.0, 10**9))
    missing = monitor.why_not_ready(Now(1.1, 1_100_000_000))
    assert missing == (ErrorCode.TAPPER_BUSY, "the tapper is busy")


def test_an_unknown_planner_is_refused_with_the_known_planners(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(UnknownPlannerError) as caught:
        make_planner("exakt")
    print_refusal(caught.value)
    printed = capsys.readouterr().err
    assert f"({ErrorCode.PLANNER_UNKNOWN})" in printed and "exact" in printed


def test_a_board_that_is_charged_keeps_the_other_from_charging() -> None:
    clock = VirtualClock()
    layers = [FaultLayer(TapperEmulator(TapperMachine(coils=4))) for _ in range(2)]
    drivers = [
        TapperDriver(VirtualTransport(layer, clock, f"port {number}"))
        for number, layer in enumerate(layers)
    ]
    boards = TapperBoards(drivers)
    boards.connect()
    boards.home()
    drivers[0].charge(1, 0.01)
    with pytest.raises(HardwareFault, match="port 0 is not at rest") as caught:
        boards.charge(2, 0.01, channel=cell_channel(1, 0))
    assert of_tapper(caught.value) == ErrorCode.TAPPER_OTHER_ACTIVE
    assert "only one tapper may be charged at a time" in str(caught.value)


def test_every_error_code_is_used_in_a_test() -> None:
    """Each error code must be provoked by a test."""
    text = "\n".join(path.read_text() for path in TESTS.rglob("*.py"))
    codes = {name for name, value in vars(ErrorCode).items() if isinstance(value, int)}
    assert codes - {"NONE"} - set(re.findall(r"\b[A-Z][A-Z_]+\b", text)) == set()
