"""Numbered recovery steps after a stop, a fault or a start without a homed arm."""

from __future__ import annotations

from typing import NamedTuple

from tapping_cell_msgs.msg import ArmState, TapperState

ARM_HALTED = (ArmState.STOPPED, ArmState.FAULT)
TAPPER_HALTED = (TapperState.STOPPED, TapperState.FAULT)


class Step(NamedTuple):
    """One step: a person's action and, if the page has a command that performs this action, the
    command."""

    text: str
    state: str
    """One of: done, now, later."""
    command: str = ""


class Recovery:
    """Track the cell from a halt until it accepts goals again; completed steps are marked
    automatically."""

    def __init__(self) -> None:
        self._halted = False
        self._tapper_halted = False

    def steps(
        self,
        arm: ArmState | None,
        tapper: TapperState | None,
        holders: list[str],
        simulated: bool,
        has_arm: bool = True,
    ) -> list[Step]:
        """Return the required steps in order; empty if none are required.

        ``arm`` and ``tapper`` are the latest states; None if no state has been received.
        ``holders`` are the known names of the nodes that hold a stop. In a simulated cell, the page
        can press the button at the tapper. A cell without an arm needs no homing.
        """
        tapper_halted = tapper is not None and tapper.state in TAPPER_HALTED
        halted = tapper_halted or (arm is not None and arm.state in ARM_HALTED)
        homed = arm is not None and arm.homed
        if halted and not self._halted:
            self._tapper_halted = False
        if not halted and (homed or arm is None):
            self._halted = self._tapper_halted = False
            return []
        self._halted = self._halted or halted
        self._tapper_halted = self._tapper_halted or tapper_halted
        steps = []
        if self._halted:
            now = "now" if halted else "done"
            steps.append(Step("Remove the cause, and make sure that nobody is near the cell.", now))
            if self._tapper_halted:
                pressed = "now" if tapper_halted else "done"
                button = "press_button" if simulated else ""
                text = "Press the clear button at the tapper, then clear the faults within 10 s."
                steps.append(Step(text, pressed, button))
            held = f" Stops: {', '.join(holders)}." if holders else ""
            steps.append(Step(f"Clear the stop and the faults.{held}", now, "clear"))
        if not has_arm:
            return steps
        home = "done" if homed and not halted else "later" if halted else "now"
        busy = arm is not None and arm.state == ArmState.HOMING
        text = "The arm is homing." if busy else "Home the arm: it moves to its end switches."
        steps.append(Step(text, home, "" if busy else "home"))
        return steps
