"""Further panels with an emergency stop, which may vanish while they are pressed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from lab.virtual_cell.network import Network
from lab.virtual_cell.scheduler import Scheduler
from tapping_cell.messages import Bool

TOPIC = "emergency_stop"


@dataclass(frozen=True, slots=True)
class PanelPress:
    """A press of a further panel's emergency stop. Times in s."""

    held: float
    """Time for which the panel asserts its stop."""
    volatile: bool = False
    """Whether the panel's publisher is volatile, so that its level cannot be queried."""
    vanishes: bool = True
    """Whether the panel is killed while it is pressed; otherwise, it is released."""
    back_after: float = math.inf
    """Time after which a killed panel is started again; inf for never."""
    again: bool = False
    """Whether the panel is pressed again as soon as it is started again."""
    stays: float = 1.0
    """Time from the release, or from the start after a kill, to the orderly end of the panel."""


class FurtherPanels:
    """All further panels of a run. Each start of a panel makes a new publisher."""

    def __init__(
        self,
        scheduler: Scheduler,
        network: Network,
        on_press: Callable[[], None],
        on_end: Callable[[], None],
    ) -> None:
        """``on_press``: called at the beginning of each press, ``on_end``: at its end."""
        self.held: set[int] = set()
        """Publishers that assert their stop at present."""
        self._scheduler = scheduler
        self._network = network
        self._on_press = on_press
        self._on_end = on_end
        self._stops: list[Bool] = []
        """Message with which each publisher asserts its stop."""

    def press(self, press: PanelPress) -> None:
        """Start a panel and press it."""
        number, message = len(self._stops), Bool(data=True)
        self._stops.append(message)
        self.held.add(number)
        self._publish(number, message, press)
        self._on_press()
        self._scheduler.after(press.held, partial(self._end, number, press))

    def _end(self, number: int, press: PanelPress) -> None:
        self.held.discard(number)
        if press.vanishes:
            self._leave(number)
            if math.isfinite(press.back_after):
                self._scheduler.after(press.back_after, partial(self._come_back, press))
        else:
            self._publish(number, Bool(data=False), press)
            self._scheduler.after(press.stays, partial(self._leave, number))
        self._on_end()

    def _come_back(self, press: PanelPress) -> None:
        if press.again:
            self.press(replace(press, again=False, back_after=math.inf))
            return
        number, message = len(self._stops), Bool(data=False)
        self._stops.append(message)
        self._publish(number, message, press)
        self._scheduler.after(press.stays, partial(self._leave, number))

    def _publish(self, number: int, message: Bool, press: PanelPress) -> None:
        self._network.publish(_name(number), TOPIC, message, volatile=press.volatile)

    def _leave(self, number: int) -> None:
        self._network.leave(_name(number))


def _name(number: int) -> str:
    return f"further panel {number + 1}"
