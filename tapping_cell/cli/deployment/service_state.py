"""What systemd says about a deployed cell."""

from __future__ import annotations

import shutil
import subprocess

from tapping_cell.cli.deployment.places import Places

PROPERTIES = ("ActiveState", "SubState", "Result", "NRestarts", "MemoryCurrent", "StatusText")
TIMEOUT_S = 10.0


def output_of(*command: str) -> str:
    """Return the output of a command; empty if it is missing or fails."""
    if shutil.which(command[0]) is None:
        return ""
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return result.stdout


def service_state(places: Places) -> dict[str, str] | None:
    """Return properties of the unit; None if no cell of this name is deployed."""
    if places.manifest() is None:
        return None
    text = output_of("systemctl", "show", places.unit, f"--property={','.join(PROPERTIES)}")
    return dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
