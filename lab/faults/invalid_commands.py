"""Invalid tap commands of another program. Each is a valid command with one wrong field."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tapping_cell.configuration.cell import Cell
from tapping_cell.logic.clock import to_nanoseconds, to_stamp
from tapping_cell.messages import TapCommand

HOURS_NS = 2 * 3600 * 10**9
"""Time that is added to an expiry, so that it is too far in the future."""
ID_JUMP = 2**28 + 2**20
"""Number that is added to an id, so that it is too large."""


@dataclass(frozen=True, slots=True)
class WrongField:
    """A wrong field. ``spoil`` enters it in a command; ``arm_refuses``: whether the arm, too, must
    refuse the command."""

    name: str
    spoil: Callable[[TapCommand, Cell], None]
    arm_refuses: bool = True


def _frame(command: TapCommand, _: Cell) -> None:
    command.header.frame_id = "arm_base"


def _request(command: TapCommand, _: Cell) -> None:
    command.request = 7


def _clear_view(command: TapCommand, _: Cell) -> None:
    command.request = TapCommand.CLEAR_VIEW


def _quaternion(command: TapCommand, _: Cell) -> None:
    command.strike_pose.orientation.w *= 1.5
    command.strike_pose.orientation.z *= 1.5


def _not_a_number(command: TapCommand, _: Cell) -> None:
    command.strike_pose.position.x = math.nan


def _tap_id(command: TapCommand, _: Cell) -> None:
    command.tap_id += ID_JUMP


def _expiry(command: TapCommand, _: Cell) -> None:
    command.expiry = to_stamp(to_nanoseconds(command.expiry) + HOURS_NS)


def _tapper(command: TapCommand, _: Cell) -> None:
    command.tapper = "nobody"


def _no_tapper(command: TapCommand, cell: Cell) -> None:
    # The only tapper of a cell needs no name.
    command.tapper = "" if len(cell.tapper_names) > 1 else "nobody"


def _slow(command: TapCommand, cell: Cell) -> None:
    command.striker_speed = 0.5 * min(one.curve().slowest for one in cell.tapper_sections.values())


def _fast(command: TapCommand, cell: Cell) -> None:
    command.striker_speed = 2.0 * max(one.curve().fastest for one in cell.tapper_sections.values())


WRONG_FIELDS = (
    WrongField("frame", _frame),
    WrongField("request", _request),
    WrongField("request to clear the view", _clear_view, arm_refuses=False),
    WrongField("quaternion", _quaternion),
    WrongField("not a number", _not_a_number),
    WrongField("id", _tap_id),
    WrongField("expiry", _expiry),
    WrongField("unknown tapper", _tapper, arm_refuses=False),
    WrongField("no tapper", _no_tapper, arm_refuses=False),
    WrongField("too slow", _slow, arm_refuses=False),
    WrongField("too fast", _fast, arm_refuses=False),
)


def draw_wrong_field(rng: np.random.Generator) -> WrongField:
    """Choose a wrong field at random."""
    return WRONG_FIELDS[int(rng.integers(len(WRONG_FIELDS)))]
