"""What was learnt about an object, kept between runs: one small file an object.

``$XDG_STATE_HOME/tapping_cell/gains/<object>.json`` (``~/.local/state`` where that is not set).
Kept on request only: gains belong to one object on one table on a dry day.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
from pathlib import Path

from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.gains import Gains


def gains_file(object_name: str) -> Path:
    """The file of an object's gains; the name may hold anything, the file's name does not."""
    root = os.environ.get("XDG_STATE_HOME") or os.path.join(
        os.path.expanduser("~"), ".local", "state"
    )
    safe = re.sub(r"[^A-Za-z0-9._-]+", "_", object_name).strip("._") or "object"
    return Path(root) / "tapping_cell" / "gains" / f"{safe}.json"


def keep_gains(object_name: str, gains: Gains) -> Path:
    """Write an object's gains; an older file is replaced at once and as a whole.

    Raises:
        OSError: the file cannot be written.
    """
    path = gains_file(object_name)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"object": object_name, **gains.as_numbers()}
    with tempfile.NamedTemporaryFile(
        "w", dir=path.parent, suffix=".part", delete=False, encoding="utf-8"
    ) as part:
        json.dump(content, part, indent=2)
    os.replace(part.name, path)
    return path


def load_gains(object_name: str) -> Gains:
    """An object's gains from earlier runs, or those of an object never tapped before.

    Raises:
        PlanningError: the file cannot be read or holds impossible numbers; the sentence says which.
    """
    path = gains_file(object_name)
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
