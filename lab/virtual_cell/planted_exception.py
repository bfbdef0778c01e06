"""Exception at a random line of a node's code, as an unknown defect of the code raises it.

After such an exception, the node's state machine must stop its device or end its goal
(``on_defect``), and the state that it keeps must still be usable.
"""

from __future__ import annotations

import linecache
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import tapping_cell.hardware
import tapping_cell.logic

FOLDERS = tuple(str(Path(room.__path__[0])) for room in (tapping_cell.logic, tapping_cell.hardware))
"""Folders of the code whose lines are counted: state machines, their jobs and drivers."""
HANDOVER = "return effects"
"""Line that hands the effects of a handler over to the host. It cannot raise."""
SIMULATOR = str(Path(__file__).parent)

Result = TypeVar("Result")


class PlantedError(Exception):
    """The planted exception."""


class PlantedException:
    """Raises :class:`PlantedError` once, at the start of a line of the node's code, after ``lines``
    other lines. The lines of all calls of :meth:`run` are counted together, but not the lines that
    the simulator executes when it is called by the node's code. ``function``: name of the function
    at whose next call the count begins; empty: the count begins at once."""

    def __init__(self, lines: int, function: str = "") -> None:
        self.place = ""
        """File and line where the exception was raised; empty before."""
        self._left = lines
        self._function = function

    def run(self, call: Callable[..., Result], *arguments: Any) -> Result:
        """Call a handler or a job and return its result."""
        simulator_frames = 0

        def enter(frame: FrameType, event: str, argument: Any) -> Any:
            nonlocal simulator_frames
            name = frame.f_code.co_filename
            if name.startswith(SIMULATOR):
                simulator_frames += 1
                return leave
            if simulator_frames or not name.startswith(FOLDERS):
                return None
            if frame.f_code.co_name == self._function:
                self._function = ""
            return None if self._function else count

        def leave(frame: FrameType, event: str, argument: Any) -> Any:
            nonlocal simulator_frames
            if event == "return":
                simulator_frames -= 1
            return leave

        def count(frame: FrameType, event: str, argument: Any) -> Any:
            if event == "line" and self._left >= 0:
                self._left -= 1
                file, line = frame.f_code.co_filename, frame.f_lineno
                if self._left == -1 and linecache.getline(file, line).strip() == HANDOVER:
                    self._left = 0
                elif self._left == -1:
                    self.place = f"{Path(file).name}:{line}"
                    raise PlantedError(self.place)
            return count

        before = sys.gettrace()
        sys.settrace(enter)
        try:
            return call(*arguments)
        finally:
            sys.settrace(before)
