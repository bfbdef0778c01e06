"""Text output of the state of a running cell, in the wording of the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table

STYLES = {"ready": "green", "moving": "cyan", "not ready": "yellow"}
LEVELS = {"ok": "green", "warn": "yellow", "error": "red"}
LOG_LINES = 8


def pose_text(numbers: Sequence[float | None] | None) -> str:
    """Format a pose in mm and degrees."""
    if numbers is None or None in numbers:
        return "-"
    x, y, angle = numbers
    return f"x {x:.1f} mm, y {y:.1f} mm, {angle:.1f} deg"


def headline(state: dict[str, Any]) -> str:
    """Return the mode of the whole cell in one line."""
    style = STYLES.get(state["mode"], "red")
    return f"[{style}]{state['mode']}[/]: {escape(state['sentence'])}"


def recovery(state: dict[str, Any]) -> list[str]:
    """Return numbered recovery steps after a stop, a fault or a start; empty if no steps are
    required."""
    verbs = {
        "clear": " (python -m tapping_cell clear)",
        "home": " (python -m tapping_cell home)",
        "press_button": " (simulated: python -m tapping_cell clear --press-button)",
    }
    marks = {"done": "x", "now": ">", "later": " "}
    return [
        f"{marks[step['state']]} {number}. {step['text']}{verbs.get(step['command'], '')}"
        for number, step in enumerate(state["recovery"], start=1)
    ]


def parts(state: dict[str, Any]) -> Table:
    """Return a table of object, goal, arm and tapper."""
    shown = Table(box=None, show_header=False, pad_edge=False)
    seen, plan = state["object"], state["plan"]
    where = pose_text(seen.get("pose")) if seen["visible"] else "not seen"
    rest = "" if not seen["visible"] or seen["at_rest"] else ", moving"
    shown.add_row("object", escape(_with(f"{where}{rest}", seen["sentence"])))
    if plan["goal"] is not None:
        left = [plan["distance"], plan["rotation"]]
        known = None not in left
        remaining = f"; remaining {left[0]:.2f} mm, {left[1]:.2f} deg" if known else ""
        shown.add_row("goal", escape(_with(pose_text(plan["goal"]) + remaining, plan["sentence"])))
        shown.add_row("taps", f"{plan['taps']} ({plan['state']})")
    for name in ("arm", "tapper"):
        device = state[name]
        # If recovery steps are shown, the remedy is left out here, because these steps contain it.
        text = device["sentence"].partition(";")[0] if state["recovery"] else device["sentence"]
        shown.add_row(name, escape(_with(device["state"], text)))
    return shown


def _with(word: str, sentence: str) -> str:
    return f"{word}: {sentence}" if sentence else word


def nodes(state: dict[str, Any]) -> Table:
    """Return a table with one row per node."""
    shown = Table(box=None, show_header=False, pad_edge=False)
    for row in state["nodes"]:
        style = LEVELS.get(row["level"], "red")
        text = "" if row["sentence"] == "ok" else row["sentence"]
        shown.add_row(row["name"], f"[{style}]{row['life']}[/]", escape(text))
    return shown


def taps(state: dict[str, Any]) -> Table:
    """Return a table of the taps of the current or last goal."""
    shown = Table(box=None, pad_edge=False)
    for title in ("tap", "striker", "moved", "remaining", ""):
        shown.add_column(title, justify="left" if not title else "right")
    for row in state["taps"]:
        dx, dy, turn = row["measured"]
        moved = "-" if dx is None else f"{(dx**2 + dy**2) ** 0.5:.1f} mm {turn:+.1f} deg"
        left, angle = row["remaining"]
        remaining = "-" if left is None else f"{left:.2f} mm {angle:+.2f} deg"
        shown.add_row(
            str(row["number"]), f"{row['speed']:.0f} mm/s", moved, remaining, row["outcome"]
        )
    return shown


def overview(state: dict[str, Any], log: bool = False) -> Group:
    """Return the complete output, with the last events if ``log`` is set."""
    shown: list[Any] = [headline(state)]
    shown += [escape(line) for line in recovery(state)]
    if state["hint"] and not state["recovery"]:
        shown.append(escape(f"what to do: {state['hint']}"))
    shown += ["", parts(state)]
    if state["taps"]:
        shown += ["", taps(state)]
    shown += ["", nodes(state)]
    if log and state["log"]:
        styles = {"good": "green", "bad": "red"}
        shown.append("")
        for entry in state["log"][-LOG_LINES:]:
            style = styles.get(entry["kind"], "default")
            shown.append(f"[{style}]{escape(entry['text'])}[/]")
    return Group(*shown)
