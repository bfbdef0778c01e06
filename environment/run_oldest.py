"""Run tests and a demo with the oldest supported versions, which lie over those of .venv.

python environment/run_oldest.py                      the pure and the driver tests, and one demo
python environment/run_oldest.py test/pure/vision     only these tests
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VERSIONS = ROOT / "environment" / "oldest.txt"
OVERLAY = ROOT / "build" / "oldest"
RINGS = ("test/pure", "test/pty")


def install() -> None:
    """Put the versions into a folder of their own, unless they are there."""
    stamp = OVERLAY / "versions.txt"
    wanted = f"{sys.version}\n{VERSIONS.read_text(encoding='utf-8')}"
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == wanted:
        return
    shutil.rmtree(OVERLAY, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--only-binary", ":all:"]
    subprocess.run([*pip, "--target", str(OVERLAY), "-r", str(VERSIONS)], check=True)
    stamp.write_text(wanted, encoding="utf-8")


def main() -> int:
    """The first exit status that is not 0."""
    if not (3, 10) <= sys.version_info[:2] <= (3, 12):
        print(f"{VERSIONS} needs Python 3.10 to 3.12; this is {sys.version.split()[0]}")
        return 2
    install()
    path = os.pathsep.join(filter(None, (str(OVERLAY), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": path}
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
