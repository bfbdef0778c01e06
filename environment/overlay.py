"""A folder of packages that replace packages of .venv."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path


def install(versions: Path, folder: Path) -> None:
    """Install the packages of the file ``versions`` into ``folder``, unless it is up to date."""
    stamp = folder / "versions.txt"
    wanted = f"{sys.version}\n{versions.read_text(encoding='utf-8')}"
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == wanted:
        return
    shutil.rmtree(folder, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--only-binary", ":all:"]
    subprocess.run([*pip, "--target", str(folder), "-r", str(versions)], check=True)
    stamp.write_text(wanted, encoding="utf-8")


def path(folder: Path) -> str:
    """Return a PYTHONPATH with which the packages in ``folder`` replace packages of .venv."""
    return os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
