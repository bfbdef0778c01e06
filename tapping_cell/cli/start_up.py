"""Start-up display of a running graph: one line per node, and whether the cell is ready."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from tapping_cell.cli.supervision import ASIDE
from tapping_cell.messages import ErrorCode
from tapping_cell.nodes.page.node_watch import NOT_YET

PERSONS = (
    ErrorCode.EMERGENCY_STOP,
    ErrorCode.ARM_NOT_HOMED,
    ErrorCode.ARM_STOPPED,
    ErrorCode.TAPPER_STOPPED,
    ErrorCode.TAPPER_INTERLOCK_OPEN,
    ErrorCode.ENABLING_RELEASED,
    ErrorCode.OBJECT_NOT_SEEN,
    ErrorCode.OBJECT_NOT_AT_REST,
    ErrorCode.OBJECT_OFF_TABLE,
    ErrorCode.REFERENCES_NOT_SEEN,
    ErrorCode.MARKER_AMBIGUOUS,
    ErrorCode.CAMERA_MOVED,
)
"""Error codes of a cell that has started and now needs an action of an operator."""
STYLES = {
    "ready": "green",
    "warns": "yellow",
    "waits": "yellow",
    "starting": "yellow",
    "fault": "red",
    "ended": "red",
}


@dataclass(frozen=True, slots=True)
class Line:
    """State of one node, with its error or the condition for which it waits."""

    node: str
    word: str
    """One of: starting, waits, ready, warns (the node works, but reports a warning), fault,
    ended."""
    sentence: str = ""

    def __str__(self) -> str:
        return f"{self.node}: {self.word}" + (f", {self.sentence}" if self.sentence else "")


@dataclass(frozen=True, slots=True)
class Start:
    """Start-up state of a cell."""

    lines: tuple[Line, ...]
    ready: bool
    """Whether the cell would accept a goal now."""
    person: str = ""
    """Action required of a person, if all nodes have started and only this action is missing."""
    reason: str = ""
    """Reason why the cell would not accept a goal; empty when ready."""

    @property
    def complete(self) -> bool:
        """Whether every node has started; a node that reports a fault has."""
        return all(line.word not in ("starting", "waits") for line in self.lines)


def judge(nodes: Sequence[str], state: dict[str, Any], ended: dict[str, str]) -> Start:
    """Determine the start-up state from the state of the cell.

    ``nodes``: names of the started nodes; ``state``: the client's view of the cell; ``ended``:
    reason for each node that has ended.
    """
    rows = {row["name"]: row for row in state["nodes"]}
    world = rows.get("sim_world", {}).get("life") == "active"
    waits_for_world = "sim_world" in nodes and not world
    lines = tuple(_line(name, rows.get(name), ended, waits_for_world) for name in nodes)
    up = Start(lines, ready=False).complete
    mode, code = state["mode"], state["code"]
    # A busy cell also accepts a goal; the new goal replaces the current one.
    takes = mode == "ready" or (mode == "moving" and state["plan"]["busy"])
    ready = up and takes and all(line.word != "fault" for line in lines)
    person = ""
    if up and not ready and code in PERSONS:
        steps = [step["text"] for step in state["recovery"] if step["state"] != "done"]
        person = f"{state['sentence']}. {' '.join(steps) or state['hint']}"
    missing = "; ".join(str(line) for line in lines if line.word in ("starting", "waits", "fault"))
    return Start(lines, ready, person, "" if ready else missing or state["sentence"])


def _line(
    name: str, row: dict[str, str] | None, ended: dict[str, str], waits_for_world: bool
) -> Line:
    if name in ended:
        return Line(name, "ended", ended[name])
    if row is None or row["life"] == "not running" or row["sentence"] == NOT_YET:
        return Line(name, "starting")
    if waits_for_world and name != "sim_world":
        return Line(name, "waits", "for sim_world")
    if row["life"] != "active":
        problem = "" if row["sentence"] in ("ok", "not configured") else row["sentence"]
        return Line(name, "waits", problem) if problem else Line(name, "starting")
    if row["level"] == "ok":
        return Line(name, "ready")
    # The cell also takes goals while nothing can be recorded, for example because the disk is full.
    is_fault = row["level"] == "error" and name not in ASIDE
    return Line(name, "fault" if is_fault else "warns", row["sentence"])


def table(lines: Sequence[Line]) -> Table:
    """Format the lines for a terminal."""
    shown = Table(box=None, show_header=False, pad_edge=False)
    for line in lines:
        shown.add_row(line.node, f"[{STYLES[line.word]}]{line.word}[/]", line.sentence)
    return shown
