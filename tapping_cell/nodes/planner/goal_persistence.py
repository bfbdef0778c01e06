"""The goal under way, kept on disk so that a planner that crashed goes on with it."""

from __future__ import annotations

import json
import math
import os
import time
from pathlib import Path

from geometry_msgs.msg import PoseStamped

from tapping_cell.nodes.conversions import from_message, to_message
from tapping_cell.nodes.planner.goal_handling import Request
from tapping_cell.nodes.planner.tap_task import Task
from tapping_cell.se2 import Pose


class GoalMemory:
    """One small file a cell.

    It is touched while the goal is worked on and removed at the goal's end and at an orderly end of
    the node, so that only a crash leaves one behind; and an old one is not believed: a cell that
    stood still for long does not begin to move by itself.
    """

    def __init__(self, folder: Path, patience: float) -> None:
        """``folder``: the cell's own; ``patience``: oldest file believed, s, 0 for none."""
        self._path = folder / "goal.json"
        self._patience = patience

    def keep(self, task: Task) -> None:
        """Write the goal; nothing where no goal is ever resumed. Raises OSError."""
        if self._patience <= 0:
            return
        content = {
            "goal": list(from_message(task.message.pose)),
            "tolerance": list(task.tolerance),
            "max_taps": task.max_taps,
        }
        self._path.parent.mkdir(parents=True, exist_ok=True)
        part = self._path.with_suffix(".part")
        part.write_text(json.dumps(content), encoding="utf-8")
        part.replace(self._path)

    def touch(self) -> None:
        """Say that the goal is still worked on."""
        if self._path.exists():
            os.utime(self._path)

    def forget(self) -> None:
        """The goal has ended."""
        self._path.unlink(missing_ok=True)

    def recall(self) -> Request | None:
        """The goal that a crash left behind a moment ago, or None; it is forgotten by this."""
        try:
            age = time.time() - self._path.stat().st_mtime
            content = json.loads(self._path.read_text(encoding="utf-8"))
            self.forget()
            if not 0 <= age <= self._patience:
                return None
            x, y, theta = map(_finite, content["goal"])
            message = PoseStamped(pose=to_message(Pose(x, y, theta)))
            message.header.frame_id = "table"
            position, angle = map(_finite, content["tolerance"])
            return Request(message, position, angle, int(_finite(content["max_taps"])))
        except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError):
            # A file that holds no goal is no goal, whatever else it holds.
            self.forget()
            return None


def _finite(value: object) -> float:
    """A number as a float. Raises TypeError, ValueError or OverflowError for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{type(value).__name__} is not a number")
    if not math.isfinite(value):
        raise ValueError("not finite")
    return float(value)
