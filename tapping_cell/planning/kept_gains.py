"""Storage of learnt gains between runs: one small file per object and cell.

The file is ``$XDG_STATE_HOME/tapping_cell/gains/<cell>/<object>.json``. If the variable is not set,
``~/.local/state`` is used in its place. If the object's name is not a plain file name, a part of
its hash distinguishes the files of similar names. Gains are saved only on request, because they are
valid only for one object on one table at one humidity, and gains learnt in a simulated cell are
valid only for that cell.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path

from tapping_cell.durable_file import replace_text
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.gains import Gains


def gains_file(object_name: str, cell: str) -> Path:
    """Return the path of the file for an object's gains in a cell. ``cell`` must be a valid file
    name; ``object_name`` may contain any characters."""
    root = os.environ.get("XDG_STATE_HOME") or os.path.join(
        os.path.expanduser("~"), ".local", "state"
    )
    safe = re.sub(r"[^A-Za-z0-9._-]+", "_", object_name).strip("._") or "object"
    if safe != object_name:
        safe += "-" + hashlib.sha256(object_name.encode()).hexdigest()[:12]
    return Path(root) / "tapping_cell" / "gains" / cell / f"{safe}.json"


def keep_gains(object_name: str, cell: str, gains: Gains) -> Path:
    """Write an object's gains in a cell; an older file is replaced atomically.

    Raises:
        OSError: the file cannot be written.
    """
    path = gains_file(object_name, cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"object": object_name, **gains.as_numbers()}
    replace_text(path, json.dumps(content, indent=2))
    return path


def load_gains(object_name: str, cell: str) -> Gains:
    """Load an object's gains in a cell; without a file, return those of an untapped object.

    Raises:
        PlanningError: the file cannot be read or contains invalid numbers; the message names them.
    """
    path = gains_file(object_name, cell)
    if not path.exists():
        return Gains.start()
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise PlanningError(
            f"{path}: the saved gains cannot be read ({error}); delete it"
        ) from error
    if not isinstance(content, dict):
        raise PlanningError(f"{path}: the saved gains are not a JSON object; delete the file")
    try:
        return Gains.from_numbers(content)
    except PlanningError as error:
        raise PlanningError(f"{path}: {error}") from error
