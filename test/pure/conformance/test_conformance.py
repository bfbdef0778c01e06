"""The shipped nodes fulfil their duties, and a node that violates one is found, in virtual time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from logic_parts import goal_handling
from virtual_node import PROBE, VirtualNode

from lab.virtual_cell.network import STRANGER
from lab.virtual_cell.serial_line import SerialLine
from tapping_cell.configuration.arm_assembly import make_arm_driver
from tapping_cell.configuration.cell import load_cell
from tapping_cell.conformance import arm, planner, tapper
from tapping_cell.conformance.stage import Duty, Stage
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.tapper import TapperDriver
from tapping_cell.logic import arm_jobs
from tapping_cell.logic.arm import ArmLogic, ArmOptions
from tapping_cell.logic.clock import Now
from tapping_cell.logic.device import DeviceLogic
from tapping_cell.logic.goal_handling import GoalHandling
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.standing_still import StandingStill
from tapping_cell.logic.table_maps import TableMaps
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
from tapping_cell.logic.tapper_peers import PeerLimits
from tapping_cell.messages import HoldStill, TapCommand
from tapping_cell.simulation.devices import arm_emulator
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.truth import ArmTruth

CELL = load_cell()
STEP_S = 0.01


class VirtualLink:
    """Connects a stage to a node in virtual time."""

    def __init__(self, node: VirtualNode) -> None:
        self.node = node

    def now(self) -> Now:
        return self.node._clock.now()

    def publish(self, topic: str, message: Any, stranger: bool) -> None:
        self.node.network.publish(STRANGER if stranger else PROBE, topic, message)

    def dismiss_stranger(self) -> None:
        self.node.network.leave(STRANGER)

    def call(self, service: str, request: Any, on_answer: Callable[[Any], None]) -> None:
        self.node.network.call(service, request, on_answer)


def make_arm(logic: Callable[[], ArmLogic] = lambda: ArmLogic(ArmOptions(True))) -> VirtualNode:
    settings = CELL.file.arm

    def make(line: SerialLine | None) -> tuple[ArmLogic, ArmDriver]:
        assert line is not None
        return logic(), make_arm_driver(settings, line)

    def connect(driver: ArmDriver, patience: float, _: object) -> arm_jobs.Reading:
        driver.connect(timeout=patience)
        return arm_jobs.reading_of(driver)

    board = arm_emulator(settings, ArmTruth(), 1, 0.0)
    return VirtualNode("scara_arm", board, make, connect, "arm_state")


def make_tapper(
    logic: Callable[[], TapperLogic] = lambda: TapperLogic(TapperOptions()),
) -> VirtualNode:
    def make(line: SerialLine | None) -> tuple[TapperLogic, TapperDriver]:
        assert line is not None
        return logic(), TapperDriver(line, draw_number=lambda below: 7)

    return VirtualNode(
        "tapper_trigger",
        TapperEmulator(None, now=0.0),
        make,
        lambda driver, patience, _: driver.connect(timeout=patience),
        "tapper_state",
    )


def make_planner() -> VirtualNode:
    settings = PlannerSettings()

    def connect(_: Any, __: float, now: Now) -> GoalHandling:
        return goal_handling(CELL, "", now=now, maps=TableMaps(CELL), solve_in_background=False)

    made = VirtualNode(
        "tap_planner", None, lambda _: (PlannerLogic(settings), None), connect, "plan_state", CELL
    )
    made.run(0.1)
    return made


def findings(part: Any, node: VirtualNode, duties: tuple[Duty, ...]) -> dict[str, str]:
    """Check duties of a node; return what was found wrong, by number."""
    stage = Stage(CELL, VirtualLink(node))
    if "arm_state" in part.PLAYS:
        node.network.serve(
            PROBE, "hold_still", lambda request, answer: answer(stage.hold_still(request))
        )
    for topic in part.LISTENS:
        node.network.subscribe(PROBE, topic, stage.receive)
    checked = {
        duty.number: stage.check(part.begin, duty, lambda: node.run(STEP_S)) for duty in duties
    }
    return {number: found for number, found in checked.items() if found}


@pytest.mark.parametrize(
    ("part", "make"), [(arm, make_arm), (tapper, make_tapper), (planner, make_planner)]
)
def test_the_shipped_node_fulfils_its_duties(part: Any, make: Callable[[], VirtualNode]) -> None:
    assert findings(part, make(), part.DUTIES) == {}


def fixed(value: Any) -> property:
    """Return a class attribute that makes a node forget what it stores in this attribute."""
    return property(lambda self: value, lambda self, _: None)


def broken(base: type, **attributes: Any) -> type:
    return type("Broken", (base,), attributes)


def grants_always(self: ArmLogic, request: HoldStill.Request, now: Now) -> HoldStill.Response:
    return HoldStill.Response(granted=True, duration=request.duration)


def deaf(self: DeviceLogic[Any, Any], topic: str, message: Any, now: Now) -> Any:
    return () if topic == "emergency_stop" else DeviceLogic.on_message(self, topic, message, now)


def forgetting(name: str) -> dict[str, Any]:
    """Return the attributes of an arm that forgets until when it must stand still."""
    return {"_still": fixed(broken(StandingStill, **{name: fixed(-math.inf)})())}


BROKEN_ARMS = {
    "leaves before the end of its promise": ("A3", forgetting("until")),
    "grants every promise": ("A4", {"_hold_still": grants_always}),
    "leaves with a charged striker": ("A5", forgetting("_charged_until")),
    "forgets the ids that it has executed": ("A6", {"_last_command_id": fixed(0)}),
    "accepts every command": ("A7", {"_refusal": lambda self, command, now: None}),
    "does not know its frame": ("A8", {"_refusal": lambda self, command, now: None}),
    "does not look for a second planner": ("A10", {"_conflict": fixed(None)}),
    "does not listen to the emergency stop": ("A11", {"on_message": deaf}),
}


def keeps_tap(self: TapperLogic, command: TapCommand, now: Now) -> None:
    if command.request != TapCommand.WITHDRAW:
        TapperLogic._tap_command(self, command, now)


def tolerant(**limits: float) -> Callable[[], TapperLogic]:
    return lambda: TapperLogic(TapperOptions(limits=PeerLimits(**limits)))


def broken_tapper(**attributes: Any) -> Callable[[], TapperLogic]:
    return lambda: broken(TapperLogic, **attributes)(TapperOptions())  # type: ignore[no-any-return]


BROKEN_TAPPERS = {
    "tolerates an object that has moved": ("T6", tolerant(moved=1.0)),
    "tolerates a hidden object": ("T7", tolerant(unseen=math.inf)),
    "tolerates a silent planner": ("T9", tolerant(silence=math.inf)),
    "tolerates a silent camera": ("T10", tolerant(silence=math.inf, unseen=math.inf)),
    "ignores the withdrawal": ("T12", broken_tapper(_tap_command=keeps_tap)),
    "does not look for a second arm": ("T13", broken_tapper(_conflict=fixed(None))),
    "does not listen to the emergency stop": ("T14", broken_tapper(on_message=deaf)),
}


@pytest.mark.parametrize("defect", BROKEN_ARMS)
def test_a_broken_arm_is_found(defect: str) -> None:
    number, attributes = BROKEN_ARMS[defect]
    logic = broken(ArmLogic, **attributes)
    duties = tuple(duty for duty in arm.DUTIES if duty.number == number)
    assert list(findings(arm, make_arm(lambda: logic(ArmOptions(True))), duties)) == [number]


@pytest.mark.parametrize("defect", BROKEN_TAPPERS)
def test_a_broken_tapper_is_found(defect: str) -> None:
    number, logic = BROKEN_TAPPERS[defect]
    duties = tuple(duty for duty in tapper.DUTIES if duty.number == number)
    assert list(findings(tapper, make_tapper(logic), duties)) == [number]
