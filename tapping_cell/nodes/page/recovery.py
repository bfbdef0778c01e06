"""Numbered recovery steps after a stop, a fault or a start without a homed arm."""

from __future__ import annotations

import math
from typing import NamedTuple

from tapping_cell_msgs.msg import ArmState, TapperState

ARM_HALTED = (ArmState.STOPPED, ArmState.FAULT)
BUTTON_S = 10.0
"""Time for which the tapper remembers that its clear button was pressed."""
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
        self._pressed_at = -math.inf

    def press(self, now: float) -> None:
        """Note that the page pressed the simulated clear button (s of a steady clock)."""
        self._pressed_at = now

    def steps(
        self,
        arm: ArmState | None,
        tapper: TapperState | None,
        holders: list[str],
        simulated: bool,
        has_arm: bool = True,
        now: float = 0.0,
    ) -> list[Step]:
        """Return the required steps in order; empty if none are required.

        ``arm`` and ``tapper`` are the latest states; None if no state has been received.
        ``holders`` are the known names of the nodes that hold a stop. In a simulated cell, the page
        can press the button at the tapper, and the step is done for the time for which the tapper
        remembers it. A cell without an arm needs no homing. ``now``: s of a steady clock.
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
            present = "now" if halted else "done"
            text = "Remove the cause, and make sure that nobody is near the cell."
            steps.append(Step(text, present))
            if self._tapper_halted:
                left = math.ceil(max(0.0, self._pressed_at + BUTTON_S - now))
                pressed = "now" if tapper_halted and left <= 0 else "done"
                button = "press_button" if simulated else ""
                text = "Press the clear button at the tapper, then clear the faults within 10 s."
                if tapper_halted and left > 0:
                    text = f"The clear button was pressed: clear the faults within {left} s."
                steps.append(Step(text, pressed, button))
            held = f" Stopped by: {', '.join(holders)}." if holders else ""
            steps.append(Step(f"Clear the stop and the faults.{held}", present, "clear"))
        if not has_arm:
            return steps
        home = "done" if homed and not halted else "later" if halted else "now"
        busy = arm is not None and arm.state == ArmState.HOMING
        text = "The arm is homing." if busy else "Home the arm: it moves to its end switches."
        steps.append(Step(text, home, "" if busy else "home"))
        return steps
