"""The state machine of the tapper with its driver and its emulated board, in virtual time: it fires
a tap once, and only while the arm is in position for this tap."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from logic_parts import alone
from virtual_node import PROBE, VirtualNode

from lab.virtual_cell.serial_line import SerialLine
from tapping_cell.hardware.tapper import TapperDriver
from tapping_cell.logic.clock import NANOSECONDS, Now, to_stamp
from tapping_cell.logic.host import Deactivated
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.tap_commands import LARGEST_JUMP
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
from tapping_cell.logic.tapper_peers import PeerLimits, TapperPeers
from tapping_cell.messages import (
    ArmState,
    Bool,
    ErrorCode,
    HoldStill,
    ObjectState,
    PlanState,
    PoseWithCovariance,
    TapCommand,
    TapperState,
)
from tapping_cell.se2 import Pose
from tapping_cell.simulation.fault_layer import Direction, FaultKind, LineFault
from tapping_cell.simulation.spring_drive import SpringMechanism
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine


class Cell(VirtualNode):
    """The node, its emulated board, and a probe that replaces planner and arm."""

    def __init__(self, machine: TapperMachine | None = None, started: bool = True) -> None:
        self.device = TapperEmulator(machine, now=0.0)

        def make(line: SerialLine | None) -> tuple[TapperLogic, TapperDriver]:
            assert line is not None
            return TapperLogic(TapperOptions()), TapperDriver(line, draw_number=lambda below: 7)

        super().__init__(
            "tapper_trigger",
            self.device,
            make,
            lambda driver, patience, _: driver.connect(timeout=patience),
            "tapper_state",
            started=started,
        )
        self.arm_holds = True
        self.network.serve(PROBE, "hold_still", self._hold_still)
        if started:
            self.wait_state(TapperState.SAFE)

    def _hold_still(self, request: HoldStill.Request, answer: Callable[[Any], None]) -> None:
        code = 0 if self.arm_holds else ErrorCode.TAPPER_ARM_NOT_IN_POSITION
        answer(
            HoldStill.Response(granted=self.arm_holds, duration=request.duration, error_code=code)
        )

    def command(self, tap_id: int, speed: float = 0.3, valid: float = 30.0) -> None:
        message = TapCommand(request=TapCommand.TAP, tap_id=tap_id, striker_speed=speed)
        message.header.frame_id = "table"
        message.expiry = self.stamp(valid)
        self.publish("tap_command", message)

    def withdraw(self, tap_id: int) -> None:
        self.publish("tap_command", TapCommand(request=TapCommand.WITHDRAW, tap_id=tap_id))

    def publish_arm(self, tap_id: int, state: int = ArmState.IN_POSITION, age: float = 0.0) -> None:
        message = ArmState(state=state, tap_id=tap_id, homed=True)
        message.header.stamp = self.stamp(-age)
        self.publish("arm_state", message)

    def publish_until(
        self,
        condition: Callable[[], bool],
        what: str,
        send: Callable[[], None],
        every: float = 0.03,
    ) -> None:
        """Call ``send`` every ``every`` s until the condition holds."""
        end = self.now() + 20.0
        while not condition():
            assert self.now() < end, f"waited in vain: {what}"
            send()
            self.run(every)

    def keep_publishing(self, seconds: float, **arm: Any) -> None:
        """Publish the arm's state for ``seconds`` s."""
        end = self.now() + seconds
        while self.now() < end:
            self.publish_arm(**arm)
            self.run(0.05)

    def fire(self, tap_id: int) -> None:
        """Command a tap, publish that the arm is in position, and wait for the shot."""
        self.command(tap_id)
        self.until_outcome(tap_id, TapperState.FIRED)

    def until_outcome(self, tap_id: int, outcome: int) -> None:
        """Publish that the arm is in position until the tap has this outcome."""
        self.publish_until(
            lambda: self.outcome(tap_id) == outcome,
            f"tap {tap_id} has outcome {outcome}",
            lambda: self.publish_arm(tap_id),
        )

    def until_charging(self, tap_id: int) -> None:
        """Command a tap and publish that the arm is in position until the board charges."""
        self.command(tap_id)
        self.publish_until(
            lambda: self.device.state == "CHARGING",
            "the board charges",
            lambda: self.publish_arm(tap_id),
            0.04,
        )

    def until_charged(self, tap_id: int) -> None:
        """Command a tap and publish that the arm moves until the striker is charged."""
        self.command(tap_id)
        self.publish_until(
            lambda: self.last.state == TapperState.CHARGED,
            "charged",
            lambda: self.publish_arm(tap_id, ArmState.MOVING),
        )

    def outcome(self, tap_id: int) -> int:
        return int(self.last.outcome) if self.last.tap_id == tap_id else TapperState.NONE

    def press_clear_button(self) -> None:
        self.device.press_clear_button(self.now())
        assert self.line is not None
        self.line.schedule()

    def shots(self) -> list[int]:
        return [shot for shot, _, _ in self.device.fires]


@pytest.fixture
def cell() -> Cell:
    return Cell()


def test_the_tapper_fires_once_when_the_arm_is_in_position(cell: Cell) -> None:
    cell.command(100)
    cell.run(0.2)
    assert cell.shots() == []
    cell.until_outcome(100, TapperState.FIRED)
    assert cell.shots() == [100]
    # The command arrives a second time while the arm is still in position. The node must not fire
    # again.
    cell.command(100)
    cell.keep_publishing(0.5, tap_id=100)
    assert cell.shots() == [100]
    # The node refuses the repeated command without requesting charging, which the board would
    # refuse as well. The outcome of the first command is still
    # reported.
    assert cell.outcome(100) == TapperState.FIRED
    assert {s.state for s in cell.states[-5:]} == {TapperState.SAFE}


@pytest.mark.parametrize(
    ("arm", "code"),
    [
        ({"tap_id": 99}, ErrorCode.TAPPER_COMMAND_EXPIRED),
        ({"tap_id": 100, "state": ArmState.MOVING}, ErrorCode.TAPPER_COMMAND_EXPIRED),
        ({"tap_id": 100, "state": ArmState.FAULT}, ErrorCode.TAPPER_COMMAND_EXPIRED),
        ({"tap_id": 100, "age": 2.0}, ErrorCode.CLOCKS_DIFFER),
        ({"tap_id": 100, "age": -2.0}, ErrorCode.CLOCKS_DIFFER),
    ],
    ids=["another tap", "moving", "faulted", "stale", "from the future"],
)
def test_the_tapper_does_not_fire_if_a_condition_is_not_met(cell, arm, code):
    cell.command(100, valid=1.0)
    cell.keep_publishing(1.2, **arm)
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
    assert cell.shots() == []
    assert cell.last.error_code == code


def test_a_withdrawn_tap_is_not_fired_later(cell: Cell) -> None:
    cell.command(100)
    cell.withdraw(100)
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
    cell.keep_publishing(0.5, tap_id=100)
    assert cell.shots() == []


def test_a_copy_of_a_refused_command_is_not_fired_after_its_withdrawal(cell: Cell) -> None:
    """The command arrives while the tapper serves another program's tap, and a copy of it when the
    tapper is at rest again."""
    cell.command(100)
    cell.wait(lambda: cell.last.tap_id == 100, "accepted")
    message = TapCommand(request=TapCommand.TAP, tap_id=101, striker_speed=0.3)
    message.header.frame_id, message.header.stamp = "table", cell.stamp(0.0)
    message.expiry = cell.stamp(30.0)
    cell.publish("tap_command", message)
    cell.run(0.1)
    cell.withdraw(101)
    cell.withdraw(100)
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "withdrawn")
    cell.publish("tap_command", message)
    cell.wait(lambda: cell.outcome(101) == TapperState.NOT_FIRED, "refused")
    assert cell.last.error_code == ErrorCode.COMMAND_REPEATED
    cell.keep_publishing(0.5, tap_id=101)
    assert cell.shots() == []
    cell.fire(102)
    assert cell.shots() == [102]


def test_a_tap_is_refused_if_its_withdrawal_arrived_before_its_command(cell: Cell) -> None:
    """The tapper's process was started after the command of the planner, and before its withdrawal.
    A copy of the command arrives later."""
    cell.withdraw(100)
    cell.command(100)
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "refused")
    assert cell.last.error_code == ErrorCode.COMMAND_REPEATED
    assert "withdrawn before its command arrived" in cell.last.error_msg
    cell.keep_publishing(0.5, tap_id=100)
    assert cell.shots() == []
    cell.fire(101)
    assert cell.shots() == [101]


def test_a_tap_older_than_one_served_is_refused(cell: Cell) -> None:
    cell.fire(100)
    cell.command(50)
    cell.keep_publishing(0.8, tap_id=50)
    assert cell.shots() == [100]


def test_an_expired_command_is_refused(cell: Cell) -> None:
    cell.command(100, valid=-1.0)
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
    assert cell.last.error_code == ErrorCode.TAPPER_COMMAND_EXPIRED


@pytest.mark.parametrize("known", [True, False])
def test_a_tap_ends_at_once_if_the_clocks_differ(cell: Cell, known: bool) -> None:
    """Waiting would end at the planner's time limit, without reporting the cause.

    ``known``: the difference is known when the command arrives; otherwise it is noticed while the
    tap waits.
    """
    if known:
        cell.publish_arm(100, age=2.0)
    cell.command(100)
    cell.run(0.1)
    cell.publish_arm(100, age=2.0)
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
    assert cell.last.error_code == ErrorCode.CLOCKS_DIFFER
    assert "+2.0" in cell.last.error_msg and "limit 0.50 s" in cell.last.error_msg
    assert cell.last.state == TapperState.SAFE and cell.shots() == []


def test_a_speed_beyond_the_curve_is_refused_with_its_range(cell: Cell) -> None:
    cell.command(100, speed=9.0)
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
    assert cell.last.error_code == ErrorCode.TAPPER_SPEED_OUT_OF_RANGE
    assert "9000.0 mm/s" in cell.last.error_msg
    assert "2500.0 mm/s" in cell.last.error_msg


def test_an_emergency_stop_latches_until_a_person_clears_it(cell: Cell) -> None:
    cell.command(100)
    cell.publish("emergency_stop", Bool(data=True))
    cell.wait(lambda: cell.last.state == TapperState.STOPPED, "stopped")
    cell.publish("emergency_stop", Bool(data=False))
    cell.keep_publishing(0.5, tap_id=100)
    assert cell.shots() == []
    assert cell.last.state == TapperState.STOPPED
    cell.press_clear_button()
    assert cell.call("~/clear_fault").success
    cell.wait(lambda: cell.last.state == TapperState.SAFE, "safe again")
    cell.fire(101)
    assert cell.shots() == [101]


def test_no_shot_is_fired_unless_the_arm_promises_to_stand_still(cell: Cell) -> None:
    """The arm's state IN_POSITION alone does not permit a shot."""
    cell.arm_holds = False
    cell.command(100)
    cell.until_outcome(100, TapperState.NOT_FIRED)
    assert cell.last.error_code == ErrorCode.TAPPER_ARM_NOT_IN_POSITION
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
def test_an_object_away_from_its_planned_pose_is_not_struck(cell, pose, visible, code):
    """An object that was turned, moved or hidden after planning is not struck."""
    cell.command(100, valid=1.0)

    def send() -> None:
        seen = ObjectState(visible=visible, pose=PoseWithCovariance(pose=to_message(pose)))
        seen.header.stamp = cell.stamp()
        cell.publish("object_states", alone(seen))
        cell.publish_arm(100)

    cell.publish_until(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired", send)
    assert cell.shots() == []
    words = {ErrorCode.OBJECT_MOVED: "from the pose for which the tap was planned"}
    assert words.get(code, "has not been seen") in cell.last.error_msg


@pytest.mark.parametrize(
    ("by_arm", "by_hand", "refusal"),
    [
        # The object is seen until the time 0 s, then hidden by the arm or by a hand.
        ((0.0, 3.9), None, None),
        ((0.0, 4.2), None, "the arm has hidden the object"),
        (None, (0.0, 0.4), None),
        (None, (0.0, 0.5), "has not been seen for"),
        ((0.0, 1.0), (1.0, 1.4), None),
        ((0.0, 1.0), (1.0, 1.5), "has not been seen for"),
        # The arm then covers the place, so that nobody knows what the hand did there.
        ((0.5, 1.5), (0.0, 0.5), "has not been seen for"),
    ],
)
def test_only_the_arm_may_hide_an_object_for_long_before_a_shot(by_arm, by_hand, refusal):
    peers = TapperPeers(PeerLimits())

    def send(at: float, **how: Any) -> None:
        message = ObjectState(**how)
        message.header.stamp = to_stamp(round((100.0 + at) * NANOSECONDS))
        now = Now(100.0 + at, round((100.0 + at) * NANOSECONDS))
        peers.on_object_states(alone(message), now)

    send(0.0, visible=True, at_rest=True)
    end = max(last for span in (by_arm, by_hand) if span for last in span)
    for at in np.arange(0.05, end + 1e-9, 0.05):
        hand = by_hand is not None and by_hand[0] < at <= by_hand[1] + 1e-9
        if hand:
            send(at, error_code=ErrorCode.OBJECT_NOT_SEEN)
        else:
            send(at, hidden_by_arm=True)
    peers.begin_tap("", 0.0)
    now = Now(100.0 + end, round((100.0 + end) * NANOSECONDS))
    found = peers._disturbance(Pose(0.0, 0.0, 0.0), now)
    assert (found is None) if refusal is None else (found is not None and refusal in found[1])


def test_the_state_of_the_active_tap_is_never_overwritten_by_a_read() -> None:
    """Regression test: SAFE was reported while charging, and a second tap was accepted."""
    cell = Cell(SLOW)
    for number in range(4):
        tap_id = 100 + number
        cell.command(tap_id)
        cell.publish_until(
            lambda: cell.last.state == TapperState.CHARGING,
            "charging",
            lambda tap_id=tap_id: cell.publish_arm(tap_id),
        )
        start = len(cell.states)
        cell.keep_publishing(0.4, tap_id=tap_id)
        cell.command(200 + number)
        cell.keep_publishing(0.3, tap_id=tap_id)
        reported = {(s.state, s.tap_id) for s in cell.states[start:]}
        assert reported == {(TapperState.CHARGING, tap_id)}
        cell.withdraw(tap_id)
        cell.wait(lambda tap_id=tap_id: cell.outcome(tap_id) == TapperState.NOT_FIRED, "let down")
    assert cell.shots() == []


def test_an_invalid_id_does_not_cause_later_taps_to_be_refused(cell: Cell) -> None:
    """An invalid id must not block later taps."""
    cell.command(2**64 - 1)
    cell.command(2**63)
    cell.run(0.2)
    cell.fire(100)
    assert cell.shots() == [100]


def test_refused_commands_do_not_raise_the_largest_valid_id(cell: Cell) -> None:
    now = cell.stamp().sec
    for step in range(1, 4):
        cell.command(now + step * LARGEST_JUMP, valid=-5.0)
        cell.run(0.2)
    assert cell.last.tap_id <= cell.stamp().sec + LARGEST_JUMP
    next_id = max(cell.last.tap_id, cell.stamp().sec) + 1
    cell.fire(next_id)
    assert cell.shots() == [next_id]


DISCHARGED = ("DISCHARGING", "SAFE")
SLOW = TapperMachine(SpringMechanism(step_rate=100.0))
"""This spring takes so long to charge that each interruption in these tests happens while it is
charged."""


@pytest.mark.parametrize(
    "lost", ["planner", "arm", "camera", "pictures", "usable pictures"], ids=lambda name: name
)
def test_the_striker_is_discharged_if_a_peer_falls_silent(lost: str) -> None:
    cell = Cell(SLOW)
    last = cell.stamp()

    def publish_all(but: str = "") -> None:
        if but != "planner":
            cell.publish("plan_state", PlanState(state=PlanState.FIRING))
        if but != "camera":
            seen = ObjectState(visible=True)
            # The camera node keeps publishing even if its last image is old or cannot be used.
            seen.header.stamp = last if but == "pictures" else cell.stamp()
            if but == "usable pictures":
                seen.error_code = ErrorCode.IMAGE_INVALID
            cell.publish("object_states", alone(seen))
        if but != "arm":
            cell.publish_arm(100)

    cell.command(100)
    cell.publish_until(
        lambda: cell.device.state == "CHARGING", "the draw begins", publish_all, 0.04
    )
    last = cell.stamp()
    silent = cell.now()
    cell.publish_until(
        lambda: cell.outcome(100) != TapperState.NONE, "let down", lambda: publish_all(lost), 0.01
    )
    assert cell.now() - silent < 1.0
    assert cell.outcome(100) == TapperState.NOT_FIRED and cell.device.state in DISCHARGED
    assert ("camera" if "pictures" in lost else lost) in cell.last.error_msg
    assert cell.shots() == []


def test_the_striker_is_not_charged_while_the_planner_is_silent(cell):
    cell.command(100)
    cell.wait(lambda: cell.last.tap_id == 100, "taken")
    cell.publish("plan_state", PlanState(state=PlanState.PLACING))
    cell.run(0.6)
    cell.keep_publishing(0.6, tap_id=100)
    assert cell.device.state == "UNHOMED" and cell.outcome(100) == TapperState.NONE

    def send() -> None:
        cell.publish("plan_state", PlanState(state=PlanState.FIRING))
        cell.publish_arm(100)

    cell.publish_until(lambda: cell.outcome(100) == TapperState.FIRED, "fired", send, 0.05)
    assert cell.shots() == [100]


def test_another_program_may_command_taps_while_the_planner_is_idle(cell: Cell) -> None:
    """The idle planner publishes only twice per second. During a tap of another program, this low
    rate does not cause a timeout."""
    for tap_id in (100, 101, 102):
        cell.command(tap_id)
        for _ in range(10):
            cell.publish("plan_state", PlanState(state=PlanState.IDLE))
            cell.keep_publishing(0.6, tap_id=tap_id)
            if cell.outcome(tap_id) == TapperState.FIRED:
                break
    assert cell.shots() == [100, 101, 102]


def test_a_restarted_planner_does_not_fire_the_tap_of_the_previous_planner(cell: Cell) -> None:
    cell.command(100)
    cell.wait(lambda: cell.last.tap_id == 100, "taken")
    cell.publish("plan_state", PlanState(state=PlanState.PLACING))
    cell.run(0.2)
    cell.publish("plan_state", PlanState(state=PlanState.WAITING_FOR_CELL))
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "given up")
    assert "planner" in cell.last.error_msg
    cell.keep_publishing(0.5, tap_id=100)
    assert cell.shots() == []


def test_a_foreign_command_does_not_affect_the_active_tap(cell: Cell) -> None:
    cell.command(100)
    cell.wait(lambda: cell.last.tap_id == 100, "taken")
    cell.command(999)
    cell.withdraw(999)
    cell.run(0.3)
    assert cell.last.tap_id == 100 and cell.outcome(100) == TapperState.NONE
    cell.until_outcome(100, TapperState.FIRED)
    assert cell.shots() == [100]
    # The planner's next tap is accepted although the id 999 was received before.
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
def test_an_invalid_command_is_refused_with_a_message_and_blocks_no_other(cell, change, code):
    message = TapCommand(request=int(change.get("request", TapCommand.TAP)), tap_id=100)
    message.header.frame_id = str(change.get("frame", "table"))
    message.striker_speed = float(change.get("speed", 0.3))
    message.header.stamp = cell.stamp(change.get("ahead", 0.0))
    message.expiry = cell.stamp(change.get("valid", 5.0))
    cell.publish("tap_command", message)
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "refused")
    assert cell.last.error_code == code
    assert len(cell.last.error_msg) > 20
    cell.fire(101)
    assert cell.shots() == [101]


def test_deactivation_during_charging_discharges_the_striker() -> None:
    cell = Cell(SLOW)
    cell.until_charging(100)
    cell.process.lifecycle(Deactivated())
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "not fired")
    # The error code is that of the deactivation, not of a message timeout or a slow charge.
    assert cell.last.error_code == ErrorCode.NOT_ACTIVE
    assert cell.device.state in DISCHARGED and cell.shots() == []


def test_a_stop_published_before_the_node_started_is_held() -> None:
    cell = Cell(started=False)
    cell.publish("emergency_stop", Bool(data=True))
    cell.run(1.0)
    cell.process.start()
    cell.wait(lambda: cell.device.state == "STOPPED", "the board is stopped as well")
    cell.command(100)
    cell.keep_publishing(0.5, tap_id=100)
    assert cell.shots() == [] and cell.last.state == TapperState.STOPPED


@pytest.mark.parametrize("withdrawn", ["before", "meanwhile", "never"])
@pytest.mark.parametrize("moment", range(0, 20, 6))
def test_a_frozen_tapper_recovers_automatically(withdrawn: str, moment: int) -> None:
    """The board has discharged by itself, so the state is known to be safe and nobody needs to
    clear a fault."""
    cell = Cell(SLOW)
    cell.until_charging(100)
    cell.run(0.001 * moment)
    if withdrawn == "before":
        cell.withdraw(100)
        cell.run(0.003)
    cell.process.freeze(1.5)
    cell.run(0.1)
    if withdrawn == "meanwhile":
        cell.withdraw(100)
    count_before = len(cell.states)
    cell.wait(lambda: cell.outcome(100) == TapperState.NOT_FIRED, "told")
    cell.wait_state(TapperState.SAFE)
    cell.run(2.0)
    after = cell.states[count_before:]
    assert TapperState.FAULT not in {state.state for state in after}
    outcomes = [state.outcome for state in after if state.tap_id == 100]
    assert outcomes == sorted(outcomes), "once told, an outcome stays"
    assert cell.device.state in DISCHARGED and cell.shots() == []


def test_a_tapper_frozen_during_a_shot_reports_unknown_once_and_becomes_ready() -> None:
    """FIRE was sent and the board's answer was lost. The next tap needs no confirmation by a
    person."""
    cell = Cell()
    assert cell.line is not None
    layer = cell.line.layer

    def fall_silent(process: str, job: str, answer: object) -> None:
        if job == "fire" and answer is None:
            here = layer.count(Direction.TO_HOST)
            layer.add(LineFault(FaultKind.DROP, Direction.TO_HOST, here, 1000))

    cell.process.on_asked = fall_silent
    cell.command(100)
    count_before = len(cell.states)
    cell.publish_until(
        lambda: cell.outcome(100) != TapperState.NONE, "an outcome", lambda: cell.publish_arm(100)
    )
    cell.wait_state(TapperState.SAFE)
    cell.run(2.0)
    after = [state for state in cell.states[count_before:] if state.tap_id == 100]
    outcomes = [state.outcome for state in after if state.outcome != TapperState.NONE]
    assert set(outcomes) == {TapperState.UNKNOWN}
    assert TapperState.FAULT not in {state.state for state in after}
    cell.process.on_asked = lambda process, job, answer: None
    cell.fire(101)
    assert cell.shots() == [100, 101]


@pytest.mark.parametrize("read", [True, False])
def test_a_restarted_tapper_does_not_report_an_id_used_by_its_board_as_not_fired(cell, read):
    """The tap may have been fired before the restart. Until the board was read, no outcome is
    reported."""
    cell.fire(100)
    cell.process.kill()
    cell.states.clear()
    cell.process.start()
    if read:
        cell.wait_state(TapperState.SAFE)
    else:
        cell.wait(lambda: bool(cell.states), "a state")
        assert cell.last.state == TapperState.DISCONNECTED
    cell.command(100)
    if read:
        cell.wait(lambda: cell.outcome(100) != TapperState.NONE, "an outcome")
        assert cell.outcome(100) == TapperState.UNKNOWN
    else:
        cell.wait_state(TapperState.SAFE)
        assert cell.outcome(100) == TapperState.NONE
    cell.keep_publishing(0.5, tap_id=100)
    assert cell.shots() == [100]


def test_a_shot_refused_by_the_board_is_reported_with_the_boards_reason(cell: Cell) -> None:
    """The guard is opened between the last check and FIRE."""
    cell.command(100)
    cell.process.on_asked = lambda process, job, answer: (
        cell.device.set_interlock(False, cell.now()) if job == "fire" else None
    )
    cell.until_outcome(100, TapperState.NOT_FIRED)
    assert cell.last.error_code == ErrorCode.TAPPER_INTERLOCK_OPEN
    assert "close the guard" in cell.last.error_msg
    assert cell.shots() == []


def test_a_guard_opened_while_charged_is_named_as_the_cause(cell: Cell) -> None:
    cell.until_charged(100)
    cell.device.set_interlock(False, cell.now())
    cell.keep_publishing(0.3, tap_id=100, state=ArmState.MOVING)
    # The guard is closed again before the arm is in position.
    cell.device.set_interlock(True, cell.now())
    cell.keep_publishing(0.5, tap_id=100)
    assert cell.shots() == []
    assert cell.outcome(100) == TapperState.NOT_FIRED
    assert cell.last.error_code == ErrorCode.TAPPER_INTERLOCK_OPEN, cell.last.error_msg
    cell.fire(101)
    assert cell.shots() == [101]


def test_a_charge_lost_for_another_reason_ends_the_tap_at_once(cell: Cell) -> None:
    cell.until_charged(100)
    cell.device.set_interlock(False, cell.now())
    cell.run(0.02)
    cell.device.set_interlock(True, cell.now())
    cell.keep_publishing(0.3, tap_id=100, state=ArmState.MOVING)
    assert cell.outcome(100) == TapperState.NOT_FIRED
    assert cell.last.error_code in (ErrorCode.TAPPER_FAULT, ErrorCode.TAPPER_INTERLOCK_OPEN)
