"""Simulated people of the modes that protect people: one holds the enabling device of set-up mode,
the other one confirms the planner's taps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from lab.virtual_cell.network import Network
from lab.virtual_cell.scheduler import Scheduler
from tapping_cell.messages import Bool, ConfirmTap, PlanState

KEY_PERIOD_S = 0.1
"""Time between two messages of the page while its enabling key is held, s."""
KEY, SWITCH = "key", "switch"
GRIPS = ((SWITCH,), (KEY, SWITCH), (KEY, SWITCH), (KEY,))
"""Devices that the person holds; some combinations are listed twice, to be drawn more often. With
the key alone, the board refuses more than its set-up energy, so not every goal can be reached."""
ANSWER_S = (0.2, 2.5)
"""Usual time from a proposal to the person's answer, s."""
LATE_ANSWER_S = (3.0, 20.0)
"""Time from a proposal to a late answer, s."""
CHANGE_OF_MIND_S = 0.3
"""Maximum time between two answers to the same proposal, s."""
SHARES = (
    ("confirm", 0.68),
    ("reject", 0.1),
    ("answer for an old tap", 0.1),
    ("answer twice", 0.06),
    ("late answer", 0.04),
    ("no answer", 0.02),
)
"""Share of each kind of answer."""


class EnablingPerson:
    """Person who holds the enabling device of set-up mode."""

    def __init__(
        self,
        scheduler: Scheduler,
        network: Network,
        set_switch: Callable[[bool], None],
        rng: np.random.Generator,
    ) -> None:
        """``set_switch``: hold or release the switch at the tapper's board."""
        self.held: set[str] = set()
        """Devices that the person holds now."""
        self._scheduler = scheduler
        self._network = network
        self._set_switch = set_switch
        self._rng = rng
        self._grip = 0
        """Number of the grip of the key; its messages end with the grip."""

    def change_grip(self) -> None:
        """Choose anew which devices the person holds; at least one is held all the time."""
        chosen = GRIPS[int(self._rng.integers(len(GRIPS)))]
        for device in chosen:
            self._take(device)
        for device in (KEY, SWITCH):
            if device not in chosen and device in self.held:
                self._let_go(device, silent=False)

    def release(self, devices: tuple[str, ...], silent: bool, away: float) -> None:
        """Release devices, and hold them again after ``away`` s. ``silent``: the key's messages
        just end, as with a closed browser."""
        for device in devices:
            if device in self.held:
                self._let_go(device, silent)
                self._scheduler.after(away, partial(self._take, device))

    def _let_go(self, device: str, silent: bool) -> None:
        self.held.discard(device)
        if device == SWITCH:
            self._set_switch(False)
            return
        self._grip += 1
        if not silent:
            self._network.publish("page", "enabling", Bool(data=False))

    def _take(self, device: str) -> None:
        if device in self.held:
            return
        self.held.add(device)
        if device == SWITCH:
            self._set_switch(True)
            return
        self._grip += 1
        self._press_key(self._grip)

    def _press_key(self, grip: int) -> None:
        if grip == self._grip:
            self._network.publish("page", "enabling", Bool(data=True))
            self._scheduler.after(KEY_PERIOD_S, lambda: self._press_key(grip))


class ConfirmingPerson:
    """Person who answers whether a planned tap may be made."""

    def __init__(
        self,
        scheduler: Scheduler,
        network: Network,
        rng: np.random.Generator,
        note: Callable[[str], None],
        errs: bool,
    ) -> None:
        """``note``: called with each unusual kind of answer. ``errs``: whether there are any."""
        self._scheduler = scheduler
        self._network = network
        self._rng = rng
        self._note = note
        self._errs = errs
        self._proposed = self._before = 0
        """Ids of the last two proposed taps."""
        network.subscribe("person", "plan_state", self._see)

    def _see(self, _: str, message: Any) -> None:
        tap_id = message.planned_tap.tap_id
        if message.state != PlanState.CONFIRMING or tap_id == self._proposed:
            return
        self._before, self._proposed = self._proposed, tap_id
        kind = self._draw_kind() if self._errs else "confirm"
        if kind != "confirm":
            self._note(kind)
        after = float(self._rng.uniform(*(LATE_ANSWER_S if kind == "late answer" else ANSWER_S)))
        again = float(self._rng.uniform(0.0, CHANGE_OF_MIND_S))
        if kind == "answer for an old tap":
            self._answer(self._before, True, after)
            self._answer(tap_id, True, after + 10.0 * again)
        elif kind == "answer twice":
            first, second = (bool(self._rng.random() < 0.5) for _ in range(2))
            self._answer(tap_id, first, after)
            self._answer(tap_id, second, after + again)
        elif kind != "no answer":
            self._answer(tap_id, kind != "reject", after)

    def _draw_kind(self) -> str:
        kinds, shares = zip(*SHARES, strict=True)
        return str(kinds[int(self._rng.choice(len(kinds), p=shares))])

    def _answer(self, tap_id: int, confirm: bool, after: float) -> None:
        request = ConfirmTap.Request(tap_id=tap_id, confirm=confirm)
        call = partial(self._network.call, "confirm_tap", request, lambda _: None)
        self._scheduler.after(after, call)
