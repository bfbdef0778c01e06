"""Simulated boards of the fixed tappers. Each board is reached through a pseudo-terminal and acts
on the simulated world."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from tapping_cell.configuration.cell import Board, Cell, FixedTapperSection
from tapping_cell.se2 import Pose
from tapping_cell.simulation.arm_drawing import StrikerDrawing
from tapping_cell.simulation.devices import LARGEST_BOOT, OnStrike
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.rendered_camera import Drawing
from tapping_cell.simulation.striker_motion import Flight, striker_speed
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine
from tapping_cell.simulation.truth import MountsTruth


def true_mounts(cell: Cell, truth: MountsTruth, seed: int) -> dict[str, Pose]:
    """Return the tappers' true mount poses by name, drawn at random around the mounts in the cell
    file."""
    random = np.random.default_rng([seed, 22])
    mounts = {}
    for entry in cell.fixed_tappers.tappers:
        aside, turn = random.standard_normal(2) * (truth.offset, truth.angle)
        x, y = entry.position
        mounts[entry.name] = Pose(
            x - float(aside) * math.sin(entry.direction),
            y + float(aside) * math.cos(entry.direction),
            entry.direction + float(turn),
        )
    return mounts


class FixedTapperBoard:
    """One emulated board and its strikers."""

    def __init__(
        self,
        cell: Cell,
        board: Board,
        mounts: Mapping[str, Pose],
        on_strike: OnStrike,
        boot: int,
        now: float,
    ) -> None:
        self._height = cell.fixed_tappers.strike_height
        self._entries: dict[int, FixedTapperSection] = {
            entry.channel: entry
            for entry in cell.fixed_tappers.tappers
            if entry.name in board.channels
        }
        self._tappers = {channel: cell.tapper_of(entry) for channel, entry in self._entries.items()}
        self._mounts = mounts
        self._on_strike = on_strike
        self._flights: dict[str, Flight] = {}
        self._drawings = {
            channel: StrikerDrawing(tapper) for channel, tapper in self._tappers.items()
        }
        self.emulator = TapperEmulator(
            TapperMachine(coils=1 + max(self._entries)), self._fire, boot=boot, now=now
        )

    def _fire(self, shot: int, energy: float, now: float) -> float | None:
        entry = self._entries.get(self.emulator.channel)
        if entry is None:
            return None  # a channel without a striker
        tapper = self._tappers[entry.channel]
        speed = striker_speed(tapper.curve(), energy)
        measured, travel = self._on_strike(
            self._mounts[entry.name], self._height, speed, tapper, now
        )
        flight = self._flights[entry.name] = Flight(now, speed, travel)
        self.emulator.coils.flight = flight.duration
        return measured

    def extensions(self, now: float) -> tuple[float, ...]:
        """Return how far each tip is extended at ``now``, m."""
        flights = (self._flights.get(entry.name) for entry in self._entries.values())
        return tuple(flight.extension(now) if flight is not None else 0.0 for flight in flights)

    def drawings(self, extensions: Sequence[float]) -> tuple[Drawing, ...]:
        """Return the strikers for the camera, extended as given."""
        return tuple(
            self._drawings[channel].at(self._mounts[entry.name], self._height, out)
            for (channel, entry), out in zip(self._entries.items(), extensions, strict=True)
        )


class FixedDevices:
    """All boards of a cell, each on a port that drivers open like a real one.

    ``ports``: function that returns the path to use for a board number and the board's port in the
    cell file.

    Raises:
        PortTakenError: a port's path belongs to a running process.
    """

    def __init__(
        self,
        cell: Cell,
        truth: MountsTruth,
        ports: Callable[[int, str], Path],
        on_strike: OnStrike,
        seed: int,
    ) -> None:
        now = time.monotonic()
        boot = int(time.time()) % LARGEST_BOOT + 1
        mounts = true_mounts(cell, truth, seed)
        self._boards: list[FixedTapperBoard] = []
        self._ports: list[PseudoTerminal] = []
        self._drawn: tuple[tuple[tuple[float, ...], ...], tuple[Drawing, ...]] = ((), ())
        try:
            for index, board in enumerate(cell.boards):
                made = FixedTapperBoard(cell, board, mounts, on_strike, boot, now)
                port = PseudoTerminal(made.emulator, ports(index, board.port))
                port.open()
                self._boards.append(made)
                self._ports.append(port)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Disconnect every board."""
        for port in self._ports:
            port.close()

    def press_clear_button(self) -> None:
        """Press the clear button of each board; this is required before a stop can be cleared."""
        for port, board in zip(self._ports, self._boards, strict=True):
            with port.lock:
                board.emulator.press_clear_button(time.monotonic())

    def drawings(self, now: float, exposed: float) -> tuple[Drawing, ...]:
        """Return the strikers as they are at ``exposed``, the world time of the image, for the
        camera. The result is the same object while nothing moves."""
        del now  # only an arm moves in the machine's time
        key = tuple(board.extensions(exposed) for board in self._boards)
        if key != self._drawn[0]:
            boards = zip(self._boards, key, strict=True)
            self._drawn = key, tuple(one for board, out in boards for one in board.drawings(out))
        return self._drawn[1]
