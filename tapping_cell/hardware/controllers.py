"""The arm controllers with a serial line: each ``NAME_dialect.py`` of this folder with a function
``make_dialect`` is one."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from tapping_cell.hardware.controller_needs import ControllerNeeds
from tapping_cell.hardware.dialect import ArmDialect
from tapping_cell.hardware.transport import Transport

NO_CONTROLLERS = ("line", "ros2_control")
"""Dialects that are no serial controller: a base class, and the arms with a ROS driver."""
CONTROLLERS = tuple(
    sorted(
        {path.stem.removesuffix("_dialect") for path in Path(__file__).parent.glob("*_dialect.py")}
        - set(NO_CONTROLLERS)
    )
)
"""Names of the controllers, as in the cell file's ``arm.dialect``."""


@dataclass(frozen=True, slots=True)
class ControllerWiring:
    """What a cell file says about the arm's controller.

    letters: axis letters of shoulder, elbow, quill, tool. needs: requirements on the controller's
    settings; settings: further required values, by number. home_place: machine position after
    homing, in degrees and mm; None if the controller defines it. without_switch: axes, 0 to 3, that
    homing does not move. needs_homing: whether homing must be enabled in the controller.
    """

    letters: str
    needs: ControllerNeeds
    settings: Mapping[int, float]
    home_place: tuple[float, float, float, float] | None
    without_switch: tuple[int, ...]
    needs_homing: bool


def make_dialect(
    name: str, transport: Transport, wiring: ControllerWiring, draw_number: Callable[[int], int]
) -> ArmDialect:
    """Create the dialect of a controller. ``draw_number`` returns a random number from 0 to below
    its argument."""
    module = importlib.import_module(f"tapping_cell.hardware.{name}_dialect")
    made: ArmDialect = module.make_dialect(transport, wiring, draw_number)
    return made
