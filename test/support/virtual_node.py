"""One node in virtual time: its state machine, the driver and emulated board of a device, and a
probe that replaces all other nodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lab.trial import QUALITIES, SERVES, SUBSCRIPTIONS
from lab.virtual_cell.host import HostClock, Process, Program
from lab.virtual_cell.network import Network
from lab.virtual_cell.scheduler import Scheduler
from lab.virtual_cell.serial_line import SerialLine
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.host import Logic
from tapping_cell.messages import Time, Trigger
from tapping_cell.simulation.device_emulator import DeviceEmulator
from tapping_cell.simulation.fault_layer import FaultLayer

TIMEOUT_S = 60.0
PROBE = "probe"


class VirtualNode:
    """One node in virtual time, and a probe that replaces all other nodes and exchanges messages
    with this node. Times in s since the start."""

    def __init__(
        self,
        name: str,
        board: DeviceEmulator | Sequence[DeviceEmulator] | None,
        make: Callable[[Any], tuple[Logic, Any]],
        connect: Callable[[Any, float, Now], Any],
        states: str,
        cell: Cell | None = None,
        started: bool = True,
    ) -> None:
        """``make`` returns the state machine and its driver for the board's line, or for the list
        of lines of several boards. ``connect`` is called when the node is configured. ``states`` is
        the topic on which the node publishes its state."""
        self.scheduler = Scheduler()
        self.network = Network(self.scheduler, np.random.default_rng(1), QUALITIES)
        several = isinstance(board, Sequence)
        boards = [] if board is None else list(board) if isinstance(board, Sequence) else [board]
        lines = [SerialLine(self.scheduler, FaultLayer(one), name) for one in boards]
        line = lines[0] if lines else None
        clock = self._clock = HostClock(self.scheduler)
        program = Program(
            lambda: make(lines if several else line),
            connect,
            cell or load_cell(),
            SUBSCRIPTIONS[name],
            SERVES[name],
            tuple(lines),
        )
        self.process = Process(
            name, program, self.scheduler, self.network, clock, lambda low, high: low
        )
        self.line, self.lines = line, lines
        self.states: list[Any] = self.listen(states)
        if started:
            self.process.start()

    def listen(self, topic: str) -> list[Any]:
        """Return a list that receives all messages of a topic from now on."""
        received: list[Any] = []
        self.network.subscribe(PROBE, topic, lambda _, message: received.append(message))
        return received

    @property
    def last(self) -> Any:
        """Return the last state published by the node."""
        return self.states[-1]

    def now(self) -> float:
        """Return the virtual time, in s."""
        return self.scheduler.now

    def stamp(self, ahead: float = 0.0) -> Time:
        """Return the node's ROS time, or the time ``ahead`` s later."""
        return to_stamp(self._clock.now().ros + round(1e9 * ahead))

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message as another node."""
        self.network.publish(PROBE, topic, message)

    def run(self, duration: float) -> None:
        """Let time pass."""
        self.scheduler.run(self.now() + duration)

    def wait(self, condition: Callable[[], object], what: str, patience: float = TIMEOUT_S) -> None:
        """Let time pass until the condition holds; otherwise fail with ``what``."""
        self.scheduler.run(self.now() + patience, lambda: bool(condition()))
        assert condition(), f"waited {patience:.0f} s in vain: {what}"

    def wait_state(self, state: int) -> None:
        """Wait until the node publishes this state."""
        self.wait(lambda: self.states and self.last.state == state, f"state {state}")

    def ask(self, service: str, request: Any = None) -> list[Any]:
        """Call a service; its answer is added to the returned list."""
        answers: list[Any] = []
        self.network.call(service, request or Trigger.Request(), answers.append, math.inf)
        return answers

    def call(self, service: str, request: Any = None) -> Any:
        """Call a service and return its answer."""
        answers = self.ask(service, request)
        self.wait(lambda: answers, f"{service} answers")
        return answers[0]

    def reported_errors(self) -> Sequence[str]:
        """Return descriptions of defects that occurred in the node; there should be none."""
        return self.process.defects
