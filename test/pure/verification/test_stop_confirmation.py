"""A stop whose publisher vanished while it asserted the stop, or does not repeat its level, is
cleared only after a person has confirmed; the checker detects every other reset."""

from __future__ import annotations

import pytest

from tapping_cell.messages import ArmState, TapperState
from tapping_cell.verification.further_panels import PanelPress
from tapping_cell.verification.stop_confirmation import (
    INSTRUCTION,
    ClearRequest,
    StopConfirmation,
)
from tapping_cell.verification.trial import Trial

NOBODY: frozenset[str] = frozenset()


class Checked:
    """A checker of one node, with the names of the violations."""

    def __init__(self) -> None:
        self.found: list[str] = []
        self.checker = StopConfirmation(lambda name, _: self.found.append(name))

    def clear(
        self, received: float, answered: float, refused: bool, volatile: frozenset[str] = NOBODY
    ) -> None:
        """Request to clear the stop; the node refuses the request or clears the stop."""
        request = ClearRequest("arm", received, volatile)
        if not refused:
            self.checker.on_stop_state("arm", False)
        sentence = f"... {INSTRUCTION} 30 s" if refused else ""
        self.checker.on_answer(request, not refused, sentence, volatile, answered)


@pytest.fixture
def node() -> Checked:
    made = Checked()
    made.checker.press(0)
    made.checker.on_level("arm", True, 0)
    made.checker.on_stop_state("arm", True)
    return made


def test_a_stop_whose_publisher_released_it_needs_no_confirmation(node: Checked) -> None:
    node.checker.release(0)
    node.clear(1.0, 1.3, refused=False)
    assert node.found == []


def test_a_vanished_publisher_requires_a_refusal_and_a_second_request(node: Checked) -> None:
    node.checker.vanish(0)
    assert node.checker.needs_confirmation("arm")
    node.clear(1.0, 1.3, refused=True)
    node.clear(2.0, 2.3, refused=False)
    assert node.found == [] and not node.checker.needs_confirmation("arm")


@pytest.mark.parametrize("second", [1.2, 32.0])
def test_a_second_request_before_the_refusal_or_too_late_is_no_confirmation(
    node: Checked, second: float
) -> None:
    node.checker.vanish(0)
    node.clear(1.0, 1.3, refused=True)
    node.clear(second, second + 0.3, refused=False)
    assert node.found == ["cleared without confirmation"]


def test_a_new_stop_or_a_restart_cancels_the_confirmation(node: Checked) -> None:
    for cancel in (node.checker.on_stop, node.checker.on_process_lost):
        node.found.clear()
        node.checker.press(1)
        node.checker.on_level("arm", True, 1)
        node.checker.on_stop_state("arm", True)
        node.checker.vanish(1)
        node.clear(1.0, 1.3, refused=True)
        cancel("arm")
        node.clear(2.0, 2.3, refused=False)
        assert node.found == ["cleared without confirmation"]


def test_a_volatile_publisher_requires_a_confirmation_while_it_is_present(node: Checked) -> None:
    node.checker.release(0)
    node.clear(1.0, 1.3, refused=False, volatile=frozenset({"panel"}))
    assert node.found == ["cleared without confirmation"]


def test_a_stop_received_after_its_publisher_vanished_must_be_confirmed_until_a_release() -> None:
    node = Checked()
    node.checker.press(0)
    node.checker.vanish(0)
    node.checker.on_level("arm", True, 0)
    assert node.checker.needs_confirmation("arm")
    node.checker.on_level("arm", False, None)
    assert not node.checker.needs_confirmation("arm")


@pytest.mark.parametrize(
    "press",
    [PanelPress(1.0), PanelPress(1.0, back_after=2.0), PanelPress(1.0, True, False, stays=60.0)],
)
def test_the_cell_stays_stopped_until_a_person_has_confirmed(press: PanelPress) -> None:
    trial = Trial(seed=21, faults=False)
    trial.bring_up()
    trial.press_further_panel(press)
    trial.scheduler.run(trial.scheduler.now + 5.0)
    assert states_after_a_request(trial) == (ArmState.STOPPED, TapperState.STOPPED)
    assert states_after_a_request(trial) == (ArmState.NOT_HOMED, TapperState.SAFE)
    trial.recover()
    assert trial.checker.violations == []


def states_after_a_request(trial: Trial) -> tuple[int, int]:
    """Request to clear both devices as a person at the cell does; return their states."""
    trial.physical.press_clear_button()
    trial.scheduler.run(trial.scheduler.now + 1.0)
    for node in ("scara_arm", "tapper_trigger"):
        trial.call_service(node, "~/clear_fault")
    trial.scheduler.run(trial.scheduler.now + 3.0)
    arm, tapper = (trial.network.history[topic][-1] for topic in ("arm_state", "tapper_state"))
    return arm.state, tapper.state
