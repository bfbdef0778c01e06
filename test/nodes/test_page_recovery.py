"""The numbered recovery steps on the operator's page are marked as done automatically."""

from __future__ import annotations

from tapping_cell_msgs.msg import ArmState, TapperState

from tapping_cell.nodes.page.recovery import Recovery


def shown(recovery: Recovery, arm: ArmState | None, tapper: TapperState | None) -> list[str]:
    steps = recovery.steps(arm, tapper, ["this page's STOP"], simulated=True)
    return [f"{step.command or '-'}:{step.state}" for step in steps]


def test_after_a_stop_each_recovery_step_is_marked_done() -> None:
    recovery = Recovery()
    ready = ArmState(state=ArmState.IDLE, homed=True)
    safe = TapperState(state=TapperState.SAFE)
    assert shown(recovery, ready, safe) == []
    stopped = ArmState(state=ArmState.STOPPED)
    tapper = TapperState(state=TapperState.STOPPED)
    halted = ["-:now", "press_button:now", "clear:now", "home:later"]
    assert shown(recovery, stopped, tapper) == halted
    assert shown(recovery, stopped, safe) == [
        "-:now",
        "press_button:done",
        "clear:now",
        "home:later",
    ]
    lost = ArmState(state=ArmState.NOT_HOMED)
    done = ["-:done", "press_button:done", "clear:done"]
    assert shown(recovery, lost, safe) == [*done, "home:now"]
    assert shown(recovery, ArmState(state=ArmState.HOMING), safe) == [*done, "-:now"]
    assert shown(recovery, ready, safe) == []
    assert shown(recovery, lost, safe) == ["home:now"]


def test_a_press_of_the_simulated_button_counts_down_until_the_tapper_forgets_it() -> None:
    recovery, tapper = Recovery(), TapperState(state=TapperState.STOPPED)

    def step(now: float) -> tuple[str, str]:
        found = recovery.steps(None, tapper, [], simulated=True, now=now)[1]
        return found.state, found.text

    assert step(100.0)[0] == "now"
    recovery.press(101.0)
    assert step(101.5) == ("done", "The clear button was pressed: clear the faults within 10 s.")
    assert "within 1 s" in step(110.5)[1]
    assert step(111.0)[0] == "now" and "Press the clear button" in step(111.0)[1]


def test_a_fault_of_the_arm_alone_does_not_ask_for_the_tappers_button() -> None:
    recovery = Recovery()
    fault = ArmState(state=ArmState.FAULT, homed=True)
    safe = TapperState(state=TapperState.SAFE)
    assert shown(recovery, fault, safe) == ["-:now", "clear:now", "home:later"]


def test_the_holder_of_a_stop_is_named() -> None:
    stopped = ArmState(state=ArmState.STOPPED)
    steps = Recovery().steps(stopped, None, ["this page's STOP", "a panel"], simulated=False)
    assert any("this page's STOP, a panel" in step.text for step in steps)
    assert all(step.command != "press_button" for step in steps)


def test_no_step_is_requested_while_no_node_answers() -> None:
    assert Recovery().steps(None, None, [], simulated=False) == []
