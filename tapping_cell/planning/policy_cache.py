"""Cache of solved plans on disk, with file names that depend on the settings.

Each plan is a file in ``$XDG_CACHE_HOME/tapping_cell/policies``. If the variable is not set,
``~/.cache`` is used in its place. A file is written under a temporary name and renamed, so that
readers never see an incomplete file. If a file cannot be read, the plan is solved again. If a file
cannot be written, the plan is solved again the next time.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.value_iteration import FINE_STEPS, RATIO, Solution

FORMAT = 6
"""Version of the format. Increase it whenever the solver gives different plans for the same
settings and grids."""

MAX_FILES = 64

_log = logging.getLogger(__name__)


def cache_folder() -> Path:
    """Return the folder of the solved plans, according to the XDG base directory specification."""
    root = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(root) / "tapping_cell" / "policies"


def policy_file(settings: PlannerSettings) -> Path:
    """Return the path of the file with the plan for these settings."""
    digest = hashlib.sha256(
        f"format={FORMAT};grid={RATIO},{FINE_STEPS};{settings.key()}".encode()
    ).hexdigest()
    return cache_folder() / f"{digest[:32]}.npz"


def load_policy(settings: PlannerSettings) -> Solution | None:
    """Load the plan for these settings, or return None if there is no readable plan."""
    path = policy_file(settings)
    try:
        with np.load(path, allow_pickle=False) as kept:
            solution = Solution(*(np.asarray(kept[name], dtype=float) for name in Solution._fields))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        _log.warning("the cached plan %s cannot be read (%s); solving it again", path, error)
        return None
    shape = (solution.distances.size, solution.rotations.size)
    tables = (solution.value, solution.tap, solution.turn)
    if any(table.shape != shape or not np.all(np.isfinite(table)) for table in tables):
        _log.warning("the cached plan %s is damaged; solving it again", path)
        return None
    return solution


def keep_policy(settings: PlannerSettings, solution: Solution) -> None:
    """Write a solved plan and remove the oldest files beyond ``MAX_FILES``."""
    path = policy_file(settings)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as part:
            np.savez(part, **solution._asdict())
        os.replace(part.name, path)
        kept = sorted(path.parent.glob("*.npz"), key=lambda item: item.stat().st_mtime)
        for old in kept[:-MAX_FILES]:
            old.unlink(missing_ok=True)
    except OSError as error:
        _log.warning("the solved plan cannot be saved in %s: %s", path.parent, error)
        with contextlib.suppress(OSError, UnboundLocalError):
            os.unlink(part.name)
