"""What was learnt about an object, kept between runs: one small file for an object in a cell.

``$XDG_STATE_HOME/tapping_cell/gains/<cell>/<object>.json``, or below ``~/.local/state``
where that is not set. Kept on request only: gains belong to one object on one table on a dry day,
and those of a simulated cell to no other.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
from pathlib import Path

from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.gains import Gains


def gains_file(object_name: str, cell: str) -> Path:
    """The file of an object's gains in a cell, which is named by a file name; the object's name may
    hold anything."""
    root = os.environ.get("XDG_STATE_HOME") or os.path.join(
        os.path.expanduser("~"), ".local", "state"
    )
    safe = re.sub(r"[^A-Za-z0-9._-]+", "_", object_name).strip("._") or "object"
    return Path(root) / "tapping_cell" / "gains" / cell / f"{safe}.json"


def keep_gains(object_name: str, cell: str, gains: Gains) -> Path:
    """Write an object's gains in a cell; an older file is replaced at once and as a whole.

    Raises:
        OSError: the file cannot be written.
    """
    path = gains_file(object_name, cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"object": object_name, **gains.as_numbers()}
    with tempfile.NamedTemporaryFile(
        "w", dir=path.parent, suffix=".part", delete=False, encoding="utf-8"
    ) as part:
        json.dump(content, part, indent=2)
    os.replace(part.name, path)
    return path


def load_gains(object_name: str, cell: str) -> Gains:
    """An object's gains from earlier runs in a cell, or those of an object never tapped before.

    Raises:
        PlanningError: the file cannot be read or holds impossible numbers; the sentence says which.
    """
    path = gains_file(object_name, cell)
    if not path.exists():
        return Gains.start()
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise PlanningError(
            f"{path}: the kept gains cannot be read ({error}); delete it"
        ) from error
    if not isinstance(content, dict):
        raise PlanningError(f"{path}: the kept gains are no JSON object; delete the file")
    try:
        return Gains.from_numbers(content)
    except PlanningError as error:
        raise PlanningError(f"{path}: {error}") from error
