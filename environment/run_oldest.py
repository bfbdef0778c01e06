"""Run tests and a demo with the oldest supported package versions instead of those of .venv.

Usage:

    python environment/run_oldest.py                     the pure and the driver tests, and one demo
    python environment/run_oldest.py test/pure/vision    only these tests
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import overlay

ROOT = Path(__file__).resolve().parent.parent
VERSIONS = ROOT / "environment" / "oldest.txt"
OVERLAY = ROOT / "build" / "oldest"
RINGS = ("test/pure", "test/pty")


def main() -> int:
    """Return the first exit code that is not 0, or 0."""
    if not (3, 10) <= sys.version_info[:2] <= (3, 12):
        print(f"{VERSIONS} needs Python 3.10 to 3.12; this is {sys.version.split()[0]}")
        return 2
    overlay.install(VERSIONS, OVERLAY)
    environment = {**os.environ, "PYTHONPATH": overlay.path(OVERLAY)}
    calls = [["pytest", "-q", *(sys.argv[1:] or RINGS)]]
    if not sys.argv[1:]:
        calls.append(["tapping_cell", "demo", "--out", str(OVERLAY.parent / "oldest_demo")])
        shutil.rmtree(OVERLAY.parent / "oldest_demo", ignore_errors=True)
    for call in calls:
        status = subprocess.run([sys.executable, "-m", *call], cwd=ROOT, env=environment).returncode
        if status:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
