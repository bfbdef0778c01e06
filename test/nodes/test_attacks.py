"""Arm and tapper with their emulated boards over real DDS, disturbed by other publishers and
services during a tap.

The same disturbances run thousands of times in virtual time (``verification/faults.py``). Only real
nodes show what happens if a service has two servers, how a hundred messages per second affect an
executor, and how a life-cycle transition ends the work of a thread.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from harness import Bench, bench
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.duration import Duration
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState, ErrorCode, TapCommand, TapperState
from tapping_cell_msgs.srv import HoldStill

from tapping_cell.configuration.cell import load_cell
from tapping_cell.logic import arm_states
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.conversions import to_message
from tapping_cell.nodes.drivers.scara_arm import ScaraArm
from tapping_cell.nodes.drivers.tapper_trigger import TapperTrigger
from tapping_cell.se2 import Pose
from tapping_cell.simulation.devices import arm_emulator
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.spring_drive import SpringMechanism
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine
from tapping_cell.simulation.truth import ArmTruth

# These tests publish 100 messages per second, which would delay tests that run in parallel.
STRIKE, HEIGHT = Pose(-0.08, 0.02, 0.3), load_cell().strike_height
RATE_HZ = 100.0
TRIES = 10
SLOW = TapperMachine(SpringMechanism(step_rate=400.0))
"""This spring takes 2 s to charge, so that a disturbance can happen while it is being charged."""
CARRYING = (
    arm_states.State.HOMING,
    arm_states.State.LEAVING,
    arm_states.State.WITHDRAWING,
    arm_states.State.FOLLOWING,
)
"""States in which a motion carries a charged striker away. Motions to a strike pose are not among
them, because they are allowed with a charged striker. A motion in one of these states is completed
even if the node is deactivated meanwhile."""


@dataclass
class Cell:
    """The two nodes, their boards, and the recorded states and shots."""

    bench: Bench
    arm: ScaraArm
    board: TapperEmulator
    mechanics: Any
    arm_states: list[ArmState]
    tapper_states: list[TapperState]
    releases: list[tuple[int, bool]] = field(default_factory=list)
    """For each release: the shot number, and whether the arm was moving."""
    carried: int = 0
    """Number of forbidden motions, in which the arm began to carry a charged striker away."""

    def __post_init__(self) -> None:
        assert self.bench.probe is not None
        self.node = self.bench.probe
        self.commands = self.node.create_publisher(TapCommand, "tap_command", COMMAND)
        self.tap_id = int(time.time())
        self.last = TapCommand()
        # Observe the bytes that reach the arm's controller, because a motion begins with them.
        # Polling would miss some motions and see others only after the state has changed.
        self._receive = self.mechanics.receive
        self.mechanics.receive = self._watch

    def _watch(self, data: bytes, now: float) -> None:
        """Pass bytes to the controller and count motions that carry a charged striker away."""
        moved = self.mechanics.moving(now)
        away = self.arm.logic.state in CARRYING
        self._receive(data, now)
        begins = self.mechanics.moving(now) and not moved
        self.carried += begins and away and self.board.state == "CHARGED"

    def tap(self) -> None:
        """Command the next tap."""
        self.tap_id += 1
        command = TapCommand(request=TapCommand.TAP, tap_id=self.tap_id, striker_speed=0.3)
        command.header.frame_id = "table"
        command.strike_pose = to_message(STRIKE, HEIGHT)
        command.expiry = (self.node.get_clock().now() + Duration(seconds=20)).to_msg()
        self.last = command
        self.commands.publish(command)

    def withdraw(self) -> None:
        self.commands.publish(TapCommand(request=TapCommand.WITHDRAW, tap_id=self.tap_id))

    def wait(self, condition: Callable[[], object], what: str) -> None:
        """Wait until the condition holds."""
        self.bench.wait(condition, what)

    def over(self) -> bool:
        return any(s.tap_id == self.tap_id and s.outcome for s in self.tapper_states)

    def contested(self, topic: str) -> bool:
        """Return whether the tapper itself last reported a second publisher of this topic."""
        own = [s for s in self.tapper_states if s.tappers][-1:]
        return any(
            s.error_code == ErrorCode.CONFIGURATION_CONFLICT and topic in s.error_msg for s in own
        )

    def at_rest(self) -> bool:
        resting = self.board.state in ("SAFE", "UNHOMED")
        return self.arm_states[-1].state == ArmState.IDLE and resting

    def end(self) -> None:
        """Withdraw the tap and wait until the arm has moved away."""
        self.withdraw()
        self.wait(self.at_rest, "arm and tapper are at rest")

    def fire(self) -> None:
        """Repeat taps until one is fired. A tap is not fired if the arm's last position report
        arrives late."""
        for _ in range(TRIES):
            self.tap()
            self.wait(self.over, "an ordinary tap")
            outcomes = [s.outcome for s in self.tapper_states if s.tap_id == self.tap_id]
            if TapperState.FIRED in outcomes:
                return
            self.end()
        raise AssertionError(f"none of {TRIES} taps was fired: {self.tapper_states[-1].error_msg}")


@contextmanager
def attacked_cell(folder: Path, machine: TapperMachine | None = None) -> Iterator[Cell]:
    now = time.monotonic()
    board = TapperEmulator(machine, now=now)
    mechanics = arm_emulator(load_cell().file.arm, ArmTruth(), 1, now)
    nodes: list[Any] = []

    def make() -> list[Any]:
        nodes.extend((ScaraArm(), TapperTrigger()))
        return nodes

    parameters: dict[str, dict[str, object]] = {
        "tapper_trigger": {"port": folder / "tapper", "needs_camera": False},
        "scara_arm": {"port": folder / "arm", "home_on_activate": True},
    }
    with (
        PseudoTerminal(board, folder / "tapper"),
        PseudoTerminal(mechanics, folder / "arm"),
        bench(make, parameters) as b,
    ):
        cell = Cell(
            b,
            nodes[0],
            board,
            mechanics,
            b.listen(ArmState, "arm_state", LATCHED),
            b.listen(TapperState, "tapper_state", LATCHED),
        )
        board.on_fire = lambda shot, energy, now: cell.releases.append(
            (shot, mechanics.moving(time.monotonic()))
        )
        b.wait(
            lambda: (
                cell.arm_states
                and cell.tapper_states
                and cell.commands.get_subscription_count() == 2
                and cell.at_rest()
                and cell.tapper_states[-1].state == TapperState.SAFE
            ),
            "arm and tapper are ready",
        )
        yield cell


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    with attacked_cell(tmp_path) as made:
        yield made


@contextmanager
def flood(cell: Cell, kind: type, topic: str, make: Callable[[], Any], qos: Any) -> Iterator[None]:
    """Publish a message a hundred times per second."""
    publisher = cell.node.create_publisher(kind, topic, qos)
    ended = threading.Event()

    def publish() -> None:
        while not ended.wait(1 / RATE_HZ):
            message = make()
            if hasattr(message, "header"):
                message.header.stamp = cell.node.get_clock().now().to_msg()
            publisher.publish(message)

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        cell.node.destroy_publisher(publisher)


OWNERS = {"arm_state": "scara_arm", "tapper_state": "tapper_trigger"}


def test_a_second_publisher_is_named_and_nothing_is_charged_fired_or_moved(cell: Cell) -> None:
    def safe(outcome: int) -> TapperState:
        return TapperState(state=TapperState.SAFE, tap_id=cell.tap_id, outcome=outcome)

    def in_position() -> ArmState:
        pose = to_message(STRIKE, HEIGHT)
        return ArmState(state=ArmState.IN_POSITION, tap_id=cell.tap_id, homed=True, tip_pose=pose)

    attacks: list[tuple[type, str, Callable[[], Any], Any]] = [
        (TapperState, "tapper_state", lambda: safe(TapperState.NONE), LATCHED),
        (TapperState, "tapper_state", lambda: safe(TapperState.NOT_FIRED), LATCHED),
        (ArmState, "arm_state", in_position, LATCHED),
    ]
    for kind, topic, make, qos in attacks:
        cell.tapper_states.clear()
        with flood(cell, kind, topic, make, qos):
            cell.tap()
            cell.wait(
                partial(cell.contested, topic), f"the second publisher of {topic} is reported"
            )
        cell.end()
        # While the last intruder is forgotten, a sentence may name both.
        named = f"{topic} (/probe, /{OWNERS[topic]})"
        assert any(named in state.error_msg for state in cell.tapper_states)
        assert TapperState.CHARGING not in {state.state for state in cell.tapper_states}
        count = partial(cell.node.count_publishers, topic)
        cell.wait(lambda count=count: count() == 1, "the second publisher is gone")
    assert cell.releases == []
    cell.fire()
    assert cell.releases == [(cell.tap_id, False)]
    assert cell.carried == 0


@pytest.mark.parametrize("node", ["scara_arm", "tapper_trigger"])
def test_a_node_deactivated_while_charged_neither_fires_nor_moves_the_arm(
    tmp_path: Path, node: str
) -> None:
    with attacked_cell(tmp_path, SLOW) as cell:
        deactivated_while_charged(cell, node)


def deactivated_while_charged(cell: Cell, node: str) -> None:
    change = cell.node.create_client(ChangeState, f"{node}/change_state")
    cell.bench.wait(change.service_is_ready, "change_state")
    cell.tap()
    cell.wait(lambda: cell.board.state in ("CHARGING", "CHARGED"), "charged")
    answers = []
    for number in (
        Transition.TRANSITION_DEACTIVATE,
        Transition.TRANSITION_CLEANUP,
        Transition.TRANSITION_CONFIGURE,
        Transition.TRANSITION_ACTIVATE,
    ):
        request = ChangeState.Request(transition=Transition(id=number))
        answers.append(change.call_async(request))
    cell.wait(lambda: all(answer.done() for answer in answers), "the transitions")
    assert all(answer.result().success for answer in answers)
    cell.end()
    assert cell.releases == [] and cell.carried == 0
    cell.fire()
    assert cell.releases == [(cell.tap_id, False)]


def test_an_answer_of_another_cells_arm_does_not_permit_firing(cell: Cell) -> None:
    def grant(request: HoldStill.Request, response: HoldStill.Response) -> HoldStill.Response:
        response.granted, response.duration = True, request.duration
        return response

    other = cell.node.create_service(HoldStill, "hold_still", grant)
    cell.bench.wait(lambda: cell.node.count_services("hold_still") == 2, "both are known")
    for _ in range(TRIES):  # if a tap ends before the arm is asked, try again
        cell.tap()
        cell.wait(cell.over, "the tap ends")
        last = cell.tapper_states[-1]
        if last.error_code == ErrorCode.CONFIGURATION_CONFLICT:
            break
        cell.end()
    assert last.error_code == ErrorCode.CONFIGURATION_CONFLICT, last.error_msg
    assert cell.releases == []
    cell.node.destroy_service(other)
    cell.end()
    cell.bench.wait(lambda: cell.node.count_services("hold_still") == 1, "one is known")
    cell.fire()
    assert cell.releases == [(cell.tap_id, False)]


def test_no_line_injected_on_the_arm_port_causes_firing_while_the_arm_moves(cell: Cell) -> None:
    """Inject a forged line before each output of the arm's controller. One of the forged lines is a
    copy of a report from an earlier tap, in which the arm was at its strike pose."""
    said, forged, honest = list[bytes](), [b""], cell.mechanics.take_output

    def take_output(now: float) -> bytes:
        output: bytes = honest(now)
        said.append(output)
        return forged[0] + output if output else output

    cell.mechanics.take_output = take_output
    cell.fire()
    standing = next(output for output in reversed(said) if output.startswith(b"<Idle"))
    cell.end()
    services = {
        name: cell.node.create_client(Trigger, f"scara_arm/{name}")
        for name in ("clear_fault", "home")
    }
    remedies = {ArmState.FAULT: "clear_fault", ArmState.NOT_HOMED: "home"}

    def recovered() -> bool:
        state = cell.arm_states[-1].state
        if state in remedies and (not asked or asked[-1] != len(cell.arm_states)):
            asked.append(len(cell.arm_states))
            services[remedies[state]].call_async(Trigger.Request())
        return cell.at_rest()

    for line in (b"ok\r\n", standing, b"ALARM:1\r\n", b"error:9\r\n", b"\r\nGrbl 1.1h\r\n"):
        forged[0], asked = line, list[int]()
        cell.tap()
        cell.wait(lambda: cell.over() or cell.arm_states[-1].state in remedies, f"after {line!r}")
        forged[0] = b""
        cell.withdraw()
        cell.wait(recovered, f"a recovery from {line!r}")
    cell.fire()
    shots = [shot for shot, _ in cell.releases]
    assert len(shots) == len(set(shots))
    assert not any(moving for _, moving in cell.releases)
    assert cell.carried == 0
