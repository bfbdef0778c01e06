"""What the tapper's node knows of its boards, and the outcome of its last tap."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.energy import EnergyCurve
from tapping_cell.hardware.tapper_protocol import Reply
from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic import permit
from tapping_cell.logic.clock import to_nanoseconds
from tapping_cell.logic.poses import from_message
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.logic.tapper_jobs import Status
from tapping_cell.logic.tapper_peers import Mounts
from tapping_cell.logic.tapper_states import Tap
from tapping_cell.messages import ErrorCode, TapCommand, TapperState


@dataclass(slots=True)
class TapperBoard:
    """The cell's tappers, and the last reply of their boards."""

    curves: Mapping[str, EnergyCurve] = field(default_factory=dict)
    strokes: Mapping[str, float] = field(default_factory=dict)
    channels: Mapping[str, int] = field(default_factory=dict)
    """Channel number of each tapper, counted across the boards."""
    is_fixed: bool = False
    """Whether the tappers are at fixed mounts."""
    mounts: Mounts = field(default_factory=Mounts)
    used: int | None = None
    """Greatest shot number for which the board has charged, including charges before this node was
    started; None until the board has been read."""
    shots_fired: int = 0
    boot_number: int = 0
    interlock_closed: bool = False

    def configure(self, cell: Cell) -> None:
        """Use the tappers of this cell."""
        self.channels = cell.tapper_channels
        self.curves = {name: part.curve() for name, part in cell.tapper_sections.items()}
        self.strokes = {name: part.stroke for name, part in cell.tapper_sections.items()}
        self.is_fixed = cell.file.fixed_tappers is not None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tappers."""
        return tuple(self.channels)

    def tap(self, command: TapCommand, tapper: str) -> Tap:
        """Return the tap of a command for a tapper."""
        return Tap(
            command.tap_id,
            self.channels[tapper],
            self.curves[tapper].energy_for(command.striker_speed),
            to_nanoseconds(command.expiry),
            from_message(command.object_pose),
            from_message(command.strike_pose),
            permit.flight(self.strokes[tapper], command.striker_speed),
        )

    def speed_error(self, tapper: str, speed: float) -> CodedError | None:
        """Return why a striker speed is refused, or None if it is allowed."""
        curve = self.curves[tapper]
        if not math.isfinite(speed) or curve.slowest <= speed <= curve.fastest:
            return None
        return (
            ErrorCode.TAPPER_SPEED_OUT_OF_RANGE,
            f"a striker speed of {1000 * speed:.1f} mm/s is outside the tapper's "
            f"{1000 * curve.slowest:.1f} to {1000 * curve.fastest:.1f} mm/s",
        )

    def take_in(self, status: Status) -> None:
        """Store the board's reply."""
        reply = status.reply
        self.used = reply.shot
        self.shots_fired = status.fired
        self.boot_number = reply.boot
        self.interlock_closed = reply.interlock_closed
        switches = reply.at_mounts
        self.mounts.fitted = reply.channels > 1 or switches > 0
        self.mounts.proven = reply.state not in (BoardState.UNHOMED, BoardState.HOMING)
        resting = reply.state not in (BoardState.RELEASING, BoardState.DISCHARGING)
        if resting or not switches:
            self.mounts.away = tuple(
                name
                for name, channel in self.channels.items()
                if self.mounts.fitted and not switches >> channel & 1
            )

    @property
    def mounts_proven(self) -> bool:
        """Whether the strikers are known to be at their mounts, or there are no mounts."""
        return not self.is_fixed or (self.mounts.fitted and self.mounts.proven)

    @property
    def wants_proof(self) -> bool:
        """Whether the board can verify its strikers' positions and has not yet done so."""
        mounts = self.mounts
        wanted = self.is_fixed and mounts.fitted and not mounts.proven and not mounts.away
        return wanted and self.interlock_closed


@dataclass(slots=True)
class LastTap:
    """The last tap that ``tapper_state`` reports."""

    tap_id: int = 0
    tapper: str = ""
    outcome: int = TapperState.NONE
    measured_speed: float = math.nan
    fire_job: int | None = None
    """Job that may fire the tap; None: no job may have fired it."""

    def begin(self, tap_id: int, outcome: int) -> None:
        """Report another tap from now on."""
        self.fire_job = None
        self.tap_id, self.outcome = tap_id, outcome
        self.measured_speed = math.nan

    def awaits_outcome(self) -> bool:
        """Return whether a tap was accepted whose outcome is not known yet."""
        return self.tap_id != 0 and self.outcome == TapperState.NONE

    def note_speed(self, reply: Reply) -> None:
        """Store the speed that the board has measured for this tap."""
        ours = reply.last_fired == self.tap_id
        self.measured_speed = reply.speed if ours and reply.speed is not None else math.nan


def why_not_charged(reply: Reply) -> CodedError:
    """Return why a board that was charged now reports a state other than charged."""
    if not reply.interlock_closed:
        return (
            ErrorCode.TAPPER_INTERLOCK_OPEN,
            "the guard was opened while the tapper was charged, so the tapper discharged itself;"
            " close the guard",
        )
    if reply.lacks_switch:
        return (
            ErrorCode.ENABLING_RELEASED,
            "the enabling switch was released while the tapper was charged; without it the tapper"
            " keeps at most its set-up energy, so it discharged itself; hold the switch",
        )
    return (
        ErrorCode.TAPPER_FAULT,
        f"the tapper was charged, but its board is now in state {reply.state.value}: it discharged"
        " itself because it received no request for 0.5 s, the guard was opened or the enabling"
        " switch of set-up mode released briefly, or its supply failed",
    )
