"""Test the arm's driver with the emulators of all six controllers, in virtual time.

Each controller is connected and homed. Then it makes random moves, and the reported positions are
compared with the true joint positions. Afterwards, stops, disconnected cables, alarms, restarts and
the other faults of ``controller_trials`` are injected at random times. A trial passes if the driver
reports the correct reason and message, if the arm's position is correct, and if the arm moves
exactly to its goal after it was homed again.
"""

from __future__ import annotations

from typing import Any

from lab.drivers.controller_cell import NAMES
from lab.drivers.controller_trials import FAULTS, run_faults, run_moves

DEFAULT_COUNT = 200
"""Number of moves of each controller. The number of trials of each kind of fault is a fifth of this
number."""
SEED = 1
_SHOWN = 3
"""Maximum number of messages of failed trials that are printed for each kind of trial and
controller."""


def measure(count: int) -> dict[str, Any]:
    """Return the number of trials and the messages of the failed trials, by kind and controller."""
    rows: dict[str, dict[str, Any]] = {}
    for name in NAMES:
        moves = run_moves(name, count, SEED)
        rows.setdefault("moves", {})[name] = {"tried": moves.tried, "wrong": moves.wrong}
    for kind, fault in FAULTS.items():
        for name in fault.controllers:
            outcome = run_faults(name, kind, max(count // 5, 1), SEED)
            row = {"tried": outcome.tried, "wrong": outcome.wrong}
            rows.setdefault(kind, {})[name] = row
    return rows


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = [f"{'passed of all trials':29}" + "".join(f"{name:>14}" for name in NAMES)]
    tried = wrong = 0
    for kind, row in report.items():
        cells = []
        for name in NAMES:
            outcome = row.get(name)
            if outcome is None:
                cells.append("-")
                continue
            tried += outcome["tried"]
            wrong += len(outcome["wrong"])
            cells.append(f"{outcome['tried'] - len(outcome['wrong'])} of {outcome['tried']}")
        mark = FAULTS[kind].findings if kind in FAULTS else ""
        text.append(
            f"{kind + (f' ({mark})' if mark else ''):29}" + "".join(f"{c:>14}" for c in cells)
        )
    text.append(f"{100 * (tried - wrong) / tried:.2f} % of {tried} trials right")
    for kind, row in report.items():
        for name, outcome in row.items():
            text += [f"{kind}, {name}: {sentence}" for sentence in outcome["wrong"][:_SHOWN]]
    return text
