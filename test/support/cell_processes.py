"""Cells that run as processes, as users start them with a verb."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tapping_cell.nodes import MODULES

CELL = (sys.executable, "-m", "tapping_cell")
TIMEOUT_S = 280
"""Safety timeout of a verb, s; tests wait for events and need a fraction of it."""


def start(*words: str, **options: object) -> subprocess.Popen[str]:
    """Start a verb; its errors come with its output. ``options`` are those of ``Popen``."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    return subprocess.Popen((*CELL, *words), text=True, **{**streams, **options})  # type: ignore[call-overload, no-any-return]


def run(*words: str, **options: object) -> tuple[int, str]:
    """Run a verb to its end; return its exit code and its output in one line."""
    process = start(*words, **options)
    try:
        output, _ = process.communicate(timeout=TIMEOUT_S)
    finally:
        process.kill()
    return process.returncode, " ".join(output.split())


def processes(folder: Path) -> dict[str, int]:
    """Return, by name, the process ids of the nodes whose log is below this folder."""
    nodes = {module: name for name, module in MODULES.items()}
    found = {}
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "cmdline").read_bytes().decode().split("\0")
            log = os.readlink(entry / "fd" / "1")
        except OSError:
            continue
        names = [nodes[word] for word in words if word in nodes]
        if names and log.startswith(str(folder)):
            found[names[0]] = int(entry.name)
    return found
