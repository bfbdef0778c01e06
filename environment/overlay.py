"""Versions of packages that lie over those of .venv, in a folder of their own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path


def install(versions: Path, folder: Path) -> None:
    """Put the packages that the file ``versions`` lists into ``folder``, unless they are there."""
    stamp = folder / "versions.txt"
    wanted = f"{sys.version}\n{versions.read_text(encoding='utf-8')}"
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == wanted:
        return
    shutil.rmtree(folder, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--only-binary", ":all:"]
    subprocess.run([*pip, "--target", str(folder), "-r", str(versions)], check=True)
    stamp.write_text(wanted, encoding="utf-8")


def path(folder: Path) -> str:
    """PYTHONPATH with which the packages in ``folder`` come before those of .venv."""
    return os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
