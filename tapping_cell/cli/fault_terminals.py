"""Fault trials over pseudo-terminals in real time; these trials also test the transport."""

from __future__ import annotations

import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from types import FrameType

from tapping_cell.cli.fault_trials import Dialect, TrialCell
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.hardware.transport import Transport
from tapping_cell.simulation.fault_layer import FaultLayer
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.virtual_line import HangError


class RealClock:
    """Monotonic clock with an alarm signal. The signal ends a call that still runs at the time
    ``limit``."""

    def __init__(self) -> None:
        signal.signal(signal.SIGALRM, _on_alarm)

    @property
    def now(self) -> float:
        """Current time in s."""
        return time.monotonic()

    @property
    def limit(self) -> float:
        """Time, on this clock, at which the alarm ends a call, in s."""
        return self.now + signal.getitimer(signal.ITIMER_REAL)[0]

    @limit.setter
    def limit(self, until: float) -> None:
        signal.setitimer(signal.ITIMER_REAL, max(until - self.now, 1e-3))


def _on_alarm(number: int, frame: FrameType | None) -> None:
    raise HangError("a driver's call did not return in time")


class TerminalCell(TrialCell):
    """Two emulated devices on pseudo-terminals. The fault layer can disconnect the terminals."""

    def __init__(self, dialect: Dialect, seed: int, folder: Path) -> None:
        self._folder = folder
        self._terminals: list[PseudoTerminal] = []
        super().__init__(dialect, seed, RealClock())

    def _ports(self) -> tuple[Transport, Transport]:
        return self._port(self.arm_line, "arm"), self._port(self.tapper_line, "tapper")

    def _port(self, line: FaultLayer, name: str) -> Transport:
        terminal = PseudoTerminal(line, self._folder / name)
        line.on_plug = lambda there: terminal.plug_in() if there else terminal.hang_up()
        terminal.open()
        self._terminals.append(terminal)
        return SerialTransport(str(terminal.path))

    def _arm_held(self) -> AbstractContextManager[object]:
        return self._terminals[0].lock

    def _tapper_held(self) -> AbstractContextManager[object]:
        # To avoid a deadlock, a caller that locks both devices locks the tapper first. A shot uses
        # the same order: the tapper is already locked when its thread queries the arm's position.
        return self._terminals[1].lock

    def close(self) -> None:
        """Stop the alarm, the drivers and the terminals."""
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        self.arm.close()
        self.tapper.close()
        for terminal in self._terminals:
            terminal.close()


@contextmanager
def terminal_cell(dialect: Dialect, seed: int) -> Iterator[TrialCell]:
    """Create a cell on two pseudo-terminals of its own, in real time."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        cell = TerminalCell(dialect, seed, folder)
        stack.callback(cell.close)
        yield cell
