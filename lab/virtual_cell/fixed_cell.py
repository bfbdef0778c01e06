"""Physical part of a simulated positioning cell: one or two boards with tappers at fixed mounts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from lab.virtual_cell.physical_cell import PhysicalCell, Release
from lab.virtual_cell.serial_line import SerialLine
from tapping_cell.configuration.cell import TapperSection
from tapping_cell.hardware.scara import Joints
from tapping_cell.se2 import Pose
from tapping_cell.simulation.fault_layer import FaultLayer
from tapping_cell.simulation.fixed_devices import FixedTapperBoard, true_mounts
from tapping_cell.simulation.tapper_emulator import TapperEmulator

NOWHERE = Joints(0.0, 0.0, 0.0, 0.0)
CHARGED = ("CHARGING", "CHARGED")


@dataclass(frozen=True, slots=True)
class FixedRelease(Release):
    """Ground truth of a release of a tapper at a fixed mount."""

    tapper: str
    others_charged: tuple[int, ...]
    """Numbers of the other boards that were charged or were releasing their striker."""
    others_out: tuple[str, ...]
    """Tappers, other than this one, whose strikers were in flight."""
    object_at_rest: bool


class PhysicalFixedCell(PhysicalCell):
    """Parts of a positioning cell that exist independently of any program. Times in s."""

    def _make_devices(self, seed: int, now: float) -> None:
        self.mounts = true_mounts(self.cell, self.truth.mounts, seed)
        self._nominal = {
            entry.name: Pose(*entry.position, entry.direction)
            for entry in self.cell.fixed_tappers.tappers
        }
        self.boards: list[TapperEmulator] = []
        self.lines: list[SerialLine] = []
        self.out_since: dict[str, float] = {}
        """Time at which a striker left its mount, by the name of its tapper. Only strikers that a
        person or a broken spring keeps off their mounts are listed."""
        self._last = 0
        for number, board in enumerate(self.cell.boards):
            made = FixedTapperBoard(self.cell, board, self.mounts, self._struck, 1, now)
            names = {channel: name for name, channel in board.channels.items()}
            fire = made.emulator.on_fire
            assert fire is not None
            made.emulator.on_fire = partial(self._fire, number, names, fire)
            self.boards.append(made.emulator)
            self.lines.append(
                SerialLine(self._scheduler, FaultLayer(made.emulator), f"tapper {number}")
            )

    @property
    def active(self) -> int:
        """Number of the charged board, or of the board that released a striker last if no board is
        charged."""
        charged = self.charged()
        return charged[0] if charged else self._last

    @property
    def tapper_board(self) -> TapperEmulator:  # type: ignore[override]
        """The active board."""
        return self.boards[self.active]

    @property
    def tapper_line(self) -> SerialLine:  # type: ignore[override]
        """Line of the active board."""
        return self.lines[self.active]

    def charged(self) -> list[int]:
        """Return the numbers of the charged boards."""
        return [number for number, board in enumerate(self.boards) if board.state in CHARGED]

    def place_of(self, tapper: str) -> tuple[int, int]:
        """Return the board and the channel of a tapper."""
        for number, board in enumerate(self.cell.boards):
            if tapper in board.channels:
                return number, board.channels[tapper]
        raise KeyError(tapper)

    def moving(self, time: float) -> bool:
        """Return False: no arm moves."""
        return False

    def view(self, time: float) -> Pose | None:
        """Return the true pose of the object; nothing hides the object."""
        return self.object_pose(time)

    def flight(self, speed: float) -> float:
        """Return 0. Only an arm has to stand still during the striker's flight; a fixed mount
        cannot move."""
        return 0.0

    def press_clear_button(self) -> None:
        """Press the clear button at every board."""
        self._at_each(lambda board, now: board.press_clear_button(now))

    def set_interlock(self, closed: bool) -> None:
        """Open or close the guard. Every board reads the guard's switch."""
        self._at_each(lambda board, now: board.set_interlock(closed, now))

    def set_enabling_switch(self, held: bool) -> None:
        """Hold or release the enabling switch. Every board reads this switch."""
        self._at_each(lambda board, now: board.set_enabling_switch(held, now))

    def keep_out(self, tapper: str, out: bool) -> None:
        """Keep a striker off its mount, or put it back."""
        number, channel = self.place_of(tapper)
        self.boards[number].coils.keep_out(channel, out)
        if out:
            self.out_since.setdefault(tapper, self._scheduler.now)
        else:
            self.out_since.pop(tapper, None)
        self.lines[number].schedule()

    def block(self, tapper: str, blocked: bool) -> None:
        """Block or unblock a striker. A blocked striker remains at its mount when released."""
        number, channel = self.place_of(tapper)
        self.boards[number].coils.block(channel, blocked)
        self.lines[number].schedule()

    def _at_each(self, act: Callable[[TapperEmulator, float], None]) -> None:
        for board, line in zip(self.boards, self.lines, strict=True):
            act(board, self._scheduler.now)
            line.schedule()

    def _fire(
        self,
        number: int,
        names: dict[int, str],
        fire: Callable[[int, float, float], float | None],
        shot: int,
        energy: float,
        now: float,
    ) -> float | None:
        """Handle the release of a coil of board ``number``."""
        board, self._last = self.boards[number], number
        name = names[board.channel]
        away = [
            other
            for other in self.cell.tapper_names
            if other != name and other not in self.out_since and self._in_flight(other, now)
        ]
        others = [
            other
            for other, one in enumerate(self.boards)
            if other != number and one.state in (*CHARGED, "RELEASING")
        ]
        self.releases.append(
            FixedRelease(
                shot,
                energy,
                now,
                NOWHERE,
                False,
                self._nominal[name],
                self.cell.strike_height,
                self.object_pose(now),
                name,
                tuple(others),
                tuple(away),
                self.world.at_rest,
            )
        )
        self.on_release()
        return fire(shot, energy, now)

    def _in_flight(self, tapper: str, now: float) -> bool:
        number, channel = self.place_of(tapper)
        return not self.boards[number].coils.at_mounts(now) >> channel & 1

    def _struck(
        self, tip: Pose, height: float, speed: float, tapper: TapperSection, now: float
    ) -> tuple[float, float]:
        self.world.advance(now)
        self.world.take_striker(tapper.striker(), tapper.stroke)
        travel = min(self.world.travel_to_meet(tip, height, speed), tapper.stroke)
        self.world.strike(tip, height, speed, now)
        return self.world.gate_speed(speed), travel
