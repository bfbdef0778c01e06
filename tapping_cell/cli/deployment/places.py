"""Where a deployed cell keeps its files."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DEFAULT_NAME = "tapping_cell"
MANIFEST = "deployed.json"
VERSION = "version.env"
"""Link to the environment of the version that the service runs."""
VERSIONS = "versions"
"""Folder with the environment of each version."""
LEFT = "undeployed.json"
"""List of what ``undeploy`` left, so that the cell can be deployed again."""


@dataclass(frozen=True, slots=True)
class Places:
    """Paths of a deployed cell below ``root`` (another root than ``/`` is an image)."""

    name: str = DEFAULT_NAME
    root: Path = Path("/")

    @property
    def configuration(self) -> Path:
        """Cell file, object files, calibrations, and the environment of the service."""
        return self.root / "etc" / self.name

    @property
    def version(self) -> str:
        """Return the target of the link to the version that the service runs; empty if there is
        none."""
        link = self.configuration / VERSION
        return os.readlink(link) if link.is_symlink() else ""

    @property
    def state(self) -> Path:
        """Home folder of the service: stops, goals, learnt gains, runs, logs."""
        return self.root / "var/lib" / self.name

    @property
    def cell_file(self) -> Path:
        """Cell file."""
        return self.configuration / "cell.yaml"

    @property
    def runs(self) -> Path:
        """Folder of the recorded runs."""
        return self.state / "runs"

    @property
    def gains(self) -> Path:
        """Learnt gains."""
        return self.state / ".local/state/tapping_cell/gains"

    @property
    def records(self) -> Path:
        """Stops, goals and named goals of each domain and namespace."""
        return self.state / ".ros/tapping_cell"

    @property
    def unit(self) -> str:
        """Name of the systemd unit."""
        return f"{self.name}.service"

    def manifest(self) -> dict[str, Any] | None:
        """Return the list of the files that ``deploy`` wrote; None if nothing is deployed."""
        return self._list(MANIFEST)

    def left(self) -> dict[str, Any] | None:
        """Return the list of what ``undeploy`` left; None if it left nothing."""
        return self._list(LEFT)

    def known(self) -> dict[str, Any] | None:
        """Return the list of what ``deploy`` wrote, or of what ``undeploy`` left of it."""
        return self.manifest() or self.left()

    def _list(self, name: str) -> dict[str, Any] | None:
        try:
            found = json.loads((self.configuration / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return found if isinstance(found, dict) and isinstance(found.get("files"), dict) else None


def valid_name(text: str) -> str:
    """Parse the name of a deployed cell, which is also the name of its user and unit."""
    if not re.fullmatch(r"[a-z][a-z0-9_-]{0,29}", text):
        raise ValueError(
            f"'{text}' is no name for a deployed cell: use at most 30 lower-case letters, digits, "
            "'_' and '-', beginning with a letter"
        )
    return text
